"""Tune hyper-parameters: ``python -m sb3_guard.tune --algo trpo_lag --env Goal_Point_8Hazards``."""

import argparse
import math
import os
import sys
from collections.abc import Sequence
from typing import Any

from sb3_guard.train import training_flags
from sb3_guard.zoo.usage import Parser, UsageError, positive, run

EXAMPLES = """examples:
  python -m sb3_guard.tune --algo trpo_lag --env Goal_Point_8Hazards --n-trials 50 -n 1e6
  python -m sb3_guard.tune --algo cpo --env Goal_Point_8Hazards -params cost_limit:5 --n-jobs 2
  python -m sb3_guard.tune --algo cpo --env Goal_Point_8Hazards --seeds 0 1 2 --pruner halving
  python -m sb3_guard.tune --algo cpo --env Goal_Point_8Hazards --pareto --study-name trade-off
  python -m sb3_guard.tune ... --storage postgresql://me:secret@server/studies

The same command continues a study that was stopped, and joins one that runs: --n-trials counts the
trials of the study, not of the process.
"""

DEFAULTS: dict[str, Any] = {
    "algo": "cpo",
    "env": "Goal_Point_8Hazards-v0",
    "n_trials": 50,
    "n_timesteps": -1,
    "cost_limit": None,
    "pareto": False,
    "hyperparams": None,
    "conf_file": None,
    "search_space": None,
    "env_kwargs": None,
    "vec_env": None,
    "gym_packages": [],
    "device": "auto",
    "seeds": None,
    "n_seeds": 1,
    "seed": -1,
    "sampler": "tpe",
    "pruner": "median",
    "n_startup_trials": 10,
    "n_evaluations": None,
    "eval_episodes": 5,
    "log_folder": "logs",
    "study_name": None,
    "storage": None,
    "heartbeat": 60,
    "storage_timeout": 300.0,
    "n_jobs": 1,
    "num_threads": -1,
    "verbose": 1,
    "worker_of": None,
}


def parser() -> Parser:
    """The flags, RL-Zoo's where it has them. What is not given is absent from the result."""
    result = Parser(
        prog="sb3-guard tune",
        description="Search the hyper-parameters of the highest return under a cost limit.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    what = result.add_argument_group("what is tuned")
    what.add_argument("--algo", help="algorithm, e.g. cpo or ppo (default: cpo)")
    what.add_argument(
        "--env", help="environment id; the version may be left out (default: Goal_Point_8Hazards)"
    )
    training_flags(
        what,
        n_timesteps="length of one training, e.g. 1e6 (default: as in the hyper-parameter file)",
        hyperparams="hyper-parameters that are fixed, and not searched, e.g. cost_limit:5",
        conf_file="hyper-parameters to begin with, as for train (default: hyperparams/<algo>.yml)",
    )
    what.add_argument(
        "--cost-limit",
        type=float,
        nargs="+",
        metavar="D",
        help="highest episode cost of a feasible trial, one for all or one per cost "
        "(default: selection_limit, else the algorithm's cost_limit, but at least 1)",
    )
    what.add_argument(
        "--pareto",
        action="store_true",
        help="search the front of return and cost instead; the limit is only drawn",
    )
    what.add_argument(
        "--search-space",
        metavar="FILE",
        help="YAML file of ranges and lists to search (default: that of the algorithm)",
    )

    search = result.add_argument_group("search")
    search.add_argument(
        "--n-trials",
        "--max-total-trials",
        type=positive,
        metavar="N",
        help="finished trials of the study in all, pruned ones included (default: 50)",
    )
    seeds = search.add_mutually_exclusive_group()
    seeds.add_argument(
        "--seeds", type=int, nargs="+", metavar="S", help="seeds that every trial trains with"
    )
    seeds.add_argument(
        "--n-seeds", type=positive, metavar="N", help="the first so many: 0 1 2 … (default: 1)"
    )
    search.add_argument("--seed", type=int, help="seed of the sampler (default: -1, a random one)")
    search.add_argument("--sampler", help="tpe, gp, nsgaii or random (default: tpe)")
    search.add_argument("--pruner", help="median, halving or none (default: median)")
    search.add_argument(
        "--n-startup-trials",
        type=int,
        metavar="N",
        help="trials before the sampler learns and the pruner prunes (default: 10)",
    )
    search.add_argument(
        "--n-evaluations",
        type=positive,
        metavar="N",
        help="evaluations per training (default: one per 100,000 steps, but at least 4)",
    )
    search.add_argument(
        "--eval-episodes", type=positive, metavar="N", help="episodes each time (default: 5)"
    )

    where = result.add_argument_group("storage and workers")
    where.add_argument("-f", "--log-folder", metavar="DIR", help="where studies go (default: logs)")
    where.add_argument(
        "--study-name", metavar="NAME", help="to have several studies (default: <algo>_<env>)"
    )
    where.add_argument(
        "--storage",
        metavar="URL",
        help="postgresql://… for workers on many machines, or a journal file "
        "(default: a journal file in the study's folder, for one machine)",
    )
    where.add_argument(
        "--heartbeat",
        type=positive,
        metavar="S",
        help="seconds between signs of life in PostgreSQL; a worker silent for three times as "
        "long loses its trial to another (default: 60)",
    )
    where.add_argument(
        "--storage-timeout",
        type=float,
        metavar="S",
        help="seconds to wait for a PostgreSQL server that has gone away (default: 300)",
    )
    where.add_argument(
        "--n-jobs", type=positive, metavar="N", help="processes that work on it (default: 1)"
    )
    where.add_argument(
        "--num-threads",
        type=int,
        metavar="N",
        help="threads of torch and of the native engine (default: their own choice, or 1 if "
        "there are several processes)",
    )
    where.add_argument("--verbose", type=int, choices=[0, 1, 2], help="0 nothing (default: 1)")
    where.add_argument("--worker-of", type=int, help=argparse.SUPPRESS)
    return result


def _check(args: dict[str, Any]) -> None:
    """What can be said before anything heavy is imported."""
    for limit in args["cost_limit"] or ():
        if not (math.isfinite(limit) and limit >= 0):
            raise UsageError(f"--cost-limit {limit} is not allowed; it must be at least 0")
    for seed in [*args["seeds"], args["seed"]]:
        if seed >= 2**32 or (seed < 0 and seed is not args["seed"]):
            raise UsageError(f"seed {seed} is not allowed; it must be from 0 to 2**32 - 1")
    if len(set(args["seeds"])) < len(args["seeds"]):
        raise UsageError(f"--seeds {' '.join(map(str, args['seeds']))}: one is there twice")
    if args["n_startup_trials"] < 0:
        raise UsageError(
            f"--n-startup-trials {args['n_startup_trials']} is not allowed; it must be at least 0"
        )
    if not args["storage_timeout"] >= 0:
        raise UsageError(
            f"--storage-timeout {args['storage_timeout']} is not allowed; it must be at least 0"
        )


def _tune(argv: Sequence[str] | None) -> int:
    argv = list(sys.argv[1:] if argv is None else argv)
    given = vars(parser().parse_args(argv))
    args = {**DEFAULTS, **given}
    if args["seeds"] is None:
        args["seeds"] = list(range(args["n_seeds"]))
    if args["pareto"] and given.get("pruner", "none") != "none":
        raise UsageError("--pruner: there is no pruning with --pareto; leave it out")
    _check(args)
    if (args["n_jobs"] > 1 or args["worker_of"] is not None) and args["num_threads"] < 0:
        args["num_threads"] = 1
        os.environ.setdefault("OMP_NUM_THREADS", "1")

    from sb3_guard.zoo.tuning import tune

    return tune(args, argv)


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param argv: arguments; None: those of the process
    :return: exit status: 0, 2 for wrong usage, 128 + the signal's number when interrupted
    """
    return run(lambda: _tune(argv))


if __name__ == "__main__":
    sys.exit(main())

"""Train an agent: ``python -m sb3_guard.train --algo cpo --env Goal_Point_8Hazards``."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_guard.zoo.usage import KeyValues, Parser, UsageError, positive, run, steps

EXAMPLES = """examples:
  python -m sb3_guard.train --algo cpo --env Goal_Point_8Hazards -n 1e6 --seed 0
  python -m sb3_guard.train --algo cpo --env Goal_Point_8Hazards -params cost_limit:5 n_envs:10
  python -m sb3_guard.train --env Goal_Point_8Hazards --env-kwargs "hazards:{'num': 4}"
  python -m sb3_guard.train --algo cpo --env Goal_Point_8Hazards --seeds 0 1 2 --jobs 2
  python -m sb3_guard.train -i logs/cpo/Goal_Point_8Hazards-v0_1             continue a killed run
  python -m sb3_guard.train -i logs/cpo/Goal_Point_8Hazards-v0_1 -n 2e6      and for longer
"""

DEFAULTS: dict[str, Any] = {
    "algo": "cpo",
    "env": "Goal_Point_8Hazards-v0",
    "n_timesteps": -1,
    "seed": -1,
    "log_folder": "logs",
    "device": "auto",
    "vec_env": None,
    "hyperparams": None,
    "conf_file": None,
    "env_kwargs": None,
    "eval_env_kwargs": None,
    "eval_freq": 25_000,
    "eval_episodes": 5,
    "n_eval_envs": None,
    "save_freq": -1,
    "checkpoint_every": 10.0,
    "trained_agent": "",
    "log_interval": -1,
    "num_threads": -1,
    "progress": None,
    "verbose": 1,
    "tensorboard_log": "",
    "uuid": False,
    "gym_packages": [],
    "track": False,
    "wandb_project_name": "sb3_guard",
    "wandb_entity": None,
    "wandb_group": None,
    "wandb_tags": [],
}


def training_flags(group: argparse._ArgumentGroup, **instead: str) -> None:
    """
    Add the flags that say how to train, whatever is trained.

    :param instead: help texts that are not those of ``train``, by the flag's name in the result
    """
    texts = {
        "n_timesteps": "length of training, e.g. 1e6 (default: as in the hyper-parameter file)",
        "hyperparams": "hyper-parameters that differ from the file, e.g. n_steps:500 cost_limit:25",
        "conf_file": "hyper-parameters: 'paper' for the paper's table to the letter, a YAML file, "
        "or a Python file or module with a dict 'hyperparams' (default: hyperparams/<algo>.yml)",
        **instead,
    }
    group.add_argument("-n", "--n-timesteps", type=positive, metavar="N", help=texts["n_timesteps"])
    group.add_argument(
        "-params",
        "--hyperparams",
        nargs="+",
        action=KeyValues,
        metavar="KEY:VALUE",
        help=texts["hyperparams"],
    )
    group.add_argument("-conf", "--conf-file", metavar="FILE", help=texts["conf_file"])
    group.add_argument(
        "--env-kwargs",
        nargs="+",
        action=KeyValues,
        metavar="KEY:VALUE",
        help="arguments of the environment, e.g. \"hazards:{'num': 4}\"",
    )
    group.add_argument(
        "--vec-env",
        choices=["native", "dummy", "subproc"],
        help="one batch, one by one, or a process each (default: native where it is possible)",
    )
    group.add_argument("--device", help="torch device (default: auto)")
    group.add_argument(
        "--gym-packages",
        nargs="+",
        metavar="MODULE",
        help="modules to import first, since they register environments",
    )


def evaluation_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the evaluation while training."""
    evaluation = parser.add_argument_group("evaluation")
    evaluation.add_argument(
        "--eval-freq",
        type=steps,
        metavar="N",
        help="evaluate every N steps; -1 never (default: 25000)",
    )
    evaluation.add_argument(
        "--eval-episodes", type=positive, metavar="N", help="episodes each time (default: 5)"
    )
    evaluation.add_argument(
        "--n-eval-envs",
        type=positive,
        metavar="N",
        help="environments to evaluate in (default: one per episode if native, else 1)",
    )
    evaluation.add_argument(
        "--eval-env-kwargs",
        nargs="+",
        action=KeyValues,
        metavar="KEY:VALUE",
        help="arguments of the evaluation environment (default: as in training)",
    )


def file_flags(group: argparse._ArgumentGroup) -> None:
    """Add the flags that say what a run writes."""
    group.add_argument(
        "--save-freq",
        type=steps,
        metavar="N",
        help="keep a model every N steps, rl_model_<N>_steps.zip; -1 none (default: -1)",
    )
    group.add_argument(
        "--checkpoint-every",
        type=float,
        metavar="S",
        help="least seconds between checkpoints to resume from (default: 10)",
    )
    group.add_argument(
        "-tb", "--tensorboard-log", metavar="DIR", help="write TensorBoard events there"
    )
    group.add_argument(
        "--track", action="store_true", help="send the run to Weights & Biases (needs wandb)"
    )
    for name in ("project-name", "entity", "group"):
        group.add_argument(f"--wandb-{name}", metavar="NAME", help=argparse.SUPPRESS)
    group.add_argument("-tags", "--wandb-tags", nargs="+", help=argparse.SUPPRESS)


def jobs_flag(group: argparse._ArgumentGroup) -> None:
    """Add ``--jobs``."""
    group.add_argument(
        "--jobs",
        type=positive,
        metavar="N",
        help="runs at once, a process with one thread each (default: as many as there are cores)",
    )


def parser() -> Parser:
    """The flags, RL-Zoo's where it has them. What is not given is absent from the result."""
    result = Parser(
        prog="sb3-guard train",
        description="Train an agent, log costs beside returns, and keep the best safe model.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    run_flags = result.add_argument_group("what is trained")
    run_flags.add_argument("--algo", help="algorithm, e.g. cpo or trpo (default: cpo)")
    run_flags.add_argument(
        "--env", help="environment id; the version may be left out (default: Goal_Point_8Hazards)"
    )
    training_flags(run_flags)
    seeds = run_flags.add_mutually_exclusive_group()
    seeds.add_argument("--seed", type=int, help="random seed (default: -1, a random one)")
    seeds.add_argument(
        "--seeds",
        type=int,
        nargs="+",
        metavar="K",
        help="a run for each of these seeds, <env>_<seed + 1>, several at once; the same command "
        "goes on with what is not done",
    )
    run_flags.add_argument(
        "-i",
        "--trained-agent",
        metavar="PATH",
        help="a run folder or checkpoint.zip: continue that run in place, exactly; "
        "any other model.zip: begin a new run from that agent",
    )
    evaluation_flags(result)

    files = result.add_argument_group("files")
    files.add_argument("-f", "--log-folder", metavar="DIR", help="where runs go (default: logs)")
    files.add_argument(
        "-uuid", "--uuid", action="store_true", help="make the run folder's name unique"
    )
    file_flags(files)

    output = result.add_argument_group("running")
    jobs_flag(output)
    output.add_argument(
        "-P",
        "--progress",
        action=argparse.BooleanOptionalAction,
        help="progress bar (default: if stderr is a terminal)",
    )
    output.add_argument(
        "--verbose", type=int, choices=[0, 1, 2], help="0 nothing, 1 progress, 2 all (default: 1)"
    )
    output.add_argument(
        "--log-interval", type=int, metavar="N", help="log every N rollouts; -2 never (default: 1)"
    )
    output.add_argument(
        "--num-threads",
        type=int,
        metavar="N",
        help="threads of torch and of the native engine (default: -1, their own choice)",
    )
    return result


def check_flags(args: Mapping[str, Any]) -> None:
    """What can be said before anything heavy is imported."""
    if args["seed"] >= 2**32:
        raise UsageError(f"--seed {args['seed']} is not allowed; it must be less than 2**32")
    if not args["checkpoint_every"] >= 0:
        raise UsageError(
            f"--checkpoint-every {args['checkpoint_every']}: must be at least 0 seconds"
        )
    if args["log_interval"] == 0 or args["log_interval"] < -2:
        raise UsageError(
            f"--log-interval {args['log_interval']} is not allowed; it must be at least 1, or -2"
        )
    if args["track"]:
        try:
            import wandb  # noqa: F401
        except ImportError:
            raise UsageError("--track needs wandb; install it with: pip install wandb") from None


def _train(argv: Sequence[str] | None) -> int:
    given = vars(parser().parse_args(argv))
    seeds, jobs = given.pop("seeds", None), given.pop("jobs", None)
    args = {**DEFAULTS, **given}
    if args["progress"] is None:
        args["progress"] = sys.stderr.isatty() and args["verbose"] > 0
    check_flags(args)
    if seeds is not None:
        return _train_seeds(args, seeds, jobs)
    if jobs is not None:
        raise UsageError("--jobs goes with several seeds, such as --seeds 0 1 2")

    from sb3_guard.zoo import experiment

    agent = given.get("trained_agent")
    if not agent:
        return experiment.start(args)
    if experiment.continues_run(Path(agent)):
        return experiment.resume(given, {**DEFAULTS, "progress": args["progress"]})
    return experiment.start(args)


def _train_seeds(args: dict[str, Any], seeds: Sequence[int], jobs: int | None) -> int:
    for flag, given in (("-i", args["trained_agent"]), ("--uuid", args["uuid"])):
        if given:
            raise UsageError(f"{flag} is for a single run; leave it out, or --seeds")

    from sb3_guard.zoo.grid import LocalExecutor, expand, plan, run_grid, try_out

    runs = expand([(args["env"], args["algo"])], seeds, args)
    plan(runs)
    try_out(runs)
    with LocalExecutor(jobs) as executor:
        return run_grid(runs, executor, args, "go on with the same command")


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param argv: arguments; None: those of the process
    :return: exit status: 0, 2 for wrong usage, 128 + the signal's number when interrupted
    """
    return run(lambda: _train(argv))


if __name__ == "__main__":
    sys.exit(main())

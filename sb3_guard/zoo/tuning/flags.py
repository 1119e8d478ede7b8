"""The flags of tuning."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from sb3_guard.zoo.cli.flags import flag
from sb3_guard.zoo.run.flags import TrainingFlags

EXAMPLES = """examples:
  sb3-guard tune --algo trpo_lag --env Goal_Point_8Hazards --n-trials 50 -n 1e6
  sb3-guard tune --algo cpo --env Goal_Point_8Hazards -params cost_limit:5 --n-jobs 2
  sb3-guard tune --algo cpo --env Goal_Point_8Hazards --seeds 0 1 2 --pruner halving
  sb3-guard tune ... --storage postgresql://me:secret@server/studies

The same command continues a study that was stopped, and joins a study that is running: --n-trials
counts the trials of the study, not of the process.
"""


@dataclass
class TuneFlags(TrainingFlags):
    """
    Find the hyperparameters with the highest return under a cost limit.

    What is trained:

    :param algo: algorithm, e.g. cpo or ppo (default: cpo)
    :param env: environment id; the version may be left out (default: Goal_Point_8Hazards)
    :param cost_limit: highest episode cost of a feasible trial, one for all costs or one per cost
        (default: selection_limit of the hyperparameters, else their cost_limit, but at least 1)
    :param search_space: YAML file of ranges and lists to search (default: the algorithm's search
        space)

    Search:

    :param n_trials: number of finished trials of the study, pruned ones included (default: 50)
    :param seeds: random seeds that every trial trains with (default: 0)
    :param seed: random seed of the sampler; -1: a random one (default: -1)
    :param sampler: Optuna sampler (default: tpe)
    :param pruner: Optuna pruner, which stops bad trials early (default: median)
    :param n_startup_trials: number of random trials before sampler and pruner start to work
        (default: 10)
    :param n_evaluations: number of evaluations per training (default: one per 100,000 steps, but at
        least 4)
    :param eval_episodes: episodes per evaluation with each kind of actions (default: 5)

    Storage and workers:

    :param log_folder: folder for studies (default: logs)
    :param study_name: name of the study, to have several (default: <algo>_<env>)
    :param storage: postgresql://… to share a study between machines, or a journal file (default: a
        journal file in the study's folder)
    :param n_jobs: number of processes that work on the study (default: 1)
    :param num_threads: threads of torch and of the native engine in each process (default: 1)
    :param verbose: output: 0 nothing, 1 progress, 2 with tracebacks (default: 1)
    """

    prog: ClassVar[str] = "sb3-guard tune"
    examples: ClassVar[str] = EXAMPLES

    algo: str = flag(default="cpo")
    env: str = flag(default="Goal_Point_8Hazards-v0")
    cost_limit: list[float] | None = flag(low=0, metavar="D")
    search_space: str | None = flag(metavar="FILE")

    n_trials: int = flag("--max-total-trials", default=50, low=1, metavar="N")
    seeds: list[int] = flag(default=[0], low=0, high=2**32, metavar="S")
    seed: int = flag(default=-1, high=2**32)
    sampler: Literal["tpe", "gp", "nsgaii", "random"] = flag(default="tpe")
    pruner: Literal["median", "halving", "none"] = flag(default="median")
    n_startup_trials: int = flag(default=10, low=0, metavar="N")
    n_evaluations: int | None = flag(low=1, metavar="N")
    eval_episodes: int = flag(default=5, low=1, metavar="N")

    log_folder: str = flag("-f", default="logs", metavar="DIR")
    study_name: str | None = flag(metavar="NAME")
    storage: str | None = flag(metavar="URL")
    n_jobs: int = flag(default=1, low=1, metavar="N")
    num_threads: int = flag(default=1, low=1, metavar="N")
    verbose: Literal[0, 1, 2] = flag(default=1)

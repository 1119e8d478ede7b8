"""The flags of a run, as ``args.yml`` in its folder keeps them; other commands share some."""

from dataclasses import dataclass
from typing import Any, Literal, Self

from sb3_guard.zoo.flags import HOST, IDENTITY, Command, flag
from sb3_guard.zoo.usage import (
    UsageError,
    amount,
    interval,
    positive,
    seed_or_random,
    steps,
)

WHAT, EVALUATION, FILES, RUNNING = "what is trained", "evaluation", "files", "running"
TRUST = "let files of a run or grid name code that is not this package's, RL-Zoo's or SB3's"


@dataclass
class TrainingFlags(Command):
    """How to train, whatever is trained."""

    n_timesteps: int = flag(
        "-n", default=-1, kind=positive, metavar="N", group=WHAT,
        help="length of training, e.g. 1e6 (default: as in the hyper-parameter file)",
    )  # fmt: skip
    hyperparams: dict[str, Any] | None = flag(
        "-params", group=WHAT,
        help="hyper-parameters that differ from the file, e.g. n_steps:500 cost_limit:25",
    )  # fmt: skip
    conf_file: str | None = flag(
        "-conf", metavar="FILE", group=WHAT,
        help="hyper-parameters: 'paper' for the paper's table to the letter, 'omnisafe' for that "
        "library's published settings, a YAML file, or a Python file or module with a dict "
        "'hyperparams' (default: hyperparams/<algo>.yml)",
    )  # fmt: skip
    env_kwargs: dict[str, Any] | None = flag(
        group=WHAT, help="arguments of the environment, e.g. \"hazards:{'num': 4}\""
    )
    vec_env: Literal["native", "dummy", "subproc"] | None = flag(
        role=IDENTITY, group=WHAT,
        help="one batch, one by one, or a process each (default: native where it is possible)",
    )  # fmt: skip
    device: str = flag(
        default="auto", role=IDENTITY, group=WHAT, help="torch device (default: auto)"
    )
    gym_packages: list[str] = flag(
        default=[], metavar="MODULE", group=WHAT,
        help="modules to import first, since they register environments",
    )  # fmt: skip


@dataclass
class EvaluationFlags(Command):
    """How to evaluate while training, what to write, and what a run's process does."""

    eval_freq: int = flag(
        default=100_000, kind=steps, metavar="N", role=IDENTITY, group=EVALUATION,
        help="evaluate every N steps; -1 never (default: 100000)",
    )  # fmt: skip
    eval_episodes: int = flag(
        default=30, kind=positive, metavar="N", role=IDENTITY, group=EVALUATION,
        help="episodes each time, of the stochastic policy and of its mean (default: 30)",
    )  # fmt: skip
    n_eval_envs: int | None = flag(
        kind=positive, metavar="N", role=IDENTITY, group=EVALUATION,
        help="environments to evaluate in (default: one per episode if native, else 1)",
    )  # fmt: skip
    eval_env_kwargs: dict[str, Any] | None = flag(
        role=IDENTITY, group=EVALUATION,
        help="arguments of the evaluation environment (default: as in training)",
    )  # fmt: skip
    save_freq: int = flag(
        default=-1, kind=steps, metavar="N", role=IDENTITY, group=FILES,
        help="keep a model every N steps, rl_model_<N>_steps.zip; -1 none (default: -1)",
    )  # fmt: skip
    checkpoint_every: float = flag(
        default=10.0, kind=amount, metavar="S", role=HOST, group=FILES,
        help="least seconds between checkpoints to resume from (default: 10)",
    )  # fmt: skip
    tensorboard_log: str = flag(
        "-tb", default="", metavar="DIR", group=FILES, help="write TensorBoard events there"
    )
    track: bool = flag(
        default=False, role=HOST, group=FILES,
        help="send the run to Weights & Biases (needs wandb)",
    )  # fmt: skip
    wandb_project_name: str = flag(default="sb3_guard", group=FILES)
    wandb_entity: str | None = flag(group=FILES)
    wandb_group: str | None = flag(group=FILES)
    wandb_tags: list[str] = flag("-tags", default=[], group=FILES)
    log_interval: int = flag(
        default=-1, kind=interval, metavar="N", role=IDENTITY, group=RUNNING,
        help="log every N rollouts; -2 never (default: 1)",
    )  # fmt: skip
    num_threads: int = flag(
        default=-1, metavar="N", role=HOST, group=RUNNING,
        help="threads of torch and of the native engine (default: -1, their own choice)",
    )  # fmt: skip


@dataclass
class RunFlags(EvaluationFlags, TrainingFlags):
    """All flags of one run."""

    algo: str = flag(default="cpo", role=IDENTITY, group=WHAT, help="algorithm, e.g. cpo or trpo")
    env: str = flag(
        default="Goal_Point_8Hazards-v0", role=IDENTITY, group=WHAT,
        help="environment id; the version may be left out (default: Goal_Point_8Hazards)",
    )  # fmt: skip
    seed: int = flag(
        default=-1, kind=seed_or_random, role=IDENTITY, group=WHAT, exclusive="seeds",
        help="random seed (default: -1, a random one)",
    )  # fmt: skip
    trained_agent: str = flag(
        "-i", default="", metavar="PATH", role=IDENTITY, group=WHAT,
        help="a run folder or checkpoint.zip: continue that run in place, exactly; "
        "any other model.zip: begin a new run from that agent",
    )  # fmt: skip
    log_folder: str = flag(
        "-f", default="logs", metavar="DIR", group=FILES, help="where runs go (default: logs)"
    )
    uuid: bool = flag("-uuid", default=False, group=FILES, help="make the run folder's name unique")
    progress: bool | None = flag(
        "-P", role=HOST, group=RUNNING, help="progress bar (default: if stderr is a terminal)"
    )
    verbose: Literal[0, 1, 2] = flag(
        default=1, role=HOST, group=RUNNING, help="0 nothing, 1 progress, 2 all (default: 1)"
    )

    @classmethod
    def shared(cls, other: Command, **own: Any) -> Self:
        """
        A run's flags from those that another command shares with it.

        :param own: flags that the other command does not have, such as ``algo``
        """
        common = {name: value for name, value in other.values().items() if name in cls.names()}
        return cls.of({**common, **own})

    def check(self) -> None:
        """
        What can be said before anything heavy is imported.

        :raises UsageError: a package is absent that a flag needs
        """
        if self.track:
            try:
                import wandb  # noqa: F401
            except ImportError:
                raise UsageError(
                    "--track needs wandb; install it with: pip install wandb"
                ) from None

"""The flags of a run, as ``args.yml`` in its folder keeps them; other commands share some."""

import shlex
from dataclasses import dataclass
from typing import Any, Literal, Self

from sb3_guard.zoo.cli.flags import HOST, IDENTITY, Command, flag
from sb3_guard.zoo.cli.usage import (
    amount,
    explained,
    interval,
    positive,
    seed_or_random,
    steps,
)

# Flags beside those of role IDENTITY that a run is trained again with: hyperparameters are stated
# by its folder, and threads change the order of sums.
AGAIN = ("n_timesteps", "hyperparams", "conf_file", "env_kwargs", "gym_packages", "num_threads")


@dataclass
class TrainingFlags(Command):
    """
    How to train, whatever is trained.

    What is trained:

    :param n_timesteps: length of training, e.g. 1e6 (default: as in the hyper-parameter file)
    :param hyperparams: hyper-parameters that differ from the file, e.g. n_steps:500 cost_limit:25
    :param conf_file: hyper-parameters: 'paper' for the paper's table to the letter, 'omnisafe' for
        that library's published settings, a YAML file, or a Python file or module with a dict
        'hyperparams' (default: hyperparams/<algo>.yml)
    :param env_kwargs: arguments of the environment, e.g. "hazards:{'num': 4}"
    :param vec_env: one batch, one by one, or a process each (default: native where it is possible)
    :param device: torch device (default: auto)
    :param gym_packages: modules to import first, since they register environments
    """

    n_timesteps: int = flag("-n", default=-1, kind=positive, metavar="N")
    hyperparams: dict[str, Any] | None = flag("-params")
    conf_file: str | None = flag("-conf", metavar="FILE")
    env_kwargs: dict[str, Any] | None = flag()
    vec_env: Literal["native", "dummy", "subproc"] | None = flag(role=IDENTITY)
    device: str = flag(default="auto", role=IDENTITY)
    gym_packages: list[str] = flag(default=[], metavar="MODULE", role=HOST)


@dataclass
class EvaluationFlags(Command):
    """
    How to evaluate while training, what to write, and what a run's process does.

    Evaluation:

    :param eval_freq: evaluate every N steps; -1 never (default: 100000)
    :param eval_episodes: episodes each time, of the stochastic policy and of its mean (default: 30)
    :param n_eval_envs: environments to evaluate in (default: one per episode if native, else 1)
    :param eval_env_kwargs: arguments of the evaluation environment (default: as in training)

    Files:

    :param save_freq: keep a model every N steps, rl_model_<N>_steps.zip; -1 none (default: -1)
    :param checkpoint_every: least seconds between checkpoints to resume from (default: 10)
    :param tensorboard_log: write TensorBoard events there
    :param track: send the run to Weights & Biases (needs wandb)

    Running:

    :param log_interval: log every N rollouts; -2 never (default: 1)
    :param num_threads: threads of torch and of the native engine (default: -1, their own choice)
    """

    eval_freq: int = flag(default=100_000, kind=steps, metavar="N", role=IDENTITY)
    eval_episodes: int = flag(default=30, kind=positive, metavar="N", role=IDENTITY)
    n_eval_envs: int | None = flag(kind=positive, metavar="N", role=IDENTITY)
    eval_env_kwargs: dict[str, Any] | None = flag(role=IDENTITY)
    save_freq: int = flag(default=-1, kind=steps, metavar="N", role=IDENTITY)
    checkpoint_every: float = flag(default=10.0, kind=amount, metavar="S", role=HOST)
    tensorboard_log: str = flag("-tb", default="", metavar="DIR", role=HOST)
    track: bool = flag(default=False, role=HOST)
    wandb_project_name: str = flag(default="sb3_guard")
    wandb_entity: str | None = flag()
    wandb_group: str | None = flag()
    wandb_tags: list[str] = flag("-tags", default=[])
    log_interval: int = flag(default=-1, kind=interval, metavar="N", role=IDENTITY)
    num_threads: int = flag(default=-1, metavar="N", role=HOST)


@dataclass
class RunFlags(EvaluationFlags, TrainingFlags):
    """
    All flags of one run.

    What is trained:

    :param algo: algorithm, e.g. cpo or trpo
    :param env: environment id; the version may be left out (default: Goal_Point_8Hazards)
    :param seed: random seed (default: -1, a random one)
    :param trained_agent: a run folder or checkpoint.zip: continue that run in place, exactly; any
        other model.zip: begin a new run from that agent, with the observation statistics in
        <model>_vecnormalize.pkl or */vecnormalize.pkl beside it

    Files:

    :param log_folder: where runs go (default: logs)
    :param uuid: make the run folder's name unique

    Running:

    :param progress: progress bar (default: if stderr is a terminal)
    :param verbose: 0 nothing, 1 progress, 2 all (default: 1)
    """

    algo: str = flag(default="cpo", role=IDENTITY)
    env: str = flag(default="Goal_Point_8Hazards-v0", role=IDENTITY)
    seed: int = flag(default=-1, kind=seed_or_random, role=IDENTITY, exclusive="seeds")
    trained_agent: str = flag("-i", default="", metavar="PATH", role=IDENTITY)
    log_folder: str = flag("-f", default="logs", metavar="DIR")
    uuid: bool = flag("-uuid", default=False)
    progress: bool | None = flag("-P", role=HOST)
    verbose: Literal[0, 1, 2] = flag(default=1, role=HOST)

    @classmethod
    def shared(cls, other: Command, **own: Any) -> Self:
        """
        A run's flags from those that another command shares with it.

        :param own: flags that the other command does not have, such as ``algo``
        """
        common = {name: value for name, value in other.values().items() if name in cls.names()}
        return cls.of({**common, **own})

    def command(self) -> str:
        """The command line that trains the same run again, wherever its files go."""
        names = {*self.names(IDENTITY), *AGAIN} - {"algo", "env"}
        words = ["--algo", self.algo, "--env", self.env, *self.words(names)]
        return shlex.join(["sb3-guard", "train", *words])

    def check(self) -> None:
        """
        What can be said before anything heavy is imported.

        :raises UsageError: a package is absent that a flag needs
        """
        if self.track:
            fix = "install it with: pip install wandb"
            with explained("--track needs wandb", ImportError, fix=fix):
                import wandb  # noqa: F401

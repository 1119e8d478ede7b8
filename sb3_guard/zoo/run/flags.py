"""The flags of a run, as ``args.yml`` in its folder keeps them; other commands share some."""

import shlex
from dataclasses import dataclass
from typing import Any, Literal, Self

from sb3_guard.zoo.cli.flags import HOST, IDENTITY, Command, flag

# Flags beside those of role IDENTITY that a run is trained again with: hyperparameters are stated
# by its folder, and threads change the order of sums.
AGAIN = ("n_timesteps", "hyperparams", "conf_file", "env_kwargs", "gym_packages", "num_threads")


@dataclass
class TrainingFlags(Command):
    """
    How to train, whatever is trained.

    What is trained:

    :param n_timesteps: number of training steps, e.g. 1e6 (default: n_timesteps of the
        hyperparameter file, else 1e6)
    :param hyperparams: hyperparameters that replace the defaults, e.g. n_steps:500 cost_limit:25
    :param conf_file: hyperparameters: 'paper' for the GUARD paper's table, an algorithm, a YAML
        file, or a Python file or module with 'hyperparams' (default: those of --algo or its base)
    :param env_kwargs: arguments of the environment, e.g. "hazards:{'num': 4}"
    :param vec_env: how environments are stepped: native (one batch), dummy (one after another),
        subproc (one process each) or gymnasium (the vector environment registered for the id, else
        dummy); default: native if the environment supports it, else dummy
    :param device: torch device (default: auto)
    :param gym_packages: modules to import before training, which register environments, parts or
        algorithms
    """

    n_timesteps: int = flag("-n", default=-1, low=1, metavar="N")
    hyperparams: dict[str, Any] | None = flag("-params")
    conf_file: str | None = flag("-conf", metavar="FILE")
    env_kwargs: dict[str, Any] | None = flag()
    vec_env: Literal["native", "dummy", "subproc", "gymnasium"] | None = flag(role=IDENTITY)
    device: str = flag(default="auto", role=IDENTITY)
    gym_packages: list[str] = flag(default=[], metavar="MODULE", role=HOST)


@dataclass
class EvaluationFlags(Command):
    """
    How to evaluate while training, what to write, and what a run's process does.

    Evaluation:

    :param eval_freq: steps between evaluations; -1: no evaluation (default: 100000)
    :param eval_episodes: episodes per evaluation, with sampled actions and again with the most
        likely ones (default: 30)
    :param n_eval_envs: number of environments to evaluate in (default: one per episode if native,
        else 1)
    :param eval_env_kwargs: arguments of the evaluation environment (default: those of training)
    :param certify: end with a policy that is certified by so many fresh episodes, at least 100; 0:
        with the last policy (default: 600 if the training has the steps of 1,000 full episodes,
        else 0)

    Files:

    :param save_freq: steps between models that are kept as rl_model_<N>_steps.zip; -1: keep none
        (default: -1)
    :param checkpoint_every: least number of seconds between checkpoints to resume from (default:
        10)
    :param tensorboard_log: folder for TensorBoard events (default: none)
    :param track: send the run to Weights & Biases (needs wandb)

    Running:

    :param log_interval: updates between lines of the log; -1: every update, -2: no log (default:
        -1)
    :param num_threads: threads of torch and of the native engine; -1: chosen by each of them
        (default: -1)
    """

    eval_freq: int = flag(default=100_000, metavar="N", role=IDENTITY)
    eval_episodes: int = flag(default=30, low=1, metavar="N", role=IDENTITY)
    n_eval_envs: int | None = flag(low=1, metavar="N", role=IDENTITY)
    eval_env_kwargs: dict[str, Any] | None = flag(role=IDENTITY)
    certify: int | None = flag(low=0, metavar="N", role=IDENTITY)
    save_freq: int = flag(default=-1, metavar="N", role=IDENTITY)
    checkpoint_every: float = flag(default=10.0, low=0, metavar="S", role=HOST)
    tensorboard_log: str = flag("-tb", default="", metavar="DIR", role=HOST)
    track: bool = flag(default=False, role=HOST)
    wandb_project_name: str = flag(default="sb3_guard")
    wandb_entity: str | None = flag()
    wandb_group: str | None = flag()
    wandb_tags: list[str] = flag("-tags", default=[])
    log_interval: int = flag(default=-1, low=-2, metavar="N", role=IDENTITY)
    num_threads: int = flag(default=-1, metavar="N", role=HOST)


@dataclass
class RunFlags(EvaluationFlags, TrainingFlags):
    """
    All flags of one run.

    What is trained:

    :param algo: algorithm, e.g. cpo or trpo (default: cpo)
    :param env: environment id; the version may be left out (default: Goal_Point_8Hazards)
    :param seed: random seed; -1: a random one (default: -1)
    :param trained_agent: run folder or checkpoint.zip: continue that run in place, bit for bit; any
        other model.zip: start a new run from that agent, with the observation statistics in
        <model>_vecnormalize.pkl or */vecnormalize.pkl next to it

    Files:

    :param log_folder: folder for runs (default: logs)
    :param uuid: add a unique suffix to the run folder's name

    Running:

    :param progress: show a progress bar
    :param verbose: output: 0 nothing, 1 progress, 2 everything (default: 1)
    """

    algo: str = flag(default="cpo", role=IDENTITY)
    env: str = flag(default="Goal_Point_8Hazards-v0", role=IDENTITY)
    seed: int = flag(default=-1, high=2**32, role=IDENTITY)
    trained_agent: str = flag("-i", default="", metavar="PATH", role=IDENTITY)
    log_folder: str = flag("-f", default="logs", metavar="DIR")
    uuid: bool = flag("-uuid", default=False)
    progress: bool = flag("-P", default=False, role=HOST)
    verbose: Literal[0, 1, 2] = flag(default=1, role=HOST)

    @classmethod
    def shared(cls, other: Command, **own: Any) -> Self:
        """
        A run's flags from those that another command shares with it.

        :param own: flags that the other command does not have, such as ``algo``
        """
        common = {name: value for name, value in other.values().items() if name in cls.names()}
        return cls.of({**common, **own})

    def overrides(self) -> dict[str, Any]:
        """The hyperparameters that the flags state."""
        length = {"n_timesteps": self.n_timesteps} if self.n_timesteps > 0 else {}
        return {**(self.hyperparams or {}), **length}

    def command(self) -> str:
        """The command line that trains the same run again, wherever its files go."""
        names = {*self.names(IDENTITY), *AGAIN} - {"algo", "env"}
        words = ["--algo", self.algo, "--env", self.env, *self.words(names)]
        return shlex.join(["sb3-guard", "train", *words])

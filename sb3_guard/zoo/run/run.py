"""One training run: checked in full first, then made and trained, started or continued.

RL-Zoo's ``ExperimentManager`` makes the run folder before it has looked at the hyperparameters,
and resets counters, seeds and environments when it continues; so its pieces are used here
(schedules, run numbers, file layout, flags) and its class is not.
"""

import copy
import dataclasses
import pickle
import shlex
import signal
import sys
import time
import uuid
import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext, suppress
from dataclasses import dataclass, field
from functools import cache, cached_property
from multiprocessing.util import register_after_fork
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import RecordVideo
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecMonitor, VecNormalize
from stable_baselines3.common.vec_env.vec_video_recorder import VecVideoRecorder

from sb3_guard.algorithms.common.constrained import Constrained
from sb3_guard.algorithms.common.costs import limits_at, time_limit
from sb3_guard.common.callbacks import CostEvalCallback, LogCosts
from sb3_guard.common.certificate import Certificate
from sb3_guard.common.delivery import FINAL_EPISODES, DeliveryCallback, play_final
from sb3_guard.common.evaluation import (
    Evaluation,
    check_normalizer,
    evaluate_policy,
    sync_normalization,
)
from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import find_monitor
from sb3_guard.common.sources import Source
from sb3_guard.common.vec_env import make_vec_env
from sb3_guard.costs import read_costs
from sb3_guard.fields import plain
from sb3_guard.judging import EPISODES, Limits
from sb3_guard.vector import moments_of, normalizer_of
from sb3_guard.zoo.cli.flags import IDENTITY, START
from sb3_guard.zoo.cli.names import FOLLOWED, classes, require_named
from sb3_guard.zoo.cli.usage import (
    TrainingStopped,
    UsageError,
    explained,
    import_packages,
    interrupts,
    one_line,
)
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.checkpoint import (
    Checkpoints,
    Interrupted,
    ResumableEnv,
    load_model,
    read_checkpoint,
    read_normalizer,
)
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import PLAYED, RunFolder, is_run, lock, run_path, write_config
from sb3_guard.zoo.run.hyperparams import (
    action_noise,
    check,
    merged,
    model_arguments,
    nearest,
    normalization,
    read_hyperparams,
    usual_limit,
)
from sb3_guard.zoo.run.logger import RunLogger, cut
from sb3_guard.zoo.run.make_envs import (
    BAD_ARGUMENTS,
    BAD_NUMBERS,
    PROCESS_DIED,
    evaluation_seed,
    seed_rows,
    source_of,
)
from sb3_guard.zoo.run.progress import Epochs, summary

CERTIFICATE_ENVS = 100  # in which the last policy is played, and certificates are
say_once = cache(print)  # a line that is the same for many runs of a grid
WANDB = "wandb.txt"  # beside the run's configuration: its id at Weights & Biases


@dataclass
class Run:
    """
    One training run: its flags and hyperparameters, which its folder states, are all that it is.

    The algorithm, the source of environments and the objects that hyperparameters name are looked
    up once, when they are first needed; :meth:`make` makes the rest.

    :param flags: all flags, as :meth:`check` completes them
    :param hyperparams: all hyperparameters, plain data
    :param folder: the folder of the run to continue; None: a new run
    """

    flags: RunFlags
    hyperparams: dict[str, Any] = field(default_factory=dict)
    folder: RunFolder | None = None

    def __post_init__(self) -> None:
        if self.flags.track:
            import wandb  # noqa: F401  if it is absent, nothing begins

            log = self.flags.tensorboard_log or "runs"
            self.flags = dataclasses.replace(self.flags, tensorboard_log=log)
        self.model: BaseAlgorithm
        self.env: VecEnv
        self.callbacks: list[BaseCallback]
        self.evaluation: CostEvalCallback | None = None
        #: what to continue from
        self.begun: dict[str, Any] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process gets what the run states, without what was looked up or made here."""
        return type(self), tuple(getattr(self, entry.name) for entry in dataclasses.fields(self))

    @cached_property
    def algorithm(self) -> type[BaseAlgorithm]:
        """The class of ``--algo``; raises :class:`UsageError` where there is none."""
        return algorithm(self.flags.algo)

    @cached_property
    def source(self) -> Source:
        """The environments of ``--env``; raises :class:`UsageError` where there are none."""
        return source_of(self.flags.env)

    @cached_property
    def arguments(self) -> dict[str, Any]:
        """Of the algorithm; raises :class:`UsageError` where a name means nothing."""
        return model_arguments(self.hyperparams)

    def wrappers(self, kind: str, evaluation: bool = False) -> list[tuple[Any, dict[str, Any]]]:
        """
        The classes that ``env_wrapper`` or ``vec_env_wrapper`` names, and their arguments.

        :param evaluation: without what ends episodes early, changes rewards, or writes files
        """
        wrappers = []
        for cls, arguments in classes(kind, self.hyperparams.get(kind)):
            if evaluation:
                written = ["filename"] if issubclass(cls, (Monitor, VecMonitor)) else []
                for name in (*written, *getattr(cls, "training_arguments", ())):
                    arguments.pop(name, None)
            records = issubclass(cls, (RecordVideo, VecVideoRecorder))
            if not (evaluation and (records or getattr(cls, "training_only", False))):
                wrappers.append((cls, arguments))
        return wrappers

    @property
    def constrained(self) -> bool:
        """Whether the algorithm keeps a cost limit."""
        return getattr(self.algorithm, "constrained", False)

    @property
    def cost_keys(self) -> tuple[str, ...]:
        """Entries of info that are costs."""
        ours = hasattr(self.algorithm, "constrained")
        values = self.arguments if ours else self.hyperparams.get("monitor_kwargs", {})
        return tuple(values.get("cost_keys") or ("cost",))

    # Checked

    @classmethod
    def check(cls, flags: RunFlags, source: Source | None = None) -> Self:
        """
        A new run, checked as far as that goes without making anything.

        :param flags: those given; the rest follows from files and defaults
        :param source: the environments, where ``flags.env`` is not registered
        :raises UsageError: anything is wrong with them
        """
        flags = dataclasses.replace(flags)
        import_packages(flags.gym_packages)  # which may register algorithms, too
        run = cls(flags)
        flags = run.flags
        algo = run.algorithm
        if source is not None:
            run.source = source
        flags.env = run.source.env_id
        if flags.seed < 0:
            flags.seed = int(np.random.default_rng().integers(2**31))
        values = read_hyperparams(flags.algo, flags.env, flags.conf_file, flags.overrides())
        values = run.hyperparams = check(flags.algo, algo, values)
        base = nearest(flags.algo, flags.conf_file)
        if flags.verbose and base != flags.algo:
            say_once(f"hyperparameters of {flags.algo}: those of {base}")
        if run.constrained and "cost_limit" not in values:
            other = "cost_keys" in values or getattr(algo, "limit_on", "sum") == "max"
            limit = None if other else usual_limit(flags.env)
            if limit is None:
                raise UsageError(
                    f"no cost limit is known for {flags.env}: give cost_limit, the highest cost of "
                    "an episode that you accept, such as half of what an episode costs PPO "
                    "(-params cost_limit:25)"
                )
            values["cost_limit"] = limit
            if flags.verbose:
                say_once(f"cost_limit of {flags.algo} on {flags.env}: {limit:g}, the usual one")
        if flags.env_kwargs:
            values["env_kwargs"] = merged(values.get("env_kwargs") or {}, flags.env_kwargs)
        # What wraps single environments needs single ones.
        lone = values.get("env_wrapper") is not None
        flags.vec_env = run.source.stepped(flags.vec_env, lone)
        return run

    def limits(self) -> Limits:
        """
        Episode costs up to which a model of this run counts as safe.

        :raises UsageError: ``selection_limit`` does not fit the cost keys
        """
        values, m = self.hyperparams, len(self.cost_keys)
        limit = limits_at(values.get("cost_limit"), 0.0) if self.constrained else np.inf
        limits = Limits(np.broadcast_to(np.asarray(limit, float), m), self.cost_keys)
        with explained("hyperparameter", ValueError):
            return limits.to_choose(values.get("selection_limit"))

    def try_out(self) -> None:
        """
        Take a step in one environment, so that nothing is begun that fails for want of a cost.

        :raises UsageError: the environment refuses a value, or has no cost
        """
        vec_env = "dummy" if self.flags.vec_env == "subproc" else self.flags.vec_env
        env = self.make_envs(1, self.flags.seed, vec_env=vec_env)
        env.action_space.seed(self.flags.seed)
        with closing(env), explained(f"{self.flags.env} fails at its first step", *BAD_NUMBERS):
            env.reset()
            infos = env.step(np.array([env.action_space.sample()]))[3]
            if self.constrained:
                optional = self.hyperparams.get("missing_cost") == "zero"
                read_costs(infos, self.cost_keys, zero_if_missing=optional)

    # Made

    def make(self) -> Self:
        """
        Make model, environments, callbacks and evaluation; nothing is written.

        :return: the same run, whose :meth:`close` releases them
        :raises UsageError: something can't be made, or is not there
        """
        flags = self.flags
        self.try_out()
        named = classes("callback", self.hyperparams.get("callback"))
        with explained("a callback can't be made"):
            self.callbacks = [cls(**arguments) for cls, arguments in named]
        if self.folder is not None:
            self.begun = read_checkpoint(self.folder.checkpoint)
        self.model = self.make_model()
        self.env = self.model.get_env()  # type: ignore[assignment]
        try:
            self.model.verbose = max(flags.verbose - 1, 0)
            self.limits()
            self.evaluation = self._make_evaluation()
            if self.evaluation is not None:
                self.evaluation.model = self.model
        except BaseException:
            self.close()
            raise
        return self

    def _make_evaluation(self) -> CostEvalCallback | None:
        """The callback that evaluates, and delivers where the training ends with a certificate."""
        flags, episodes = self.flags, self._certificate_episodes()
        if flags.eval_freq <= 0 and not episodes:
            return None
        how: dict[str, Any] = {
            "selection_limit": self.hyperparams.get("selection_limit"),
            "seed": evaluation_seed(flags.seed),
            "n_eval_episodes": flags.eval_episodes,
            "eval_freq": max(flags.eval_freq // self.hyperparams["n_envs"], flags.eval_freq > 0),
            "verbose": int(flags.verbose > 0),
        }
        env = self.make_evaluation_envs(flags.eval_episodes)
        if not episodes:
            return CostEvalCallback(env, **how)
        with explained("--certify", ValueError):
            return DeliveryCallback(
                env,
                certificate_env=self.make_evaluation_envs(CERTIFICATE_ENVS),
                n_episodes=episodes,
                final_seed=evaluation_seed(flags.seed, 1),
                **how,
            )

    @property
    def delivery(self) -> DeliveryCallback | None:
        """The callback that ends the training with a certificate, if there is one."""
        return self.evaluation if isinstance(self.evaluation, DeliveryCallback) else None

    def _certificate_episodes(self) -> int:
        """Episodes of the certificate that the training ends with; 0: it ends without one."""
        if not self.constrained or self.flags.certify is not None:
            return self.constrained * (self.flags.certify or 0)
        episode = time_limit(self.env)  # None: unknown
        return EPISODES if episode and self.hyperparams["n_timesteps"] >= 1000 * episode else 0

    def close(self) -> None:
        """Release the environments."""
        evaluation, delivery = self.evaluation, self.delivery
        others = [evaluation.eval_env] if evaluation else []
        others += [delivery.certificate_env] if delivery else []
        for env in (self.env, *others):
            if getattr(env.unwrapped, "waiting", False):  # SubprocVecEnv, for answers that are lost
                for process in getattr(env.unwrapped, "processes", ()):
                    process.terminate()
            with suppress(*PROCESS_DIED):
                env.close()

    def _tracked(self, folder: RunFolder) -> AbstractContextManager[Any]:
        """The run at Weights & Biases, which sends the TensorBoard files that are opened later."""
        if not self.flags.track:
            return nullcontext()
        import wandb

        flags, file = self.flags, folder.params / WANDB
        if not file.exists():
            file.write_text(uuid.uuid4().hex)
        return wandb.init(
            id=file.read_text(),
            resume="allow",
            name=f"{flags.env}__{flags.algo}__{flags.seed}",
            project=flags.wandb_project_name,
            entity=flags.wandb_entity,
            group=flags.wandb_group,
            tags=flags.wandb_tags,
            config={**flags.values(), "hyperparams": self.hyperparams},
            sync_tensorboard=True,
        )

    def make_envs(
        self,
        n_envs: int,
        seed: int | None,
        *,
        vec_env: str | None = None,
        env_kwargs: Mapping[str, Any] | None = None,
        evaluation: bool = False,
        normalizer: VecNormalize | None = None,
        render_mode: str | None = None,
    ) -> VecEnv:
        """
        Environments of this run: monitor, ``vec_env_wrapper``, VecNormalize, frame stack; of an
        algorithm with a replay buffer VecNormalize is the outermost.

        :param n_envs: how many
        :param seed: the environments get seed, seed + 1, …
        :param vec_env: native, dummy, subproc or gymnasium; None: that of the flags
        :param env_kwargs: arguments of the environment; None: those of training
        :param evaluation: observations are normalised with given statistics, rewards not at all,
            and wrappers that are ``training_only`` and their ``training_arguments`` are left out
        :param normalizer: statistics to begin with; it is given the environment
        :param render_mode: as for :func:`gymnasium.make`
        :raises UsageError: the environment refuses an argument, or can't be made
        """
        flags, values, source = self.flags, self.hyperparams, self.source
        vec_env = vec_env or flags.vec_env
        packages, single = flags.gym_packages, self.wrappers("env_wrapper", evaluation)

        def make(**arguments: Any) -> gym.Env:
            if vec_env == "subproc":  # Ctrl-C is for the run, which finishes its rollout
                signal.signal(signal.SIGINT, signal.SIG_IGN)
            import_packages(packages)  # which a process of its own has not imported
            return source.make(**arguments)

        if vec_env == "gymnasium":  # the same, for processes that the environment starts itself
            register_after_fork(self, lambda _: signal.signal(signal.SIGINT, signal.SIG_IGN))

        def wrap(env: gym.Env) -> gym.Env:
            for cls, arguments in single:
                env = cls(env, **arguments)
            return ResumableEnv(env)

        monitored = {"cost_keys": self.cost_keys, **values.get("monitor_kwargs", {})}
        errors = (*BAD_ARGUMENTS, *PROCESS_DIED, MemoryError)
        with ExitStack() as made:
            with explained(f"can't make {source.env_id}", *errors):
                env = make_vec_env(
                    source._replace(make=make),
                    n_envs,
                    seed,
                    vec_env=vec_env,
                    env_kwargs=values.get("env_kwargs") if env_kwargs is None else env_kwargs,
                    num_threads=flags.num_threads if flags.num_threads > 0 else None,
                    render_mode=render_mode,
                    wrapper_class=wrap if single or vec_env in ("dummy", "subproc") else None,
                    monitor_kwargs=monitored,
                )
                made.callback(env.close)
            with explained(f"can't wrap {source.env_id}", *BAD_ARGUMENTS):
                for cls, arguments in self.wrappers("vec_env_wrapper", evaluation):
                    env = cls(env, **arguments)
                # A replay buffer keeps what VecNormalize is given, which thus has all of it.
                if replays := issubclass(self.algorithm, OffPolicyAlgorithm):
                    env = self._reshaped(env)
                if normalizer is None and (beside := self._statistics_beside()) is not None:
                    normalizer = read_normalizer(beside)
                env = self._normalized(env, normalizer)
                if evaluation and isinstance(env, VecNormalize):
                    env.training = env.norm_reward = False
            made.pop_all()
        return env if replays else self._reshaped(env)

    def _normalized(self, env: VecEnv, normalizer: VecNormalize | None) -> VecEnv:
        """Normalised by given statistics, or by new ones if ``normalize`` asks for any."""
        if normalizer_of(env) is not None:
            raise ValueError("VecNormalize in vec_env_wrapper: use normalize instead")
        scaled = normalization(self.hyperparams)
        new = env if scaled is None else VecNormalize(env, **scaled)
        if normalizer is None:
            return new
        check_normalizer(normalizer, env.observation_space)
        if moments_of(new).keys() - moments_of(normalizer).keys():
            raise ValueError("observation statistics lack some that normalize asks for")
        normalizer.set_venv(env)
        return normalizer

    def _reshaped(self, env: VecEnv) -> VecEnv:
        """Frames stacked, and images channels first, in evaluation as in training."""
        if frames := self.hyperparams.get("frame_stack"):
            env = VecFrameStack(env, frames)
        return BaseAlgorithm._wrap_env(env, monitor_wrapper=False)

    def make_evaluation_envs(self, episodes: int) -> VecEnv:
        """
        Environments to play so many episodes in, with costs and observations as in training.

        :raises UsageError: the environment refuses a value
        """
        flags, number = self.flags, self.flags.n_eval_envs
        if number is None:
            # All episodes at once where that is cheap; a process each would not be.
            number = episodes if flags.vec_env == "native" else 1
        seed, kwargs = evaluation_seed(flags.seed), flags.eval_env_kwargs
        return self.make_envs(number, seed, evaluation=True, env_kwargs=kwargs)

    def make_model(self) -> BaseAlgorithm:
        """
        The model with its environments, seeded: what ``learn`` does next is settled.

        :raises UsageError: the environment, the algorithm or a wrapper refuses a value, or the
            device is not there
        """
        flags = self.flags
        # SB3 would train on the CPU instead of a GPU that is not there.
        with explained(f"device {flags.device!r} is not allowed"):
            th.empty(0, device="cpu" if flags.device == "auto" else flags.device)
        if flags.num_threads > 0:
            th.set_num_threads(flags.num_threads)
        set_random_seed(flags.seed)
        env = self.make_envs(self.hyperparams["n_envs"], flags.seed)
        if time_limit(env) is None:
            advice = "env_kwargs max_episode_steps:1000 sets one, if its episodes do not end"
            warnings.warn(f"{flags.env} states no time limit: {advice}", stacklevel=2)
        try:
            model = self._make_model(env)
            seed_rows(env, flags.seed)
        except BaseException:
            env.close()
            raise
        return model

    def _make_model(self, env: VecEnv) -> BaseAlgorithm:
        flags = self.flags
        if self.folder is not None:
            return load_model(self.algorithm, self.folder.checkpoint, env, flags.device)
        arguments = copy.deepcopy(self.arguments)  # some algorithms add to their policy_kwargs
        arguments["seed"] = flags.seed
        if flags.trained_agent:
            # What the networks are is for the saved agent to say.
            for name in ("policy", "policy_kwargs"):
                arguments.pop(name, None)
            path = Path(flags.trained_agent)
            if self.hyperparams.get("normalize") and self._statistics_beside() is None:
                print(f"no vecnormalize.pkl next to {path}: observation statistics begin anew")
            return load_model(self.algorithm, path, env, flags.device, **arguments)
        space = env.action_space
        noise = action_noise(self.hyperparams, space) if isinstance(space, spaces.Box) else None
        if noise is not None:
            arguments["action_noise"] = noise
        errors = (*BAD_ARGUMENTS, RuntimeError, MemoryError)
        with warnings.catch_warnings(), explained(f"{flags.algo} can't be made", *errors):
            if not {"batch_size", "n_envs", "n_steps"} & {*(flags.hyperparams or {})}:
                # The sizes of a file are on purpose, a last minibatch that is smaller included.
                warnings.filterwarnings("ignore", "You have specified a mini-batch size")
            return self.algorithm(env=env, device=flags.device, **arguments)

    def _statistics_beside(self) -> Path | None:
        """Observation statistics that a run or an evaluation wrote next to its model."""
        agent = Path(self.flags.trained_agent)
        if self.folder is not None or not agent.name or not self.hyperparams.get("normalize"):
            return None
        best = agent.with_name(f"{agent.stem}_vecnormalize.pkl")  # of best_model.zip
        if best.is_file():
            return best
        return min(agent.parent.glob("*/vecnormalize.pkl"), default=None)

    # Trained

    def start(self) -> int:
        """
        Train a new run in a folder of its own.

        :return: exit status, see :meth:`train`
        :raises UsageError: something can't be made; nothing has been written then
        """
        with closing(self.make()):
            folder = RunFolder.create(self.flags, self.hyperparams, shlex.join(sys.orig_argv))
            with lock(folder.path):
                return self.train(folder)

    @property
    def path(self) -> Path:
        """The folder of a run of a grid, whose number is its seed's."""
        flags = self.flags
        return run_path(flags.log_folder, flags.algo, flags.env, flags.seed + 1)

    def standing(self) -> str:
        """
        How far a run of a grid is: ``new``, ``done``, or to ``resume``.

        :raises UsageError: its folder holds another run, or is damaged
        """
        if not is_run(self.path):
            return "new"
        folder = RunFolder(self.path)
        there = Run(folder.flags(), folder.hyperparams())
        if others := differences(there.identity, self.identity):
            words = [f"{name}: {a} there, {b} here" for name, a, b in others[:3]]
            raise UsageError(
                f"{self.path} holds another run ({'; '.join(words)}); choose another folder with -f"
            )
        if folder.read_result() is not None:
            return "done"
        # Without a checkpoint nothing of it is worth keeping, and it restarts in its place.
        return "resume" if folder.checkpoint.exists() else "new"

    def complete(self, command: str, asked_to_stop: Callable[[], bool] = lambda: False) -> int:
        """
        Bring a run of a grid to its end: start it, or continue it from where it was cut.

        :param command: the command line it is part of
        :param asked_to_stop: when it says so, training ends after the rollout under way
        :return: exit status, 0 if it is complete, now or already before
        :raises RunInUse: another process has the run
        :raises UsageError: it can't be trained, or the folder holds another run
        """
        flags, values, path = self.flags, self.hyperparams, self.path
        import_packages(flags.gym_packages)
        with explained(f"can't make folder {path}", OSError):
            path.mkdir(parents=True, exist_ok=True)
        with lock(path):
            state = self.standing()
            if state == "done":
                return 0
            folder = RunFolder(path) if is_run(path) else None
            quiet = dataclasses.replace(flags, progress=False, verbose=0)
            run = Run(quiet, values, folder if state == "resume" else None)
            with closing(run.make()):
                folder = folder or RunFolder.create(flags, values, command, path)
                return run.train(folder, asked_to_stop)

    @classmethod
    def resume(cls, given: RunFlags) -> int:
        """
        Continue a run in its folder.

        :param given: the flags given now; ``trained_agent`` is the run's folder or checkpoint
        :return: exit status, see :meth:`train`
        :raises UsageError: the run can't be continued, or a flag contradicts what it is
        """
        folder = RunFolder(Path(given.trained_agent))
        with lock(folder.path):
            saved = folder.flags()
            require_named(folder.path, given, saved, *FOLLOWED)
            import_packages(given.gym_packages)
            state = read_checkpoint(folder.checkpoint)
            changed = {name: getattr(given, name) for name in {*given.given, "progress", "verbose"}}
            changed |= {name: getattr(saved, name) for name in ("trained_agent", "hyperparams")}
            run = cls(dataclasses.replace(saved, **changed), folder=folder)
            run.flags.env = run.source.env_id
            overrides = given.overrides()
            values = {**folder.hyperparams(), **overrides}
            run.hyperparams = check(saved.algo, algorithm(saved.algo), values)
            free = {"n_timesteps": None, "log_folder": None}
            was = {**saved.values(START), **state["identity"], **free}
            now = {**run.flags.values(START), **run.identity, **free}
            for name, old, new in differences(was, now):
                raise UsageError(
                    f"{name} = {new} contradicts {old}, with which {folder.path} was trained; put "
                    "it back or leave it out, or start a new run with it, without -i"
                )
            done, total = state["num_timesteps"], run.hyperparams["n_timesteps"]
            if 0 < given.n_timesteps < done or (total <= done and folder.read_result() is not None):
                print(f"{folder.path} is finished: {done} steps; a larger -n continues it")
                return 0
            with closing(run.make()):
                return run.train(folder)

    @property
    def identity(self) -> dict[str, Any]:
        """What makes a run the run it is: flags of that role, and hyperparameters."""
        return plain({**self.flags.values(IDENTITY), **self.hyperparams})

    def train(self, folder: RunFolder, asked_to_stop: Callable[[], bool] = lambda: False) -> int:
        """
        Train what was made to the end, or to an interrupt, and report.

        :param folder: the run's folder, owned by this process
        :param asked_to_stop: training ends after the rollout under way when this says so
        :return: exit status: 0, or 128 + the signal's number when interrupted
        :raises UsageError: training can't continue
        """
        state, flags, verbose = self.begun, self.flags, self.flags.verbose > 0
        if verbose:
            print(f"Run folder: {folder.path} (seed {flags.seed})")
            self._advise()
        tracked = self._tracked(folder)
        with explained(f"can't write to {folder.path}", OSError):
            # Two lines of the csv are no episodes.
            goes_on = state is not None and cut(folder.monitor, 2 + state["episodes"])
            find_monitor(self.env).log_to(folder.monitor, append=goes_on)
            logger = RunLogger(
                folder.path,
                stdout=verbose,
                tensorboard=folder.events(flags) if flags.tensorboard_log else None,
                state=None if state is None else state["logger"],
            )
        self.model.set_logger(logger)

        def stop(number: int) -> None:
            if verbose:
                print("\nStopping after this rollout; Ctrl-C again stops now.", file=sys.stderr)

        began = time.monotonic()
        wrappers = [*self.wrappers("env_wrapper"), *self.wrappers("vec_env_wrapper")]
        cut_short = any(getattr(cls, "training_only", False) for cls, _ in wrappers)
        epochs = Epochs(cut_short)
        with tracked, interrupts(stop) as received:
            checkpoints = self._checkpoints(
                folder, epochs, lambda: bool(received) or asked_to_stop()
            )
            if state is not None:
                checkpoints.restore(self.model, state)
                # In this order, and only now: a result in the folder is always that of its config.
                folder.result.unlink(missing_ok=True)
                write_config(folder.params, flags, self.hyperparams)
            finished = self._learn(folder, checkpoints)
            logger.close()
            result = self._finish(folder, epochs.result(), finished)
        if verbose:
            words = "Finished" if finished else "Interrupted"
            seconds = time.monotonic() - began
            print(f"{words} at {result['n_timesteps']:,} steps, {seconds:.0f} s")
            print(f"  last epoch         {summary(result)}\n  run folder         {folder.path}")
            if finished:
                if self.delivery and self.delivery.certificate:
                    self._beside_standing(self.delivery.certificate, self.delivery.eval_env)
                print(f"  see the agent      {folder.play()}")
            else:
                print(f"  continue with      {folder.again()}")
        return 0 if finished else 128 + (received or [signal.SIGTERM])[0]

    def _advise(self) -> None:
        """Say it where a training has so few updates or episodes that little is learnt."""
        steps, model = self.hyperparams["n_timesteps"], self.model
        size = model.n_envs * model.n_steps if isinstance(model, OnPolicyAlgorithm) else 0
        episode = int(time_limit(self.env) or 1)
        if not size or steps < 10_000 or steps >= 10 * max(size, 20 * episode):
            return
        updates, least = max(steps // size, 1), 600 * episode
        words = f"Only {updates} update{'s' * (updates > 1)} in {steps:,} steps"
        if length := steps // least * episode:
            how = f"-params n_envs:20 n_steps:{length} makes {steps // (20 * length)}"
        else:
            words = f"{steps:,} steps are {steps // episode:,} episodes: too few"
            how = f"at least {least:,}, 30 updates of 20 episodes"
        print(f"{words}; {how}")

    def _beside_standing(self, certificate: Certificate, env: VecEnv) -> None:
        """Say it where a delivered agent does no better than one that does nothing."""
        standing = standing_return(env, evaluation_seed(self.flags.seed))
        if standing is not None and certificate.mean_return <= standing:
            print(f"  no better than standing still, of return {standing:.4g} in one episode")

    def _checkpoints(
        self, folder: RunFolder, epochs: Epochs, asked_to_stop: Callable[[], bool]
    ) -> Checkpoints:
        """The callback that writes checkpoints, which has all others."""
        flags = self.flags
        others: list[BaseCallback] = [epochs]
        if not isinstance(self.model, Constrained):
            others.append(LogCosts())
        if flags.save_freq > 0:
            every = max(flags.save_freq // self.hyperparams["n_envs"], 1)
            others.append(CheckpointCallback(every, str(folder.path), save_vecnormalize=True))
        if self.evaluation is not None:
            self.evaluation.log_path = str(folder.path / "evaluations")
            self.evaluation.best_model_save_path = str(folder.path)
            others.append(self.evaluation)
        if self.delivery is not None:
            self.delivery.folder = folder.path
        return Checkpoints(
            folder.checkpoint,
            [*others, *self.callbacks],
            identity=self.identity,
            every=flags.checkpoint_every,
            log_interval=flags.log_interval,
            asked_to_stop=asked_to_stop,
        )

    def _learn(self, folder: RunFolder, checkpoints: Checkpoints) -> bool:
        """Whether training came to its end."""
        left = self.hyperparams["n_timesteps"] - (self.model.num_timesteps if self.begun else 0)
        interval = self.flags.log_interval
        kwargs: dict[str, Any] = {}
        if interval != -1:
            kwargs["log_interval"] = interval if interval > 0 else None
        try:
            # The checkpoint comes first: it must see the others as the last rollout left them.
            self.model.learn(
                left,
                callback=[checkpoints, *checkpoints.others],
                reset_num_timesteps=self.begun is None,
                progress_bar=self.flags.progress,
                **kwargs,
            )
        except Interrupted:
            return False
        except BAD_NUMBERS as error:
            raise TrainingStopped(
                f"training stopped at {self.model.num_timesteps} steps: {one_line(error)}"
            ) from error
        except PROCESS_DIED as error:
            if self.flags.vec_env not in ("subproc", "gymnasium"):
                raise
            if checkpoints.asked_to_stop():  # the signal was for all processes
                return False
            raise UsageError(
                f"a process of --vec-env {self.flags.vec_env} has died, by an error told above, a "
                f"signal or for lack of memory; continue with: {folder.again()}"
            ) from error
        return True

    def _finish(
        self, folder: RunFolder, result: Mapping[str, Any], finished: bool
    ) -> dict[str, Any]:
        """Save the agent; if training is finished, play it and write the result."""
        with replacing(folder.model) as file:
            self.model.save(file)
        normalizer = normalizer_of(self.env)
        if normalizer is not None:
            with replacing(folder.normalizer) as file:
                pickle.dump(normalizer, file)
        played = (self.delivery and self.delivery.final) or self._play_final() if finished else {}
        final = {name: _data(played[name == "greedy"]) for name in PLAYED if played}
        final = {name: data for name, data in final.items() if data["returns"]}  # that have ended
        result = {"algo": self.flags.algo, "env": self.flags.env, **result, "final": final}
        if self.delivery is not None:
            certificate = self.delivery.certificate
            result["delivered"] = certificate.summary() if certificate else None
        if finished:
            made = {"command": folder.flags().command(), "curve": folder.curve_hash()}
            folder.write_result(result | made)
        return result

    def _play_final(self) -> dict[bool, Evaluation]:
        """
        Play the final policy.

        :return: of each kind of actions 100 episodes, or an eighth of the training's if these are
            fewer; empty if that is none
        """
        episodes = min(FINAL_EPISODES, find_monitor(self.env).episode_count // 8)
        if not episodes:
            return {}
        with closing(self.make_evaluation_envs(episodes)) as env:
            sync_normalization(self.env, env)
            seed = evaluation_seed(self.flags.seed, 1)
            return play_final(self.model, env, episodes, seed, self.flags.verbose > 0)


def _data(played: Evaluation) -> dict[str, Any]:
    """
    Episodes as data, a number an episode.

    :return: ``returns``, ``costs`` and ``lengths``, and ``bounded``, what the limits bound by cost
        key, where that is something else than the cost
    """

    def rounded(values: np.ndarray) -> list[float | None]:
        return [None if np.isnan(value) else float(f"{value:.6g}") for value in values]

    data: dict[str, Any] = {
        "returns": rounded(played.returns),
        "costs": rounded(played.costs),
        "lengths": played.lengths.tolist(),
    }
    if len(played.cost_keys) > 1 or played.limits.on == "max":
        bounded = zip(played.cost_keys, played.limited.T, strict=True)
        data["bounded"] = {key: rounded(costs) for key, costs in bounded}
    return data


def standing_return(env: VecEnv, seed: int = 0) -> float | None:
    """The return of an episode of actions 0, or the nearest to it; None: there is no such."""
    if not isinstance(space := env.action_space, spaces.Box):
        return None
    still = np.array([np.clip(np.zeros(space.shape), space.low, space.high)] * env.num_envs)
    policy: Any = SimpleNamespace(predict=lambda *args, **kwargs: (still, None))
    returns = evaluate_policy(policy, env, 1, seed=seed).returns
    return float(returns[0]) if len(returns) else None


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """What differs between two runs: name and both values, ``unset`` for those that are absent."""

    def shown(value: Any) -> Any:
        return "unset" if value in ("", None) else value

    there, here = plain(there), plain(here)
    return [
        (name, shown(there.get(name)), shown(here.get(name)))
        for name in sorted({*there, *here})
        if there.get(name) != here.get(name)
    ]

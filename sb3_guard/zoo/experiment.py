"""A training run from flags to result: checked in full first, then made, trained, and resumed.

RL-Zoo's ``ExperimentManager`` makes the run folder before it has looked at the hyper-parameters and
starts counters, seeds and environments anew when it continues; so its pieces are used here (wrapper,
callback and schedule parsing, run numbers, file layout, flags) and its class is not.
"""

import shlex
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.common.callbacks import CostEvalCallback
from sb3_guard.common.files import replacing
from sb3_guard.zoo.algos import algorithm
from sb3_guard.zoo.checkpoint import (
    Checkpoints,
    Interrupted,
    load_model,
    read_checkpoint,
    restore_run,
)
from sb3_guard.zoo.config import Setup, build, check, read_hyperparams
from sb3_guard.zoo.environments import (
    BAD_ARGUMENTS,
    VEC_ENVS,
    canonical_id,
    choose_vec_env,
    import_packages,
    make_envs,
)
from sb3_guard.zoo.logger import RunLogger
from sb3_guard.zoo.progress import Epochs, find_monitor
from sb3_guard.zoo.run_folder import RunFolder
from sb3_guard.zoo.usage import UsageError, one_line

# Flags that say how to watch or host a run, not what it is: they may change when it is resumed.
FREE_FLAGS = {"trained_agent", "progress", "verbose", "num_threads", "checkpoint_every", "track"}
# The evaluation episodes are not those of training: seeds this far apart don't meet.
EVALUATION_SEED_OFFSET = 1_000_000


class Experiment:
    """
    One training run, made and checked but not yet on disk.

    :param args: all flags of the command, with their defaults
    :param hyperparams: hyper-parameters as data, checked
    :param state: the checkpoint to continue from; None: a new run
    :param folder: the run's folder, when it is continued
    :raises UsageError: the environment, the algorithm or a wrapper refuses a value
    """

    def __init__(
        self,
        args: Mapping[str, Any],
        hyperparams: Mapping[str, Any],
        state: dict[str, Any] | None = None,
        folder: RunFolder | None = None,
    ):
        self.args = dict(args)
        self.hyperparams = dict(hyperparams)
        self.state = state
        self.folder = folder
        self.algo: str = args["algo"]
        self.algorithm = algorithm(self.algo)
        self.setup: Setup = build(hyperparams)
        self.env_kwargs = {**self.setup.env_kwargs, **(args["env_kwargs"] or {})}
        self.cost_keys = tuple(self.setup.model.get("cost_keys", ("cost",)))
        self.vec_env = choose_vec_env(
            args["vec_env"], canonical_id(args["env"])[1], self.setup.env_wrapper is not None
        )
        if args["num_threads"] > 0:
            import torch as th

            th.set_num_threads(args["num_threads"])
        set_random_seed(args["seed"])
        self._try_environment()
        self.env = self._make_envs(self.setup.n_envs, args["seed"])
        try:
            self.model = self._make_model()
            self.eval_env = self._make_eval_envs() if args["eval_freq"] > 0 else None
        except BaseException:
            self.env.close()
            raise

    def _make_envs(self, n_envs: int, seed: int, **kwargs: Any) -> VecEnv:
        kwargs = {"vec_env": self.vec_env, "env_kwargs": self.env_kwargs, **kwargs}
        return make_envs(
            self.args["env"],
            self.setup,
            n_envs=n_envs,
            seed=seed,
            cost_keys=self.cost_keys,
            num_threads=self.args["num_threads"] if self.args["num_threads"] > 0 else None,
            normalizer=self._warm_start_normalizer(),
            **kwargs,
        )

    def _try_environment(self) -> None:
        """Make one environment and take a step, so that nothing fails later for want of a cost."""
        vec_env = "dummy" if self.vec_env == "subproc" else self.vec_env
        env = self._make_envs(1, self.args["seed"], vec_env=vec_env)
        try:
            env.reset()
            env.action_space.seed(self.args["seed"])
            info = env.step(np.array([env.action_space.sample()]))[3][0]
        except BAD_ARGUMENTS as error:
            raise UsageError(f"{self.args['env']} fails at its first step: {one_line(error)}") from error
        finally:
            env.close()
        if not getattr(self.algorithm, "constrained", False):
            return
        if self.setup.model.get("missing_cost", "error") == "zero":
            return
        for key in self.cost_keys:
            if key not in info:
                raise UsageError(
                    f"{self.args['env']} reports no cost {key!r} in its info, which has "
                    f"{', '.join(sorted(info)) or 'nothing'}; name its costs with "
                    "-params cost_keys:\"['name']\", or count a missing cost as 0 with "
                    "-params missing_cost:zero"
                )

    def _make_model(self) -> BaseAlgorithm:
        common = {"seed": self.args["seed"], "verbose": 0}
        device = self.args["device"]
        if self.state is not None:
            assert self.folder is not None
            return load_model(self.algorithm, self.folder.checkpoint, self.env, device)
        arguments = dict(self.setup.model)
        try:
            if self.args["trained_agent"]:
                # What the networks are is for the saved agent to say.
                for name in ("policy", "policy_kwargs"):
                    arguments.pop(name, None)
                path = Path(self.args["trained_agent"])
                return load_model(self.algorithm, path, self.env, device, **arguments, **common)
            return self.algorithm(env=self.env, device=device, **arguments, **common)
        except (*BAD_ARGUMENTS, RuntimeError) as error:
            raise UsageError(f"{self.algo} can't be made: {one_line(error)}") from error

    def _warm_start_normalizer(self) -> Path | None:
        """Observation statistics that belong to the agent given by ``-i model.zip``."""
        if self.state is not None or not self.args["trained_agent"]:
            return None
        found = sorted(Path(self.args["trained_agent"]).parent.glob("*/vecnormalize.pkl"))
        return found[0] if found else None

    def _make_eval_envs(self) -> VecEnv:
        number = self.args["n_eval_envs"]
        if number is None:
            # All episodes at once where that is cheap; a process each would not be.
            number = self.args["eval_episodes"] if self.vec_env == "native" else 1
        kwargs = self.args["eval_env_kwargs"]
        return self._make_envs(
            number,
            self.args["seed"] + EVALUATION_SEED_OFFSET,
            evaluation=True,
            env_kwargs=self.env_kwargs if kwargs is None else kwargs,
        )

    def _make_callbacks(self, folder: RunFolder) -> tuple[Checkpoints, Epochs, list[BaseCallback]]:
        args, n_envs = self.args, self.setup.n_envs
        epochs = Epochs(self.setup.n_timesteps, bar=args["progress"])
        others: list[BaseCallback] = [epochs]
        if args["save_freq"] > 0:
            others.append(
                CheckpointCallback(
                    max(args["save_freq"] // n_envs, 1),
                    str(folder.path),
                    name_prefix="rl_model",
                    save_vecnormalize=True,
                )
            )
        if self.eval_env is not None:
            others.append(
                CostEvalCallback(
                    self.eval_env,
                    selection_limit=self.setup.selection_limit,
                    seed=args["seed"] + EVALUATION_SEED_OFFSET,
                    n_eval_episodes=args["eval_episodes"],
                    eval_freq=max(args["eval_freq"] // n_envs, 1),
                    log_path=folder.path,
                    best_model_save_path=folder.path,
                    verbose=int(args["verbose"] > 0 and self._prints_tables),
                )
            )
        others += self.setup.callbacks
        log_interval = args["log_interval"] if args["log_interval"] > 0 else 1
        checkpoints = Checkpoints(
            folder.checkpoint, others, every=args["checkpoint_every"], log_interval=log_interval
        )
        # The checkpoint comes first: it must see the others as the last rollout left them.
        return checkpoints, epochs, [checkpoints, *others]

    @property
    def _prints_tables(self) -> bool:
        return self.args["verbose"] >= 2 or (self.args["verbose"] == 1 and not self.args["progress"])

    def train(self) -> int:
        """
        Train to the end, or to an interrupt, and report.

        :return: exit status: 0, or 128 + the signal's number when interrupted
        """
        folder = self.folder
        if folder is None:
            folder = RunFolder.create(
                self.args["log_folder"],
                self.algo,
                self.args["env"],
                self.args,
                self.hyperparams,
                shlex.join(sys.orig_argv),
                unique=self.args["uuid"],
            )
        try:
            with folder.owned():
                return self._train(folder)
        finally:
            self.env.close()
            if self.eval_env is not None:
                self.eval_env.close()

    def _train(self, folder: RunFolder) -> int:
        verbose = self.args["verbose"] > 0
        if verbose:
            print(f"Run folder: {folder.path}")
        if self.args["tensorboard_log"]:
            run = folder.path.name.removeprefix(folder.name)
            tensorboard = Path(self.args["tensorboard_log"]) / folder.name / f"{self.algo}{run}"
        else:
            tensorboard = None
        state = self.state
        logger = RunLogger(
            folder.path,
            stdout=self._prints_tables,
            tensorboard=tensorboard,
            state=None if state is None else state["logger"],
        )
        self.model.set_logger(logger)
        checkpoints, epochs, callbacks = self._make_callbacks(folder)
        monitor = find_monitor(self.env)
        if state is None:
            monitor.log_to(folder.monitor)
        else:
            folder.result.unlink(missing_ok=True)
            checkpoints.restore(state)
            restore_run(self.model, state)
            try:
                monitor.log_to(folder.monitor, offset=monitor_offset(state))
            except (OSError, ValueError) as error:
                raise UsageError(one_line(error)) from error
        began = time.monotonic()
        with interrupts(checkpoints, verbose) as received:
            finished = self._learn(callbacks)
        self.model.save(str(folder.model))
        normalizer = self.model.get_vec_normalize_env()
        if normalizer is not None:
            normalizer.save(str(folder.normalizer))
        logger.close()
        result = epochs.result()
        if finished:
            folder.write_result({"algo": self.algo, "env": self.args["env"], **result})
        if verbose:
            print(summary(folder, result, time.monotonic() - began, finished))
        return 0 if finished else 128 + received[0]

    def _learn(self, callbacks: list[BaseCallback]) -> bool:
        left = self.setup.n_timesteps - (self.model.num_timesteps if self.state else 0)
        interval = self.args["log_interval"]
        kwargs = {} if interval == -1 else {"log_interval": interval if interval > 0 else None}
        try:
            self.model.learn(
                left, callback=callbacks, reset_num_timesteps=self.state is None, **kwargs
            )
        except Interrupted:
            return False
        finally:
            for callback in callbacks:
                if isinstance(callback, Epochs):
                    callback.on_training_end()  # leaves the terminal tidy
        return True


def monitor_offset(state: Mapping[str, Any]) -> int | None:
    """How long the monitor's csv was when a checkpoint was taken, bytes."""
    for part in state["environments"] or []:
        if isinstance(part, dict) and "offset" in part:
            return part["offset"]
    return state["monitor"]["offset"]


@contextmanager
def interrupts(checkpoints: Checkpoints, verbose: bool) -> Iterator[list[int]]:
    """
    Let Ctrl-C and SIGTERM end training after the rollout under way, with a checkpoint.

    A second one ends it at once; the checkpoint before stands.

    :return: the numbers of the signals received
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    def handle(number: int, frame: Any) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt
        checkpoints.stop = True
        if verbose:
            print("\nStopping after this rollout; once more to stop at once.", file=sys.stderr)

    before = {one: signal.signal(one, handle) for one in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def summary(folder: RunFolder, result: Mapping[str, Any], seconds: float, finished: bool) -> str:
    """What a run came to, as the paper measures it, on a few lines."""

    def number(value: float | None, digits: int) -> str:
        return "– (no episode has ended)" if value is None else f"{value:.{digits}f}"

    lines = [
        f"{'Finished' if finished else 'Interrupted'} at {result['n_timesteps']:,} steps, "
        f"{seconds:.0f} s",
        f"  run folder         {folder.path}",
        f"  return       J_r   {number(result['return'], 3)}",
        f"  episode cost M_c   {number(result['cost'], 3)}",
        f"  cost rate    ρ_c   {number(result['cost_rate'], 5)}",
    ]
    if not finished:
        lines.append(f"  continue with      -i {folder.path}")
    return "\n".join(lines)

"""A training run from flags to result: checked in full first, then made and trained.

RL-Zoo's ``ExperimentManager`` makes the run folder before it has looked at the hyper-parameters,
and resets counters, seeds and environments when it continues; so its pieces are used here
(schedules, run numbers, file layout, flags) and its class is not.
"""

import copy
import shlex
import signal
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_guard.algorithms.common.constrained import Constrained
from sb3_guard.common.callbacks import CostEvalCallback, LogCosts
from sb3_guard.common.evaluation import bounded_name
from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import find_monitor
from sb3_guard.zoo.algos import algorithm
from sb3_guard.zoo.checkpoint import (
    Checkpoints,
    Interrupted,
    cut_logs,
    load_model,
    read_checkpoint,
    read_normalizer,
    restore_run,
)
from sb3_guard.zoo.hyperparams import Setup, build
from sb3_guard.zoo.logger import RunLogger
from sb3_guard.zoo.make_envs import (
    BAD_ARGUMENTS,
    BAD_NUMBERS,
    PROCESS_DIED,
    evaluation_seed,
    make_envs,
    seed_rows,
)
from sb3_guard.zoo.names import packages_flag
from sb3_guard.zoo.progress import Epochs
from sb3_guard.zoo.run_flags import RunFlags
from sb3_guard.zoo.run_folder import RunFolder, is_disk_error, require_writable
from sb3_guard.zoo.tracking import Tracker
from sb3_guard.zoo.usage import TrainingStopped, UsageError, explained, interrupts, one_line


class Experiment:
    """
    One training run, made and checked but not yet on disk.

    :param flags: all flags of the run
    :param hyperparams: hyper-parameters as data, checked
    :param folder: the folder of the run to continue; None: a new run
    :raises UsageError: the environment, the algorithm or a wrapper refuses a value, or TensorBoard
        events can't be written
    """

    def __init__(
        self, flags: RunFlags, hyperparams: Mapping[str, Any], folder: RunFolder | None = None
    ):
        self.flags = flags
        self.hyperparams = dict(hyperparams)
        self.algorithm = algorithm(flags.algo)
        self.setup: Setup = build(hyperparams)
        self.callbacks = self.setup.callbacks()
        #: the checkpoint to continue from
        self.state = None if folder is None else read_checkpoint(folder.checkpoint)
        self._saved = None if folder is None else folder.checkpoint
        self.cost_keys = tuple(self.setup.model.get("cost_keys", ("cost",)))
        _check_device(flags.device)
        events = flags.tensorboard_log or ("runs" if flags.track else "")
        self._events = Path(events) if events else None
        if self._events is not None:
            require_writable(self._events, "--tensorboard-log")
        self.vec_env = str(flags.vec_env)
        if flags.num_threads > 0:
            th.set_num_threads(flags.num_threads)
        set_random_seed(flags.seed)
        self._try_environment(self.setup.env_kwargs)
        if flags.eval_freq > 0 and flags.eval_env_kwargs is not None:
            self._try_environment(flags.eval_env_kwargs)
        self.env = self._make_envs(self.setup.n_envs, flags.seed)
        try:
            self.model = self._make_model()
            seed_rows(self.env, flags.seed)
            self.model.verbose = max(flags.verbose - 1, 0)
            self.evaluation = self._make_evaluation() if flags.eval_freq > 0 else None
            self.tracker = Tracker(flags, hyperparams, folder) if flags.track else None
        except BaseException:
            self.env.close()
            raise

    def _make_envs(self, n_envs: int, seed: int, **kwargs: Any) -> VecEnv:
        kwargs = {"vec_env": self.vec_env, "env_kwargs": self.setup.env_kwargs, **kwargs}
        return make_envs(
            self.flags.env,
            self.setup,
            n_envs=n_envs,
            seed=seed,
            cost_keys=self.cost_keys,
            num_threads=self.flags.num_threads if self.flags.num_threads > 0 else None,
            normalizer=self._warm_start_normalizer(),
            **kwargs,
        )

    def _try_environment(self, env_kwargs: Mapping[str, Any]) -> None:
        """Make one environment and take a step, so that nothing fails later for want of a cost."""
        vec_env = "dummy" if self.vec_env == "subproc" else self.vec_env
        env = self._make_envs(1, self.flags.seed, vec_env=vec_env, env_kwargs=env_kwargs)
        try:
            with explained(f"{self.flags.env} fails at its first step", *BAD_NUMBERS):
                env.reset()
                env.action_space.seed(self.flags.seed)
                info = env.step(np.array([env.action_space.sample()]))[3][0]
        finally:
            env.close()
        if not getattr(self.algorithm, "constrained", False):
            return
        if self.setup.model.get("missing_cost", "error") == "zero":
            return
        for key in self.cost_keys:
            if key not in info:
                raise UsageError(
                    f"{self.flags.env} reports no cost {key!r} in its info, which has "
                    f"{', '.join(sorted(info)) or 'nothing'}; name its costs with "
                    "-params cost_keys:\"['name']\", or count a missing cost as 0 with "
                    "-params missing_cost:zero"
                )

    def _make_model(self) -> BaseAlgorithm:
        flags = self.flags
        if self._saved is not None:
            return load_model(self.algorithm, self._saved, self.env, flags.device)
        arguments = copy.deepcopy(self.setup.model)  # some algorithms add to their policy_kwargs
        arguments["seed"] = flags.seed
        if flags.trained_agent:
            # What the networks are is for the saved agent to say.
            for name in ("policy", "policy_kwargs"):
                arguments.pop(name, None)
            path = Path(flags.trained_agent)
            return load_model(self.algorithm, path, self.env, flags.device, **arguments)
        space = self.env.action_space
        noise = self.setup.action_noise(space.shape[0]) if isinstance(space, spaces.Box) else None
        if noise is not None:
            arguments["action_noise"] = noise
        with explained(f"{flags.algo} can't be made", *BAD_ARGUMENTS, RuntimeError, MemoryError):
            return self.algorithm(env=self.env, device=flags.device, **arguments)

    def _warm_start_normalizer(self) -> VecNormalize | None:
        """Observation statistics that belong to the agent given by ``-i model.zip``."""
        agent = self.flags.trained_agent
        if self.state is not None or not agent or self.setup.normalize is None:
            return None
        found = sorted(Path(agent).parent.glob("*/vecnormalize.pkl"))
        return read_normalizer(found[0]) if found else None

    def _make_evaluation(self) -> CostEvalCallback:
        flags, number, kwargs = self.flags, self.flags.n_eval_envs, self.flags.eval_env_kwargs
        if number is None:
            # All episodes at once where that is cheap; a process each would not be.
            number = flags.eval_episodes if self.vec_env == "native" else 1
        seed = evaluation_seed(flags.seed)
        env = self._make_envs(
            number,
            seed,
            evaluation=True,
            env_kwargs=self.setup.env_kwargs if kwargs is None else kwargs,
        )
        evaluation = CostEvalCallback(
            env,
            selection_limit=self.setup.selection_limit,
            seed=seed,
            n_eval_episodes=flags.eval_episodes,
            eval_freq=max(flags.eval_freq // self.setup.n_envs, 1),
            verbose=int(flags.verbose > 0 and self._prints_tables),
        )
        evaluation.model = self.model
        with explained("hyper-parameter", ValueError):
            evaluation.limits()
        return evaluation

    def _make_callbacks(self, folder: RunFolder) -> tuple[Checkpoints, Epochs, list[BaseCallback]]:
        flags = self.flags
        epochs = Epochs(self.setup.n_timesteps, bar=bool(flags.progress))
        others: list[BaseCallback] = [epochs]
        if not isinstance(self.model, Constrained):
            others.append(LogCosts())
        if flags.save_freq > 0:
            every = max(flags.save_freq // self.setup.n_envs, 1)
            path = str(folder.path)
            others.append(CheckpointCallback(every, path, save_vecnormalize=True))
        if self.evaluation is not None:
            self.evaluation.log_path = str(folder.path / "evaluations")
            self.evaluation.best_model_save_path = str(folder.path)
            others.append(self.evaluation)
        others += self.callbacks
        checkpoints = Checkpoints(
            folder.checkpoint,
            others,
            every=flags.checkpoint_every,
            log_interval=flags.log_interval,
            what=folder.what(),
        )
        # The checkpoint comes first: it must see the others as the last rollout left them.
        return checkpoints, epochs, [checkpoints, *others]

    @property
    def _prints_tables(self) -> bool:
        # The progress bar shows the same live; two displays would be one too many.
        return self.flags.verbose > (1 if self.flags.progress else 0)

    def train(
        self,
        folder: RunFolder,
        asked_to_stop: Callable[[], bool] = lambda: False,
        restate: bool = False,
    ) -> int:
        """
        Train to the end, or to an interrupt, and report.

        :param folder: the run's folder, owned by this process
        :param asked_to_stop: training ends after the rollout under way when this says so
        :param restate: state flags and hyper-parameters again once training can continue
        :return: exit status: 0, or 128 + the signal's number when interrupted
        :raises UsageError: training can't continue, or the disk is full or read-only
        """
        try:
            return self._train(folder, asked_to_stop, restate)
        except PROCESS_DIED as error:
            print(flush=True)  # fails again if it is the reader of our output that is gone
            if self.vec_env != "subproc":
                raise
            raise UsageError(
                "a process of --vec-env subproc has died, because of an error printed above or for "
                f"lack of memory; continue with {folder.again(self.flags)}"
            ) from error
        except OSError as error:
            if not is_disk_error(error):
                raise
            raise UsageError(
                f"can't write to {folder.path}: {error.strerror}; what was written before is "
                f"intact: make room, then continue with {folder.again(self.flags)}"
            ) from error
        finally:
            self.close()

    @property
    def _envs(self) -> list[VecEnv]:
        return [self.env, *([] if self.evaluation is None else [self.evaluation.eval_env])]

    def close(self) -> None:
        """Release the environments, and let Weights & Biases have what it has not yet."""
        for env in self._envs:
            with suppress(*PROCESS_DIED):
                env.close()
        if self.tracker is not None:
            self.tracker.finish()

    def _train(self, folder: RunFolder, asked: Callable[[], bool], restate: bool) -> int:
        state, verbose = self.state, self.flags.verbose > 0
        if verbose:
            print(f"Run folder: {folder.path} (seed {self.flags.seed})")
        if self.tracker is not None:
            self.tracker.remember(folder)
        with explained(f"can't write to {folder.path}", OSError):
            if state is not None:
                cut_logs(folder.path, state)
            goes_on = state is not None and folder.monitor.exists()
            find_monitor(self.env).log_to(folder.monitor, append=goes_on)
            logger = RunLogger(
                folder.path,
                stdout=self._prints_tables,
                tensorboard=folder.events(self.flags) if self._events else None,
                state=None if state is None else state["logger"],
            )
        self.model.set_logger(logger)
        checkpoints, epochs, callbacks = self._make_callbacks(folder)
        checkpoints.asked = asked
        if state is not None:
            checkpoints.restore(state, self.model.action_noise)
            # In this order, and only now: a result in the folder is always that of its config.
            folder.result.unlink(missing_ok=True)
            if restate:
                folder.write_config(self.flags.values(), self.hyperparams)
                checkpoints.what = folder.what()
            restore_run(self.model, state, folder.path)

        def stop(number: int) -> None:
            checkpoints.stop = True
            if verbose:
                print(
                    "\nStopping after this rollout; Ctrl-C again stops immediately.",
                    file=sys.stderr,
                )

        began = time.monotonic()
        with interrupts(stop) as received, ExitStack() as last:
            last.callback(epochs.on_training_end)  # leaves the terminal tidy
            finished = self._learn(callbacks)
        with replacing(folder.model) as file:
            self.model.save(file)
        normalizer = self.model.get_vec_normalize_env()
        if normalizer is not None:
            normalizer.save(str(folder.normalizer))
        logger.close()
        result = epochs.result()
        if finished:
            folder.write_result({"algo": self.flags.algo, "env": self.flags.env, **result})
        if verbose:
            print(summary(folder, self.flags, result, time.monotonic() - began, finished))
        return 0 if finished else 128 + (received or [signal.SIGTERM])[0]

    def _learn(self, callbacks: list[BaseCallback]) -> bool:
        left = self.setup.n_timesteps - (self.model.num_timesteps if self.state else 0)
        interval = self.flags.log_interval
        kwargs: dict[str, Any] = {}
        if interval != -1:
            kwargs["log_interval"] = interval if interval > 0 else None
        try:
            self.model.learn(
                left, callback=callbacks, reset_num_timesteps=self.state is None, **kwargs
            )
        except Interrupted:
            return False
        except BAD_NUMBERS as error:
            if self.flags.verbose > 1:
                raise
            raise TrainingStopped(
                f"training stopped at {self.model.num_timesteps} steps: {one_line(error)} "
                "(--verbose 2 shows where)"
            ) from error
        return True


def _check_device(name: str) -> None:
    """
    Refuse a GPU that is not there; SB3 would train on the CPU instead.

    :raises UsageError: torch has no such device
    """
    with explained(f"--device {name!r} is not allowed", RuntimeError):
        device = th.device("cpu" if name == "auto" else name)
    if device.type == "cuda" and (device.index or 0) >= th.cuda.device_count():
        raise UsageError(
            f"--device {name!r}: torch sees {th.cuda.device_count()} GPUs here; use auto or cpu"
        )


def summary(
    folder: RunFolder, flags: RunFlags, result: Mapping[str, Any], seconds: float, finished: bool
) -> str:
    """What a run came to, as the paper measures it, on a few lines."""

    def number(value: float | None, digits: int) -> str:
        return "– (no episode has ended)" if value is None else f"{value:.{digits}f}"

    def bounded(cost: Mapping[str, Any]) -> str:
        text = number(cost["mean"], 3)
        if "low" in cost:
            text += f"   [{cost['low']:.3f}, {cost['high']:.3f}]"
        if cost["limit"] is not None:
            text += f"   limit {cost['limit']:g}"
        return text + (f": {cost['verdict']}" if "verdict" in cost else "")

    costs, limit_on = result["costs"], result.get("limit_on", "sum")
    alone = len(costs) == 1 and limit_on == "sum"
    lines = [
        f"{'Finished' if finished else 'Interrupted'} at {result['n_timesteps']:,} steps, "
        f"{seconds:.0f} s",
        f"  run folder         {folder.path}",
        f"  return       J_r   {number(result['return'], 3)}",
        f"  episode cost M_c   {bounded(*costs.values()) if alone else number(result['cost'], 3)}",
        *(
            f"    {bounded_name(key, limit_on):<16} {bounded(cost)}"
            for key, cost in ({} if alone else costs).items()
        ),
        f"  cost rate    ρ_c   {number(result['cost_rate'], 5)}",
    ]
    packages = packages_flag(flags.gym_packages)
    if not finished:
        lines.append(f"  continue with      {folder.again(flags)}")
    elif (own := folder.path.name[len(folder.name) + 1 :]).isdigit():
        lines.append(
            f"  see the agent      sb3-guard enjoy --algo {flags.algo} --env {flags.env} "
            f"-f {shlex.quote(str(folder.path.parent.parent))} --exp-id {own}{packages}"
        )
    return "\n".join(lines)

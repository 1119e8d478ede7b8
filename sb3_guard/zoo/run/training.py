"""A training run from flags to result: checked in full first, then made and trained.

RL-Zoo's ``ExperimentManager`` makes the run folder before it has looked at the hyperparameters,
and resets counters, seeds and environments when it continues; so its pieces are used here
(schedules, run numbers, file layout, flags) and its class is not.
"""

import shlex
import signal
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.algorithms.common.constrained import Constrained
from sb3_guard.common.callbacks import CostEvalCallback, LogCosts
from sb3_guard.common.evaluation import (
    bounded_name,
    evaluate_policy,
    sync_normalization,
)
from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import find_monitor
from sb3_guard.costs import beside, estimate
from sb3_guard.zoo.cli.usage import (
    TrainingStopped,
    UsageError,
    explained,
    interrupts,
    one_line,
    packages_flag,
)
from sb3_guard.zoo.run.checkpoint import Checkpoints, Interrupted, read_checkpoint
from sb3_guard.zoo.run.experiment import Experiment
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder, identity, is_disk_error
from sb3_guard.zoo.run.logger import RunLogger, cut
from sb3_guard.zoo.run.make_envs import (
    BAD_NUMBERS,
    PROCESS_DIED,
    evaluation_seed,
)
from sb3_guard.zoo.run.progress import Epochs
from sb3_guard.zoo.run.tracking import ID, track

FINAL_EPISODES = 100  # of each policy, after training
#: what is played after training: the policy that was trained, and its most likely actions
SPLITS = ("stochastic", "greedy")


class Training:
    """
    A run whose environments and model are made; it is on disk once it has a folder.

    :param experiment: what is trained, which :meth:`~Experiment.try_out` should have checked
    :raises UsageError: something can't be made, or is not there
    """

    def __init__(self, experiment: Experiment):
        folder, flags = experiment.folder, experiment.flags
        self.experiment, self.flags, self.setup = experiment, flags, experiment.setup
        self.callbacks = self.setup.callbacks()
        #: the checkpoint to continue from
        self.state = None if folder is None else read_checkpoint(folder.checkpoint)
        self.model = experiment.make_model()
        self.env: VecEnv = self.model.get_env()  # type: ignore[assignment]
        self.evaluation: CostEvalCallback | None = None
        self.tracker: Any = None
        try:
            self.model.verbose = max(flags.verbose - 1, 0)
            if flags.eval_freq > 0:
                self.evaluation = experiment.make_evaluation(self.model)
            if flags.track:
                self.tracker = track(flags, experiment.hyperparams, folder)
        except BaseException:
            self.close()
            raise

    def _make_callbacks(
        self, folder: RunFolder, asked_to_stop: Callable[[], bool]
    ) -> tuple[Checkpoints, Epochs]:
        """The callbacks; that of the checkpoints has all others."""
        flags = self.flags
        bar, cut = bool(flags.progress), self.setup.cuts_episodes
        epochs = Epochs(self.setup.n_timesteps, bar=bar, cut=cut)
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
        checkpoints = Checkpoints(
            folder.checkpoint,
            [*others, *self.callbacks],
            identity=identity(flags, self.experiment.hyperparams),
            every=flags.checkpoint_every,
            log_interval=flags.log_interval,
            asked_to_stop=asked_to_stop,
        )
        return checkpoints, epochs

    def train(self, folder: RunFolder, asked_to_stop: Callable[[], bool] = lambda: False) -> int:
        """
        Train to the end, or to an interrupt, and report.

        :param folder: the run's folder, owned by this process
        :param asked_to_stop: training ends after the rollout under way when this says so
        :return: exit status: 0, or 128 + the signal's number when interrupted
        :raises UsageError: training can't continue, or the disk is full or read-only
        """
        try:
            return self._train(folder, asked_to_stop)
        except PROCESS_DIED as error:
            if self.flags.vec_env != "subproc":
                raise
            raise UsageError(
                "a process of --vec-env subproc has died, because of an error printed above, by a "
                f"signal or for lack of memory; continue with: {folder.again(self.flags)}"
            ) from error
        except OSError as error:
            if not is_disk_error(error):
                raise
            raise UsageError(
                f"can't write to {folder.path}: {error.strerror}; what was written before is "
                f"intact: make room, then continue with: {folder.again(self.flags)}"
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

    def _train(self, folder: RunFolder, asked_to_stop: Callable[[], bool]) -> int:
        state, verbose = self.state, self.flags.verbose > 0
        if verbose:
            print(f"Run folder: {folder.path} (seed {self.flags.seed})")
        if self.tracker is not None:
            (folder.params / ID).write_text(self.tracker.id)
            self.tracker.config.update({"folder": str(folder.path)}, allow_val_change=True)
        with explained(f"can't write to {folder.path}", OSError):
            # Two lines of the csv are no episodes.
            goes_on = state is not None and cut(folder.monitor, 2 + state["episodes"])
            find_monitor(self.env).log_to(folder.monitor, append=goes_on)
            logger = RunLogger(
                folder.path,
                stdout=self.experiment.prints_tables,
                tensorboard=folder.events(self.flags) if self.flags.tensorboard_log else None,
                state=None if state is None else state["logger"],
            )
        self.model.set_logger(logger)

        def stop(number: int) -> None:
            if verbose:
                print(
                    "\nStopping after this rollout; Ctrl-C again stops immediately.",
                    file=sys.stderr,
                )

        began = time.monotonic()
        with interrupts(stop) as received, ExitStack() as last:
            checkpoints, epochs = self._make_callbacks(
                folder, lambda: bool(received) or asked_to_stop()
            )
            if state is not None:
                checkpoints.restore(self.model, state)
                # In this order, and only now: a result in the folder is always that of its config.
                folder.result.unlink(missing_ok=True)
                folder.write_config(self.flags, self.experiment.hyperparams)
            last.callback(epochs.on_training_end)  # leaves the terminal tidy
            finished = self._learn(checkpoints)
            logger.close()
            result = self._finish(folder, epochs.result(), finished)
        if verbose:
            print(summary(folder, self.flags, result, time.monotonic() - began, finished))
        return 0 if finished else 128 + (received or [signal.SIGTERM])[0]

    def _finish(
        self, folder: RunFolder, result: Mapping[str, Any], finished: bool
    ) -> dict[str, Any]:
        """Save the agent; if training is finished, play it and write the result."""
        with replacing(folder.model) as file:
            self.model.save(file)
        normalizer = self.model.get_vec_normalize_env()
        if normalizer is not None:
            normalizer.save(str(folder.normalizer))
        final = self._play_final() if finished else {}
        result = {"algo": self.flags.algo, "env": self.flags.env, **result, "final": final}
        if finished:
            made = {"command": folder.flags().command(), "curve": folder.curve_hash()}
            folder.write_result(result | made)
        return result

    def _play_final(self) -> dict[str, dict[str, Any]]:
        """
        Play 100 episodes of the final policy twice: with sampled actions, and with its mean.

        :return: ``returns``, ``costs`` and ``lengths``, a number an episode, of ``stochastic`` and
            ``greedy`` actions, and ``bounded``, what the limits bound by cost key, where that is
            something else than the cost. Empty after a training of less than eight episodes: an
            eighth of its episodes is the most that each policy plays
        """
        episodes = min(FINAL_EPISODES, find_monitor(self.env).episode_count // 8)
        if not episodes:
            return {}
        env = self.experiment.make_evaluation_envs(episodes)
        final: dict[str, dict[str, Any]] = {}
        try:
            sync_normalization(self.env, env)
            for name in SPLITS:
                played = evaluate_policy(
                    self.model,
                    env,
                    episodes,
                    deterministic=name == "greedy",
                    seed=evaluation_seed(self.flags.seed, 1),
                )
                if not len(played):  # no episode of the greedy policy ends
                    continue
                final[name] = {
                    "returns": _rounded(played.returns),
                    "costs": _rounded(played.costs),
                    "lengths": played.lengths.tolist(),
                }
                if len(played.cost_keys) > 1 or played.limit_on == "max":
                    bounded = zip(played.cost_keys, played.limited.T, strict=True)
                    final[name]["bounded"] = {key: _rounded(costs) for key, costs in bounded}
        finally:
            env.close()
        return final

    def _learn(self, checkpoints: Checkpoints) -> bool:
        # The checkpoint comes first: it must see the others as the last rollout left them.
        callbacks = [checkpoints, *checkpoints.others]
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


def _rounded(values: np.ndarray) -> list[float | None]:
    """Numbers of six significant digits, for a file; None: it is not known."""
    return [None if np.isnan(value) else float(f"{value:.6g}") for value in values]


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
        text += f": {cost['verdict']}" if "verdict" in cost else ""
        return text + beside(cost.get("physics_errors", 0))

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
    for name, played in result["final"].items():
        lines.append(
            f"  final, {name:<12}return {np.mean(played['returns']):.3f}, cost "
            f"{(cost := estimate(np.array(played['costs'], float)))}, {len(played['costs'])} "
            f"episodes{beside(cost.diverged)}"
        )
        for key, values in played.get("bounded", {}).items():
            cost, limit = estimate(np.array(values, float)), costs[key]["limit"]
            against = "" if limit is None else f"   {cost.against(limit)}"
            lines.append(f"    {bounded_name(key, limit_on):<16} {cost}{against}")
    packages = packages_flag(flags.gym_packages)
    if not finished:
        lines.append(f"  continue with      {folder.again(flags)}")
    elif (exp_id := folder.path.name[len(folder.name) + 1 :]).isdigit():
        lines.append(
            f"  see the agent      sb3-guard enjoy --algo {flags.algo} --env {flags.env} "
            f"-f {shlex.quote(str(folder.path.parent.parent))} --exp-id {exp_id}{packages}"
        )
    return "\n".join(lines)

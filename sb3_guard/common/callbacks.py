"""Evaluation during training that knows about costs, and the model worth keeping."""

import copy
import os
import pickle
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.algorithms.common.constrained import BROKEN_OFF
from sb3_guard.common.evaluation import (
    Evaluation,
    check_agent,
    evaluate_policy,
    share_environment,
    sync_normalization,
)
from sb3_guard.common.files import replacing
from sb3_guard.common.monitor import cost_keys_of, find_monitor
from sb3_guard.judging import Limits
from sb3_guard.vector import as_vec_env, normalizer_of

# What a run continues with
KEPT = (
    "evaluations_timesteps", "evaluations_results", "evaluations_length", "evaluations_costs",
    "evaluations_key_costs", "evaluations_successes", "best_score", "last_mean_reward",
    "last_mean_cost",
)  # fmt: skip


def _mean(values: np.ndarray) -> Any:
    """Mean over episodes, but for those that a physics error ended; NaN: there are none."""
    values = values[~np.isnan(values).any(axis=tuple(range(1, values.ndim)))]
    return (values.mean(axis=0) if len(values) else np.full(values.shape[1:], np.nan)).tolist()


class LogCosts(BaseCallback):
    """
    Log the costs of training an algorithm that knows none, such as SB3's PPO or SAC.

    Logs ``rollout/ep_cost_mean``, over the episodes of SB3's window, and ``rollout/cost_rate``,
    cost per step of the whole training, as this package's algorithms do themselves. The
    environment must be wrapped in a :class:`~sb3_guard.common.monitor.CostMonitor`, as by
    :func:`~sb3_guard.make_vec_env`.
    """

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        monitor = find_monitor(self.training_env)
        episodes = self.model.ep_info_buffer
        if episodes:
            costs = np.array([episode["c"] for episode in episodes])
            self.logger.record("rollout/ep_cost_mean", _mean(costs))
        if monitor.total_steps:
            self.logger.record("rollout/cost_rate", monitor.total_cost / monitor.total_steps)


class CostEvalCallback(EvalCallback):
    """
    Evaluate the agent regularly, and keep the best model of those that keep the limit.

    SB3's callback keeps the model of highest reward, which for a constrained problem is apt to be
    the least safe one. Here models whose mean episode cost plus its standard error is within
    ``selection_limit`` come before all others and are ordered by return; the others are ordered by
    violation, the sum over the costs of what exceeds the limit. By default two policies must keep
    it: the stochastic one, which the limit is about, and its mean, which is used afterwards and
    whose return counts.

    Every evaluation plays the same episodes (``seed``) and draws no random number of training's: a
    run is the same with and without it, and after a resume.

    Logs ``eval/mean_reward``, ``eval/mean_ep_length``, ``eval/mean_ep_cost``; where both policies
    are evaluated ``eval/stochastic_reward`` and ``eval/stochastic_ep_cost``; and for several costs,
    of which these are totals, ``eval/mean_ep_cost/<key>`` and the like; ``eval/mean_max_cost`` of
    an algorithm that limits the worst step, whose highest costs are what must keep its limit.
    ``evaluations.npz`` has ``timesteps`` [K], ``results``, ``ep_lengths`` and ``costs`` [K, E], and
    for several costs ``key_costs`` [K, E, m]. Next to ``best_model.zip`` of an agent that was
    trained on normalised observations lies ``best_model_vecnormalize.pkl``.

    SB3's ``StopTrainingOnNoModelImprovement`` and ``StopTrainingOnRewardThreshold`` may be among
    its callbacks: the ``best_mean_reward`` that they compare rises with every new best model, and
    as long as none is safe it is below every return.

    :param eval_env: environment to evaluate in, wrapped as the training environment is, and not
        that environment itself
    :param selection_limit: cost up to which a model counts as safe, one number or one per
        cost key. None: ``cost_limit`` of the algorithm, and 1 for a limit of 0 (which would choose
        nobody, or the untrained agent); for an unconstrained algorithm the return alone decides
    :param seed: seed of the evaluation episodes
    :param callback_on_new_best: called when there is a new best model
    :param callback_after_eval: called after each evaluation
    :param n_eval_episodes: episodes per evaluation and policy
    :param eval_freq: evaluate every this many calls, i.e. ``eval_freq * n_envs`` steps
    :param log_path: folder of ``evaluations.npz``; None: not written
    :param best_model_save_path: folder of ``best_model.zip``; None: not written
    :param deterministic: evaluate the most likely actions alone (True), sampled ones alone (False),
        or both (None)
    :param verbose: 1 prints a line per evaluation
    """

    def __init__(
        self,
        eval_env: gym.Env | gym.vector.VectorEnv | VecEnv,
        *,
        selection_limit: float | Sequence[float] | None = None,
        seed: int = 0,
        callback_on_new_best: BaseCallback | None = None,
        callback_after_eval: BaseCallback | None = None,
        n_eval_episodes: int = 30,
        eval_freq: int = 10_000,
        log_path: str | os.PathLike[str] | None = None,
        best_model_save_path: str | os.PathLike[str] | None = None,
        deterministic: bool | None = None,
        verbose: int = 1,
    ):
        super().__init__(
            as_vec_env(eval_env),
            callback_on_new_best=callback_on_new_best,
            callback_after_eval=callback_after_eval,
            n_eval_episodes=n_eval_episodes,
            eval_freq=eval_freq,
            log_path=None if log_path is None else os.fspath(log_path),
            best_model_save_path=None
            if best_model_save_path is None
            else os.fspath(best_model_save_path),
            deterministic=deterministic is not False,
            verbose=verbose,
        )
        self.both = deterministic is None
        self.selection_limit = selection_limit
        self.seed = seed
        self.evaluations_costs: list[list[float]] = []
        self.evaluations_key_costs: list[list[list[float]]] = []
        #: (safe, return if safe else minus the violation) of the best model
        self.best_score: tuple[bool, float] = (False, -np.inf)
        self.last_mean_cost = np.inf

    @property
    def cost_keys(self) -> tuple[str, ...]:
        """The entries of info that are the algorithm's costs."""
        return cost_keys_of(self.model, self.eval_env)

    def _init_callback(self) -> None:
        """
        :raises ValueError: ``selection_limit`` does not fit the cost keys, or the evaluation would
            be played in the training environment
        """
        with warnings.catch_warnings():
            # Wrappers that are for training alone make another type.
            warnings.filterwarnings("ignore", "Training and eval env are not of the same type")
            super()._init_callback()
        self.limits()
        check_agent(self.model, self.eval_env)
        if share_environment(self.training_env, self.eval_env):
            raise ValueError(BROKEN_OFF)

    def limits(self) -> Limits:
        """
        Episode costs up to which a model counts as safe.

        :raises ValueError: ``selection_limit`` does not fit the cost keys
        """
        return Limits.of(self.model, self.cost_keys).to_choose(self.selection_limit)

    def score(self, *evaluations: Evaluation) -> tuple[bool, float]:
        """How two models compare: the greater tuple is the better model.

        :param evaluations: of one model; the return of the first counts, the costs of all
        :return: whether it keeps its limits, and the return, or minus the violation: NaN, so that
            it is never the best one, if a physics error ended an episode
        """
        limits = self.limits()
        excess = [limits.excess(played.limited).clip(0.0).sum() for played in evaluations]
        violation = float(np.max(excess))  # NaN stays NaN
        return (False, -violation) if violation else (True, float(evaluations[0].returns.mean()))

    def kinds(self) -> list[bool]:
        """The kinds of actions that are evaluated: whether the most likely ones."""
        return [True, False] if self.both else [self.deterministic]

    def evaluate(self, deterministic: bool = True) -> Evaluation:
        """The model's episodes, of its most likely actions or of sampled ones."""
        sync_normalization(self.training_env, self.eval_env)
        return evaluate_policy(
            self.model,
            self.eval_env,
            n_eval_episodes=self.n_eval_episodes,
            deterministic=deterministic,
            seed=self.seed,
            cost_keys=self.cost_keys,
        )

    def _remember(self, score: tuple[bool, float]) -> None:
        """Take a score for the best one, and tell SB3's callbacks in the number they compare."""
        safe, value = self.best_score = score
        # Below every return, and higher for a smaller violation.
        self.best_mean_reward = value if safe else 1e200 * value

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return True
        played = [self.evaluate(kind) for kind in self.kinds()]
        evaluation, *others = played
        for other in others:
            self.logger.record("eval/stochastic_reward", _mean(other.returns))
            self._log_costs("eval/stochastic_ep_cost", other)
        self.last_mean_reward = _mean(evaluation.returns)
        self.last_mean_cost = _mean(evaluation.costs)

        self.evaluations_timesteps.append(self.num_timesteps)
        self.evaluations_results.append(self._row(evaluation.returns))
        self.evaluations_length.append(self._row(evaluation.lengths))
        self.evaluations_costs.append(self._row(evaluation.costs))
        if len(self.cost_keys) > 1:
            self.evaluations_key_costs.append(self._row(evaluation.key_costs))
        if len(evaluation.successes):
            self.evaluations_successes.append(evaluation.successes.tolist())
        self.write_history()
        self._log(evaluation)

        score = self.score(*played)
        is_best = np.isfinite(score[1]) and score > self.best_score
        if self.verbose >= 1:
            words = [evaluation.words, *(f"sampled actions: {other.words}" for other in others)]
            best = " (best so far)" if is_best else ""
            print(f"Evaluation after {self.num_timesteps:,} steps: {'; '.join(words)}{best}")
        proceed = True
        if is_best:
            self._remember(score)
            self._save_best()
            if self.callback_on_new_best is not None:
                proceed = self.callback_on_new_best.on_step()
        self._evaluated(dict(zip(self.kinds(), played, strict=True)))
        if self.callback is not None:
            proceed = proceed and self._on_event()
        return proceed

    def _evaluated(self, played: dict[bool, Evaluation]) -> None:
        """Called after each evaluation with its episodes, by whether actions were most likely."""

    def _row(self, values: np.ndarray) -> list[Any]:
        """A value of each episode, NaN of those that were given up."""
        absent = np.full((self.n_eval_episodes - len(values), *values.shape[1:]), np.nan)
        return (np.concatenate([values, absent]) if len(absent) else values).tolist()

    def _log_costs(self, name: str, evaluation: Evaluation) -> None:
        """The mean of the costs' sum and, where there are several, of each."""
        self.logger.record(name, _mean(evaluation.costs))
        if len(self.cost_keys) > 1:
            for key, cost in zip(self.cost_keys, _mean(evaluation.key_costs), strict=True):
                self.logger.record(f"{name}/{key}", cost)

    def _log(self, evaluation: Evaluation) -> None:
        self.logger.record("eval/mean_reward", self.last_mean_reward)
        self.logger.record("eval/mean_ep_length", _mean(evaluation.lengths))
        self._log_costs("eval/mean_ep_cost", evaluation)
        if evaluation.limits.on == "max":
            self.logger.record("eval/mean_max_cost", _mean(evaluation.worst))
        if len(evaluation.successes):
            self.logger.record("eval/success_rate", float(evaluation.successes.mean()))
        # Written at once, so that the row bears the step of the evaluation.
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

    def _save_best(self) -> None:
        if self.best_model_save_path is None:
            return
        folder = Path(self.best_model_save_path)
        with replacing(folder / "best_model.zip") as file:
            self.model.save(file)
        normalizer = normalizer_of(self.training_env)
        if normalizer is not None:
            with replacing(folder / "best_model_vecnormalize.pkl") as file:
                pickle.dump(normalizer, file)

    def write_history(self) -> None:
        """Write all evaluations so far to ``evaluations.npz``."""
        if self.log_path is None:
            return
        arrays: dict[str, Any] = {
            "timesteps": self.evaluations_timesteps,
            "results": self.evaluations_results,
            "ep_lengths": self.evaluations_length,
            "costs": self.evaluations_costs,
        }
        if self.evaluations_key_costs:
            arrays["key_costs"] = self.evaluations_key_costs
        if self.evaluations_successes:
            arrays["successes"] = self.evaluations_successes
        with replacing(f"{self.log_path}.npz") as file:
            np.savez(file, **arrays)

    def state(self) -> dict[str, Any]:
        """What :meth:`restore` needs to continue the history and the choice of the best model."""
        return {name: copy.copy(getattr(self, name)) for name in KEPT}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from :meth:`state`; ``evaluations.npz`` is rewritten to match."""
        for name in KEPT:
            setattr(self, name, copy.copy(state[name]))
        self._remember(self.best_score)
        if self.evaluations_timesteps:
            self.write_history()

"""The costs of a training: limits, episodes, and what they say about the violation."""

import re
from collections import deque
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from stable_baselines3.common.callbacks import ProgressBarCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_guard.costs import EpisodeCosts, check_per_cost
from sb3_guard.vector import step_limits

_NUMBER = r"(-?\d+\.?\d*(?:e[+-]?\d+)?)"
_LINE = re.compile(f"lin_{_NUMBER}_{_NUMBER}")


def limits_at(limit: Any, remaining: float) -> Any:
    """A limit, or a list of limits, at a time of the training.

    :param limit: a number, ``"lin_50_25"`` for a line from 50 to 25, a function of the remaining
        progress, or a list of these
    :param remaining: progress to come, from 1 at the beginning to 0 at the end
    :return: the number or the list of numbers
    :raises ValueError: a text is no schedule
    """
    if isinstance(limit, list | tuple):
        return [limits_at(each, remaining) for each in limit]
    if isinstance(limit, str):
        line = _LINE.fullmatch(limit)
        if line is None:
            raise ValueError(
                f"cost_limit={limit!r}: must be a number, a function of the remaining progress, or "
                "text such as 'lin_50_25', a line from 50 to 25"
            )
        first, last = map(float, line.groups())
        return last + remaining * (first - last)
    return limit(remaining) if callable(limit) else limit


def scheduled_limits(algorithm: Any, remaining: float) -> np.ndarray:
    """d of each cost at a time of the training, by ``cost_limit`` and ``limit_start``, shape (m,).

    :param remaining: progress to come, from 1 at the beginning to 0 at the end
    :raises ValueError: ``cost_limit`` is not a limit, or is below 0 where it may not be
    """
    given, keys = algorithm.cost_limit, tuple(algorithm.cost_keys)
    limit = limits_at(given, remaining)
    check_per_cost("cost_limit", limit, keys)
    if not algorithm.signed_limits and np.min(limit) < 0.0:
        raise ValueError(
            f"cost_limit={limit!r}: must be at least 0; a negative limit (cost -x, "
            "limit -5: at least 5 of x) is for CPO, PCPO and Lagrangian algorithms"
        )
    limits = np.broadcast_to(np.asarray(limit, np.float64), (len(keys),))
    excess = LinearSchedule(algorithm.limit_start - 1.0, 0.0, algorithm.limit_fall)(remaining)
    given = given if isinstance(given, list | tuple) else [given]
    scheduled = [isinstance(each, str) or callable(each) for each in given]
    return limits + np.where(scheduled, 0.0, excess * np.abs(limits))


def time_limit(env: Any) -> float | None:
    """The mean over environments of the steps of an episode at most; None where not stated."""
    limits = step_limits(env)
    return float(np.mean(limits)) if limits else None


class CostBar(ProgressBarCallback):
    """SB3's progress bar, with the mean costs of the latest episodes."""

    def _on_rollout_end(self) -> None:
        if latest := self.model.costs.latest:  # type: ignore[attr-defined]
            means = map("{:.2f}".format, np.mean(latest, axis=0))
            self.pbar.set_description(f"cost {', '.join(means)}", refresh=False)


class Costs:
    """What an algorithm knows of its m costs; saved with it.

    Episodes under way outlive rollouts. The estimate, J_C and T, is of the episodes that ended
    since the last one (off-policy J_C is of the latest ones), and is compared with the limits as
    they are now.

    :param limits: what the next update keeps J_C within, d unless the algorithm aims lower,
        shape (m,)
    :param limit_on: what of an episode's costs the limits bound, see :class:`EpisodeCosts`
    :param window: number of the latest episodes that logs are about
    """

    def __init__(
        self, limits: np.ndarray, limit_on: Literal["sum", "max"] = "sum", window: int = 100
    ) -> None:
        self.limits = limits
        self.limit_on = limit_on
        #: J_C, mean cost of the episodes that ended, shape (m,); None before the first estimate
        self.episode_cost: Any = None
        #: T, the length of an episode, steps
        self.horizon: Any = None
        #: costs of the latest episodes, each of shape (m,), and of all steps, shape (m,)
        self.latest: deque[np.ndarray] = deque(maxlen=window)
        self.total = np.zeros(len(limits))
        #: whether an ``info`` ever had one of the keys
        self.seen = False
        self._length: float | None = None  # T when an episode last ended
        self.forget()

    def begin(self, n_envs: int) -> None:
        """Begin new episodes in all environments."""
        shape = n_envs, len(self.limits)
        self.episodes = EpisodeCosts(*shape, self.limit_on)
        #: what the last step cost, 0 before the first one of an episode, shape (n_envs, m)
        self.last = np.zeros(shape)
        #: what the limits bound, of the latest episodes, each of shape (m,)
        self.recent: deque[np.ndarray] = deque(maxlen=100)

    def forget(self) -> None:
        """Forget the episodes that have ended: the next estimate is about others."""
        self.ended: list[np.ndarray] = []
        self._lengths: list[int] = []
        self.seen_lately = False

    def step(
        self, costs: np.ndarray, dones: np.ndarray, seen: bool, broken: Sequence[int] = ()
    ) -> np.ndarray:
        """Add a step of every environment.

        :param costs: shape (n_envs, m)
        :param dones: environments whose episodes it ended, shape (n_envs,)
        :param seen: whether an ``info`` had one of the keys
        :param broken: environments whose episodes an error of the simulation ended: nobody knows
            what they would have cost
        :return: what the step adds to what the limits bound, shape (n_envs, m)
        """
        for episode in self.episodes.step(costs, dones):
            if episode.row in broken:
                continue
            self.ended.append(episode.bounded)
            self.recent.append(episode.bounded)
            self._lengths.append(episode.length)
            self.latest.append(episode.total)
        self.seen_lately |= seen
        self.total += costs.sum(axis=0)
        self.last = np.where(dones[:, None], 0.0, costs)
        return self.episodes.charges

    def estimate(self, rate: np.ndarray | None = None, length: Any = None) -> bool:
        """Renew J_C and T from the episodes that ended since the last time.

        :param rate: mean costs of a step, shape (m,), which tell what an episode would cost where
            none has ended; None keeps the last estimate then
        :param length: says how long an episode is where none has ended so far
        :return: whether there is a new estimate
        """
        self.seen |= self.seen_lately
        if self.ended:
            self.horizon = self._length = float(np.mean(self._lengths))
            self.episode_cost = np.mean(self.ended, axis=0)
        elif rate is not None:
            self.horizon = self._length or length()
            self.episode_cost = rate * self.horizon
        return bool(self.ended) or rate is not None

    @property
    def violation(self) -> np.ndarray:
        """(J_C - limits) / T, in the per-step units of mean(ratio · cost advantage), shape (m,)."""
        return (self.episode_cost - self.limits) / self.horizon


class Margin:
    """A margin m below the limits, learnt from what updates really bring.

    ::

        keep   J_Ci ≤ d_i - m_i,        m_i ← clip(m_i + α (J_Ci - d_i), 0, |d_i|)

    A step and the cost that it promises come from the same rollout, so it promises more than it
    brings, and J_C settles above d. m learns by how much. At a limit of 0 there is no margin.
    """

    def __init__(self, n_costs: int) -> None:
        self.value = np.zeros(n_costs)  # m, in units of an episode's cost

    def violation(self, costs: Costs) -> np.ndarray:
        """(J_C - (d - m)) / T, shape (m,)."""
        return costs.violation + self.value / costs.horizon

    def follow(self, costs: Costs, rate: float) -> None:
        """Move by α = ``rate`` times what the limits were missed by."""
        missed = costs.episode_cost - costs.limits
        self.value = np.clip(self.value + rate * missed, 0.0, np.abs(costs.limits))


def discounted_limit(limits: np.ndarray, horizon: float, gamma: float, cut: bool) -> np.ndarray:
    """The limits d of an episode's cost as limits of a discounted cost-to-go.

    A constant cost of d/T per step has the discounted sum ``d_γ = (d/T) (1 - γᵀ)/(1 - γ)``, and
    ``(d/T) / (1 - γ)`` where the time limit of an episode is bootstrapped as if it went on.

    :param limits: d, shape (m,)
    :param horizon: T, steps
    :param gamma: discount factor of the costs
    :param cut: whether episodes are cut by a time limit, which is bootstrapped where γ < 1
    :return: d_γ, shape (m,); d itself where γ is 1
    """
    if gamma == 1.0:
        return limits
    return limits / horizon * (1.0 if cut else 1.0 - gamma**horizon) / (1.0 - gamma)


def inverse(deviation: np.ndarray) -> np.ndarray:
    """1 / deviation, 0 where that is 0."""
    return np.divide(1.0, deviation, out=np.zeros_like(deviation), where=deviation > 0.0)

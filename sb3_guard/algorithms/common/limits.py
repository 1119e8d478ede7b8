"""The limits of the costs: numbers, or schedules over the training."""

import re
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.checks import check_per_cost

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


class CostLimits:
    """Bounds on costs of an episode, which may change over the training.

    :param cost_limit: d, bound on the undiscounted cost of an episode; one number, or one per key.
        The attribute may be set at any time, and holds from the next update on. Instead of a
        number, a function of the remaining progress (from 1 to 0), or text such as ``"lin_50_25"``,
        a line from 50 to 25 over the training
    :param cost_keys: entries of ``info`` that hold the costs of a step
    :param limit_start: how many times ``cost_limit`` the limit is when the training begins; it
        falls to ``cost_limit`` along a line. 1 for ``cost_limit`` from the first step on; a limit
        of 0 is 0 throughout, and a schedule begins where it says
    :param limit_fall: share of the training over which it falls
    """

    #: Whether costs and limits may be negative: "at least x" of what is reported as -cost.
    signed_limits: ClassVar[bool] = False

    cost_limit: float | Schedule | Sequence[float | Schedule] = hyperparameter(0.0)
    cost_keys: Sequence[str] = hyperparameter(("cost",))
    limit_start: float = hyperparameter(1.0, low=1.0)
    limit_fall: float = hyperparameter(0.6, high=1.0, ends="(]")

    _current_progress_remaining: float

    @property
    def cost_limits(self) -> np.ndarray:
        """d: what ``cost_limit`` says now, for each cost key, shape (m,).

        :raises ValueError: ``cost_limit`` was set to something that is not a limit
        """
        return self._limits_at(self._current_progress_remaining)

    @property
    def final_cost_limits(self) -> np.ndarray:
        """The limits at the end of the training, by which an agent is judged, shape (m,)."""
        return self._limits_at(0.0)

    @property
    def limits_change(self) -> bool:
        """Whether a limit is a schedule, or falls from ``limit_start``."""
        return self.limit_start > 1.0 or any(self._scheduled)

    @property
    def _scheduled(self) -> list[bool]:
        """Of each limit that is given, whether it is a schedule; one element, or m."""
        limits = self.cost_limit if isinstance(self.cost_limit, list | tuple) else [self.cost_limit]
        return [isinstance(limit, str) or callable(limit) for limit in limits]

    def _check_cost_limit(self) -> None:
        for remaining in (1.0, 0.0):
            self._limits_at(remaining)

    def _limits_at(self, remaining: float) -> np.ndarray:
        limit = limits_at(self.cost_limit, remaining)
        check_per_cost("cost_limit", limit, tuple(self.cost_keys))
        if not self.signed_limits and np.min(limit) < 0.0:
            raise ValueError(
                f"cost_limit={limit!r}: must be at least 0; a negative limit (cost -x, "
                "limit -5: at least 5 of x) is for CPO, PCPO and Lagrangian algorithms"
            )
        limits = np.broadcast_to(np.asarray(limit, np.float64), (len(self.cost_keys),))
        excess = LinearSchedule(self.limit_start - 1.0, 0.0, self.limit_fall)(remaining)
        return limits + np.where(self._scheduled, 0.0, excess * np.abs(limits))

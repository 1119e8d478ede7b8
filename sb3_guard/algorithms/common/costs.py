"""The costs of a rollout, compared with their limits."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class CostEstimate(NamedTuple):
    """What a rollout says about the costs, m of them.

    :param episode_cost: J_C, mean undiscounted cost of an episode, from those that ended, shape
        (m,)
    :param horizon: T, the length of an episode, steps
    :param violation: (J_C - d) / T, in the per-step units of mean(ratio · cost advantage),
        shape (m,)
    """

    episode_cost: np.ndarray
    horizon: float
    violation: np.ndarray


def weights(lengths: Sequence[int], within: Sequence[int]) -> np.ndarray:
    """What episodes that ended in a rollout count for in their mean, 1 on average, at least 0.

    A rollout in which a long episode ends has fewer others, so that in a plain mean of n a long one
    counts for more than it does among all episodes: where costs and lengths go together, the mean
    is off by ``cov(cost, length) / (n T)``. That is true of rollouts longer than episodes; of
    shorter ones, which see little of an episode, a share of it. Equal lengths count alike.

    :param lengths: of the episodes, steps
    :param within: how many of those steps are of this rollout
    :return: shape (n,)
    """
    n, steps = len(lengths), np.array(lengths, np.float64)
    share = np.sum(within) / steps.sum()
    return 1.0 - share * (steps / steps.mean() - 1.0) / max(n - 1, 1)


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

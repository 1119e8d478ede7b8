"""The costs of a rollout, compared with their limits."""

from typing import NamedTuple

import numpy as np


class CostEstimate(NamedTuple):
    """What the latest episodes say about the costs, m of them.

    :param episode_cost: J_C, mean undiscounted cost of the episodes that ended, shape (m,)
    :param horizon: T, the length of an episode, steps
    :param violation: (J_C - d) / T, in the per-step units of mean(ratio · cost advantage),
        shape (m,)
    """

    episode_cost: np.ndarray
    horizon: float
    violation: np.ndarray


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


def same_at_every_step(costs: np.ndarray) -> np.ndarray:
    """Which of m costs are the same, and not 0, at each step of a rollout, shape (m,) bool.

    :param costs: shape (T, n, m)
    """
    first = costs[0, 0]
    return (first != 0.0) & (costs == first).all(axis=(0, 1))


def inverse(deviation: np.ndarray) -> np.ndarray:
    """1 / deviation, 0 where that is 0."""
    return np.divide(1.0, deviation, out=np.zeros_like(deviation), where=deviation > 0.0)

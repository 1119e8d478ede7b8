"""A safety margin below the limits, learnt from what updates really bring."""

from typing import Any

import numpy as np

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.trust_region import TrustRegion


class Margin(TrustRegion):
    """Trust-region steps that aim below the limits by what they have missed them so far.

    ::

        keep   J_Ci ≤ d_i - m_i,        m_i ← clip(m_i + α (J_Ci - d_i), 0, |d_i|)

    A step and the cost that it promises come from the same rollout, so it promises more than it
    brings, and J_C settles above d. m learns by how much. At a limit of 0 there is no margin.

    Where no step of the trust region reaches the limits, a step asks for a share, ``recovery``, of
    the largest possible decrease and leaves the rest of the region to the reward: a limit that
    nothing keeps does not end all learning.

    :param margin_lr: α, how fast the margin follows J_C - d; 0 for no margin, as in the papers
    :param recovery: share of the largest possible decrease of a cost that a step asks for where the
        limit is out of reach; 1 for all of it, as in the papers
    """

    signed_limits = True

    margin_lr: float = hyperparameter(0.1)
    recovery: float = hyperparameter(0.98, high=1.0, ends="(]")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.margin: np.ndarray | None = None  # m, in units of an episode's cost, shape (m,)
        super().__init__(*args, **kwargs)

    def violation(self) -> np.ndarray:
        margin = 0.0 if self.margin is None else self.margin
        return self.costs.violation + margin / self.costs.horizon

    def fit(self, batch: CostRolloutBufferSamples) -> None:
        limits = self.cost_limits
        before = np.zeros(len(limits)) if self.margin is None else self.margin
        missed = self.costs.episode_cost - limits
        self.margin = np.clip(before + self.margin_lr * missed, 0.0, np.abs(limits))
        self._record_per_cost("train/cost_margin", self.margin)

"""CRPO: a step for the reward while the limits hold, else a step against the cost."""

from typing import Any, ClassVar

import numpy as np
import torch as th

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.trust_region import TrustRegion


class CRPO(TrustRegion):
    """Constraint-rectified policy optimisation (Xu et al., 2021, arXiv 2011.05869).

    ::

        maximise J(π)   subject to J_Ci(π) ≤ d_i

    No multiplier: if ``J_Ci ≤ d_i + η d_i`` for all i, a natural step up E[ratio · A], otherwise a
    natural step down the cost that is violated most in units of its limit.

    :param tolerance: η, what a limit may be exceeded by before the cost is lowered, as a share of
        the limit
    """

    label, family, paper = "CRPO", "Primal", "Xu et al. 2021"
    search_space: ClassVar[dict[str, Any]] = {
        "tolerance": {"low": 0.0, "high": 0.2},
    }

    tolerance: float = hyperparameter(0.0)

    @property
    def violated(self) -> int | None:
        """Index of the cost that is to be lowered; None while the limits hold."""
        limits, cost = self.costs.limits, self.costs.episode_cost
        excess = cost - limits * (1.0 + self.tolerance)
        # a limit of 0 is no unit: any cost above it exceeds it by as much as it is
        unit = np.where(limits > 0.0, limits, np.where(cost == 0.0, 1.0, np.abs(cost)))
        worst = int(np.argmax(excess / unit))
        return worst if excess[worst] > 0.0 else None

    def advantages(self, batch: CostRolloutBufferSamples) -> th.Tensor:
        worst = self.violated
        self.logger.record("train/rectifies", float(worst is not None))
        return batch.advantages if worst is None else -batch.cost_advantages[:, worst]

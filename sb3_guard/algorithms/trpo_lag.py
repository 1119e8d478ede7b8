"""TRPO-Lagrangian: the cost joins the objective at a price that follows the violation."""

import torch as th

from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.lagrangian import Lagrangian
from sb3_guard.algorithms.common.trust_region import TrustRegion


class TRPOLag(Lagrangian, TrustRegion):
    """TRPO on the Lagrangian (Ray et al., 2019; Bohez et al., 2019, arXiv 1902.04623).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    The multipliers ascend, ``λ ← max(0, λ + η (J_C - d))``, with J_C and d of whole episodes; then
    the policy takes a TRPO step on ``E[ratio · (A - Σ λ_i A_Ci)] / (1 + Σ λ_i)``. The division
    keeps the objective's scale; the direction of a trust-region step does not depend on it.
    """

    label, family, paper = "TRPO-Lagrangian", "Lagrangian", "Ray et al. 2019"

    def surrogate(self, batch: CostRolloutBufferSamples, ratio: th.Tensor) -> th.Tensor:
        price = th.as_tensor(self.price()).to(batch.cost_advantages)
        advantages = batch.advantages - batch.cost_advantages @ price
        return (ratio * advantages).mean() / (1.0 + price.sum())

"""Trust-region steps on a Lagrangian, which TRPO-Lagrangian and RCPO share."""

from typing import Any, ClassVar

import torch as th

from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.costs import inverse
from sb3_guard.algorithms.common.lagrangian import Lagrangian
from sb3_guard.algorithms.common.trust_region import TrustRegion


class PenalizedTrustRegion(Lagrangian, TrustRegion):
    """Trust-region steps on (A - Σ λ_i A_Ci) / (1 + Σ λ_i)."""

    search_space: ClassVar[dict[str, Any]] = {
        "lambda_lr": {"low": 0.02, "high": 1.0, "log": True},
        "proportional_gain": {"low": 0.1, "high": 20.0, "log": True},
        "derivative_gain": {"low": 0.0, "high": 4.0},
        "lambda_smoothing": {"low": 0.0, "high": 0.9},
    }

    defaults: ClassVar[dict[str, Any]] = {
        "lambda_lr": 0.2,
        "proportional_gain": 1.0,
        "lambda_smoothing": 0.5,
        "lambda_units": "relative",
    }

    def surrogate(self, batch: CostRolloutBufferSamples, ratio: th.Tensor) -> th.Tensor:
        deviation = batch.cost_advantages.std(dim=0, correction=0).double().cpu().numpy()
        weight = self.cost_weight(self.advantage_unit() * inverse(deviation))
        weighted = batch.cost_advantages @ th.as_tensor(weight).to(batch.cost_advantages)
        advantages = batch.advantages - weighted
        return (ratio * advantages).mean() / (1.0 + float(self.multiplier.value.sum()))

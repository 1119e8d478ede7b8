"""TRPO-Lagrangian: TRPO with a multiplier for each cost, which follows the violation."""

from typing import Any, ClassVar, Literal

import torch as th

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.costs import inverse
from sb3_guard.algorithms.common.lagrangian import Lagrangian
from sb3_guard.algorithms.common.trust_region import TrustRegion


class TRPOLag(Lagrangian, TrustRegion):
    """TRPO on the Lagrangian (Ray et al., 2019; Bohez et al., 2019, arXiv 1902.04623).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    The multipliers ascend on the violation, ``λ ← max(0, λ + η (J_C - d) / d)``, with J_C and d of
    whole episodes, and gains of a controller (Stooke et al., 2020) keep them from circling the
    optimum; then the policy takes a TRPO step on ``E[ratio · (A - Σ λ_i A_Ci)]``, A and A_C each in
    its standard deviation. While no limit is exceeded the run equals TRPO's, bit for bit.
    """

    label, family, paper = "TRPO-Lagrangian", "Lagrangian", "Ray et al. 2019"
    search_space: ClassVar[dict[str, Any]] = {
        "lambda_lr": {"low": 0.02, "high": 1.0, "log": True},
        "proportional_gain": {"low": 0.1, "high": 20.0, "log": True},
        "derivative_gain": {"low": 0.0, "high": 4.0},
        "lambda_smoothing": {"low": 0.0, "high": 0.9},
    }

    lambda_lr: float = hyperparameter(0.2)
    proportional_gain: float = hyperparameter(1.0)
    derivative_gain: float = hyperparameter(0.5)
    lambda_smoothing: float = hyperparameter(0.5, high=1.0)
    lambda_units: Literal["relative", "cost"] = hyperparameter("relative")

    def train(self) -> None:
        self.step()
        super().train()

    def advantages(self, batch: CostRolloutBufferSamples) -> th.Tensor:
        deviation = batch.cost_advantages.std(dim=0, correction=0).double().cpu().numpy()
        weights = self.weights(self.advantage_unit() * inverse(deviation))
        return batch.advantages - batch.cost_advantages @ th.as_tensor(weights).to(batch.advantages)

"""RCPO: natural gradient steps on the penalised reward, the penalty learnt slowly."""

from typing import Any, ClassVar, Literal

import torch as th

from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.lagrangian import Lagrangian, inverse
from sb3_guard.algorithms.common.trust_region import Trial, TrustRegion


class RCPO(Lagrangian, TrustRegion):
    """Reward-constrained policy optimisation (Tessler et al., 2019, arXiv 1805.11074).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    on two time scales: the policy takes a natural step of length √(2δ), without a line search, on
    ``A - Σ λ_i A_Ci``, and the multipliers follow the violation more slowly.
    """

    label, family, paper = "RCPO", "Lagrangian", "Tessler et al. 2019"
    search_space: ClassVar[dict[str, Any]] = {
        "lambda_lr": {"low": 0.02, "high": 1.0, "log": True},
        "proportional_gain": {"low": 0.0, "high": 4.0},
    }

    def __init__(
        self,
        *args: Any,
        lambda_lr: float = 0.5,
        proportional_gain: float = 2.0,
        lambda_units: Literal["relative", "cost"] = "relative",
        **kwargs: Any,
    ) -> None:
        super().__init__(
            *args,
            lambda_lr=lambda_lr,
            proportional_gain=proportional_gain,
            lambda_units=lambda_units,
            **kwargs,
        )

    def surrogate(self, batch: CostRolloutBufferSamples, ratio: th.Tensor) -> th.Tensor:
        deviation = batch.cost_advantages.std(dim=0, correction=0).double().cpu().numpy()
        price = th.as_tensor(self.price(inverse(deviation))).to(batch.cost_advantages)
        advantages = batch.advantages - batch.cost_advantages @ price
        return (ratio * advantages).mean() / (1.0 + price.sum())

    def accept(self, trial: Trial) -> bool:
        return True

"""FOCOPS: the best policy near the old one, known in closed form, is followed by gradient steps."""

from typing import Any, ClassVar, Literal

import torch as th
from stable_baselines3.common.distributions import Distribution

from sb3_guard.algorithms.common.actor import kl
from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.first_order import FirstOrder
from sb3_guard.algorithms.common.lagrangian import Lagrangian


class FOCOPS(Lagrangian, FirstOrder):
    """First-order constrained optimisation in policy space (Zhang et al., 2020, arXiv 2002.06506).

    ::

        maximise   E[A]  over all policies near the old one π_k
        subject to J_C + E[A_C] ≤ d,   E[KL(π ‖ π_k)] ≤ δ

    has the solution ``π* ∝ π_k exp((A - Σ ν_i A_Ci) / T)``. The parameters follow it down

    ::

        E[ 1{KL(π_θ ‖ π_k)(s) ≤ η} · ( KL(π_θ ‖ π_k)(s) - ratio · (A - Σ ν_i A_Ci) / T ) ]

    state by state: a state whose policy has moved too far is left alone. The multipliers ν ascend
    on the violations, and T is a temperature, not a multiplier.

    :param temperature: T, called λ in the paper
    :param trust_region: η, KL divergence up to which a state is learnt from
    """

    label, family, paper = "FOCOPS", "First-order", "Zhang et al. 2020"
    search_space: ClassVar[dict[str, Any]] = {
        "lambda_lr": {"low": 0.02, "high": 1.0, "log": True},
        "proportional_gain": {"low": 0.0, "high": 4.0},
        "temperature": {"low": 0.5, "high": 5.0, "log": True},
    }
    fixed_arguments: ClassVar[frozenset[str]] = FirstOrder.fixed_arguments | {
        "clip_range", "clip_range_vf"
    }  # fmt: skip

    lambda_lr: float = hyperparameter(0.25)
    proportional_gain: float = hyperparameter(0.5)
    lambda_units: Literal["relative", "cost"] = hyperparameter("relative")
    temperature: float = hyperparameter(1.5, ends="()")
    trust_region: float = hyperparameter(0.02, ends="()")

    def train(self) -> None:
        self.step()
        weight = self.weights(self.advantage_unit() * self.centre_costs())
        self._weight = th.as_tensor(weight, device=self.device)
        self._old = self.snapshot()
        super().train()

    def loss(
        self, batch: CostRolloutBufferSamples, ratio: th.Tensor, distribution: Distribution
    ) -> th.Tensor:
        divergence = kl(distribution, self._old.at(batch.places))
        near = (divergence.detach() <= self.trust_region).to(divergence)
        advantages = batch.advantages - batch.cost_advantages @ self._weight
        return (near * (divergence - ratio * advantages / self.temperature)).mean()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_old", "_weight"]

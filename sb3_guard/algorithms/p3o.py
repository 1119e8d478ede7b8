"""P3O: PPO with an exact penalty on the violation, and no multiplier."""

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.distributions import Distribution

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.first_order import FirstOrder


class P3O(FirstOrder):
    """Penalized proximal policy optimisation (Zhang et al., 2022, arXiv 2205.11814).

    ::

        min_θ   -E[min(ratio · A, clip(ratio) · A)]
                + κ Σ max(0, E[max(ratio · A_Ci, clip(ratio) · A_Ci)] + (J_Ci - d_i) / T)

    Above a finite κ the penalty is exact: its minimum keeps the limits. Cost advantages are centred
    within each minibatch, so that at the old policy the penalty is κ Σ max(0, (J_Ci - d_i) / T)
    and nothing else: the mean of 64 advantages alone would move it back and forth.

    A_C and the violation are divided by the standard deviation of A_C, and multiplied by that of A
    unless ``normalize_advantage`` makes it 1, so that the units of cost and reward do not matter.

    :param penalty: κ, in standard deviations of A per standard deviation of A_C
    """

    label, family, paper = "P3O", "First-order", "Zhang et al. 2022"
    search_space: ClassVar[dict[str, Any]] = {
        "penalty": {"low": 2.0, "high": 50.0, "log": True},
    }

    penalty: float = hyperparameter(20.0, ends="()")

    def train(self) -> None:
        unit = self.advantage_unit() * self.centre_costs()
        self._unit = th.as_tensor(unit, dtype=th.float32, device=self.device)
        violation = th.as_tensor(self.costs.violation, dtype=th.float32, device=self.device)
        self._violation = violation * self._unit
        super().train()

    def loss(
        self, batch: CostRolloutBufferSamples, ratio: th.Tensor, distribution: Distribution
    ) -> th.Tensor:
        penalty = self.penalties(batch, ratio).sum()
        return super().loss(batch, ratio, distribution) + self.penalty * penalty

    def penalties(self, batch: CostRolloutBufferSamples, ratio: th.Tensor) -> th.Tensor:
        """How far a minibatch says that each limit is exceeded, shape (m,)."""
        costs = batch.cost_advantages
        costs = (costs - costs.mean(dim=0)) * self._unit  # [B, m]
        clip = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
        change = th.max(ratio[:, None] * costs, clipped[:, None] * costs).mean(dim=0)
        return (change + self._violation).clamp(min=0.0)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_unit", "_violation"]

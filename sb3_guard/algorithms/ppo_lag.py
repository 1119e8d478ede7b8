"""PPO-Lagrangian: PPO with a multiplier for each cost, which follows the violation."""

from typing import Any, ClassVar, Literal

import numpy as np

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.first_order import FirstOrder
from sb3_guard.algorithms.common.lagrangian import Lagrangian


class PPOLag(Lagrangian, FirstOrder):
    """PPO on the Lagrangian (Ray et al., 2019; multipliers as in arXiv 2007.03964).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    Before each update the multipliers ascend on the violation, ``λ ← max(0, λ + η (J_C - d) / d)``,
    with J_C and d of whole episodes; a proportional term keeps them from circling the optimum.
    Then PPO learns from ``A - Σ λ_i A_Ci``, each in its standard deviation. While no limit is
    exceeded and with ``target_kl=None`` the run equals that of SB3's PPO, bit for bit.
    """

    label, family, paper = "PPO-Lagrangian", "Lagrangian", "Ray et al. 2019"
    search_space: ClassVar[dict[str, Any]] = {
        "lambda_lr": {"low": 0.02, "high": 1.0, "log": True},
        "proportional_gain": {"low": 0.0, "high": 4.0},
    }

    lambda_lr: float = hyperparameter(0.2)
    proportional_gain: float = hyperparameter(0.5)
    lambda_units: Literal["relative", "cost"] = hyperparameter("relative")

    def train(self) -> None:
        """λ follows J_C, PPO learns from A - Σ λ_i A_Ci, then the cost critic learns."""
        self.step()
        buffer = self.rollout_buffer
        # Where the reward's advantages are all alike, their unit is 1.
        spread = float(buffer.advantages.std()) or 1.0
        weights = self.weights(spread * self.centre_costs())
        if self.lambda_units == "cost" and self.normalize_advantage:
            weights *= np.float32(spread)  # as published: λ weighs A_C against the standardised A
        # PPO standardises the result by minibatch, so a division by 1 + Σ λ would change nothing.
        buffer.advantages = buffer.advantages - buffer.cost_advantages @ weights
        super().train()

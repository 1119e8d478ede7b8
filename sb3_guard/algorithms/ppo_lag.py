"""PPO-Lagrangian: PPO with a multiplier for each cost, which follows the violation."""

from typing import Any, ClassVar, Literal

import numpy as np
import torch as th
from stable_baselines3 import PPO

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.first_order import FirstOrder, mean_kl
from sb3_guard.algorithms.common.lagrangian import Lagrangian
from sb3_guard.algorithms.common.rollouts import CALM, CostRollouts


class PPOLag(Lagrangian, CostRollouts, PPO):
    """PPO on the Lagrangian (Ray et al., 2019; multipliers as in arXiv 2007.03964).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    Before each update the multipliers ascend on the violation, ``λ ← max(0, λ + η (J_C - d) / d)``,
    with J_C and d of whole episodes; a proportional term keeps them from circling the optimum.
    Then SB3's PPO learns from ``A - Σ λ_i A_Ci``, each in its standard deviation. While no limit
    is exceeded the run equals PPO's, bit for bit.

    :param target_kl: the passes over a rollout end with the first one after which the mean KL over
        the rollout exceeds it, where SB3's PPO looks at single minibatches; None for never. Losses
        are logged of the last pass
    """

    label, family, paper = "PPO-Lagrangian", "Lagrangian", "Ray et al. 2019"
    search_space: ClassVar[dict[str, Any]] = {
        **FirstOrder.search_space,
        "lambda_lr": {"low": 0.02, "high": 1.0, "log": True},
        "proportional_gain": {"low": 0.0, "high": 4.0},
    }
    policy_defaults: ClassVar[dict[str, Any]] = CALM

    lambda_lr: float = hyperparameter(0.2)
    proportional_gain: float = hyperparameter(0.5)
    lambda_units: Literal["relative", "cost"] = hyperparameter("relative")

    def __init__(
        self,
        *args: Any,
        gae_lambda: float = 0.97,
        target_kl: float | None = 0.02,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, gae_lambda=gae_lambda, target_kl=target_kl, **kwargs)

    def train(self) -> None:
        """λ follows J_C, SB3's PPO learns from A - Σ λ_i A_Ci, then the cost critic learns."""
        self.step()
        buffer = self.rollout_buffer
        # Where the reward's advantages are all alike, their unit is 1.
        spread = float(buffer.advantages.std()) or 1.0
        weights = self.weights(spread * self.centre_costs())
        if self.lambda_units == "cost" and self.normalize_advantage:
            weights *= np.float32(spread)  # as published: λ weighs A_C against the standardised A
        # PPO standardises the result by minibatch, so a division by 1 + Σ λ would change nothing.
        buffer.advantages = buffer.advantages - buffer.cost_advantages @ weights
        try:
            if self.target_kl is not None:
                self._take_passes(self.n_epochs, self.target_kl)
            else:
                super().train()
        except ValueError:  # torch refuses distributions of parameters that are not finite
            finite = all(bool(th.isfinite(weight).all()) for weight in self.policy.parameters())
            self._check_finite("policy_gradient_loss", 0.0 if finite else np.nan)
            raise
        for name in ("policy_gradient_loss", "value_loss"):
            self._check_finite(name, self.logger.name_to_value[f"train/{name}"])
        self.fit_cost_critic()

    def _take_passes(self, n_epochs: int, target_kl: float) -> None:
        """SB3's update, one pass at a time, until the mean KL over the rollout is too large."""
        self.n_epochs, self.target_kl = 1, None
        try:
            for _ in range(n_epochs):
                super().train()
                if mean_kl(self) > target_kl:
                    break
        finally:
            self.n_epochs, self.target_kl = n_epochs, target_kl

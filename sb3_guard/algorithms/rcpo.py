"""RCPO: natural gradient steps on the penalised advantage, without a line search."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.utils import obs_as_tensor

from sb3_guard.algorithms.common.advantage import discounted_returns
from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.costs import inverse
from sb3_guard.algorithms.common.penalized import PenalizedTrustRegion
from sb3_guard.algorithms.common.trust_region import Trial, TrustRegion


class RCPO(PenalizedTrustRegion):
    """Reward-constrained policy optimisation (Tessler et al., 2019, arXiv 1805.11074).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    The policy takes a natural step of length √(2δ), without a line search, on ``A - Σ λ_i A_Ci``,
    and the multipliers follow the violation as :class:`~sb3_guard.TRPOLag`'s do; the paper has them
    follow more slowly.

    :param penalized_reward: put the penalty into the reward, as the paper does: one critic learns
        r - Σ λ_i c_i, and there is none of the costs. Relative multipliers are then in units of the
        standard deviations of rewards- and costs-to-go
    """

    label, family, paper = "RCPO", "Lagrangian", "Tessler et al. 2019"
    defaults: ClassVar[dict[str, Any]] = {"lambda_lr": 0.1, "proportional_gain": 0.5}

    # penalized_reward refuses it
    search_space: ClassVar[dict[str, Any]] = {"cost_gae_lambda": None}

    penalized_reward: bool = hyperparameter(False)

    def _check_hyperparameters(self) -> None:
        super()._check_hyperparameters()
        for name in ("gamma", "gae_lambda") if self.penalized_reward else ():
            value = getattr(self, f"cost_{name}")
            if value is not None:
                raise ValueError(
                    f"cost_{name}={value!r}: must be None with penalized_reward, where one critic "
                    f"learns rewards and costs; set {name}"
                )

    def _setup_model(self) -> None:
        self.uses_cost_critic = not self.penalized_reward
        super()._setup_model()

    def train(self) -> None:
        if self.penalized_reward:
            self._penalize()
        super().train()

    @th.no_grad()
    def _penalize(self) -> None:
        """Take the priced costs off the rollout's rewards, and estimate the advantages again."""
        buffer = self.rollout_buffer
        assert self._last_obs is not None and self._last_episode_starts is not None
        dones = self._last_episode_starts

        def spread(values: np.ndarray) -> np.ndarray:
            to_go = discounted_returns(
                values, buffer.episode_starts, np.zeros_like(values[0]), dones, self.gamma
            )
            return to_go.std(axis=(0, 1), dtype=np.float64)

        price = self.price((spread(buffer.rewards) or 1.0) * inverse(spread(buffer.costs)))
        buffer.rewards = buffer.rewards - buffer.costs @ price
        last = self.policy.predict_values(obs_as_tensor(self._last_obs, self.device))
        buffer.compute_returns_and_advantage(last, dones)

    def surrogate(self, batch: CostRolloutBufferSamples, ratio: th.Tensor) -> th.Tensor:
        if self.penalized_reward:
            return TrustRegion.surrogate(self, batch, ratio)
        return super().surrogate(batch, ratio)

    def accept(self, trial: Trial) -> bool:
        return True

"""CUP: an update improves the policy as PPO does, then projects it towards the limits."""

from typing import Any, ClassVar, Literal

import torch as th
from stable_baselines3.common.distributions import Distribution

from sb3_guard.algorithms.common.actor import kl
from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.first_order import FirstOrder
from sb3_guard.algorithms.common.lagrangian import Lagrangian


class CUP(Lagrangian, FirstOrder):
    """Constrained update projection (Yang et al., 2022, arXiv 2209.07089).

    ::

        π_{k+½} = PPO's step on A alone
        π_{k+1} = argmin  E[ KL(π_{k+½} ‖ π) + Σ ν_i · (1 - γλ)/(1 - γ) · ratio · A_Ci ]

    Both steps use the rollout of π_k, and ``ratio = π / π_k``. The multipliers ν ascend on the
    violations. The factor comes from the paper's bound with generalised advantages, and grows
    without bound as γ → 1.

    ``target_kl`` stops the first step by its distance from π_k, ``projection_reach`` times that the
    second by its distance from π_{k+½}. A KL divergence grows with the square of the distance: at 4
    the second may take back what the first has done, and go as far again to the other side.

    :param projection_reach: KL from π_{k+½} at which the second step stops, in ``target_kl``;
        without ``target_kl`` nothing stops it
    """

    label, family, paper = "CUP", "First-order", "Yang et al. 2022"
    search_space: ClassVar[dict[str, Any]] = {
        "lambda_lr": {"low": 0.005, "high": 0.2, "log": True},
        "proportional_gain": {"low": 0.0, "high": 1.0},
    }

    fuse_adam = True  # it takes twice as many steps as PPO's

    # The second step's gains are small, since the factor above is four with the defaults.
    lambda_lr: float = hyperparameter(0.016)
    proportional_gain: float = hyperparameter(0.08)
    lambda_units: Literal["relative", "cost"] = hyperparameter("relative")
    projection_reach: float = hyperparameter(4.0, ends="()")

    # At the limit the second step takes back what the first has done: with PPO's ten passes there
    # is much noise in both.
    def __init__(self, *args: Any, n_epochs: int = 5, **kwargs: Any) -> None:
        super().__init__(*args, n_epochs=n_epochs, **kwargs)

    def _check_hyperparameters(self) -> None:
        super()._check_hyperparameters()
        if (self.gamma if self.cost_gamma is None else self.cost_gamma) == 1.0:
            raise ValueError("cost_gamma=1.0: CUP's weight of costs has no bound there; give 0.99")

    @property
    def factor(self) -> float:
        """(1 - γλ)/(1 - γ), with the discount and the λ of the cost advantages."""
        gamma, gae_lambda = self.rollout_buffer.cost_gamma, self.rollout_buffer.cost_gae_lambda
        return (1.0 - gamma * gae_lambda) / (1.0 - gamma)

    def train(self) -> None:
        self.step()
        self._weight = th.as_tensor(self.weights(self.centre_costs()), device=self.device)
        super().train()  # PPO's, on the rewards
        if bool(self._weight.any()):
            self._improved = self.snapshot()
            self.descend(
                self.projection, values=False, start=self._improved, reach=self.projection_reach
            )

    def projection(
        self, batch: CostRolloutBufferSamples, ratio: th.Tensor, distribution: Distribution
    ) -> th.Tensor:
        """What the second step descends on a minibatch: a scalar."""
        divergence = kl(self._improved.at(batch.places), distribution)
        cost = ratio * (batch.cost_advantages @ self._weight)
        return (divergence + self.factor * cost).mean()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_improved", "_weight"]

"""TRPO-FAC: a Lagrangian whose price of the cost depends on the state."""

from typing import Any, Literal

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import update_learning_rate

from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.checks import check_choice, check_integer, check_number
from sb3_guard.algorithms.common.costs import discounted_limit
from sb3_guard.algorithms.common.multipliers import StateMultiplier
from sb3_guard.algorithms.common.trust_region import TrustRegion


class TRPOFAC(TrustRegion):
    """TRPO with the state-wise multipliers of feasible actor-critic (Ma et al., 2021, 2105.10682).

    ::

        max_π min_ξ   E_s[ V(s) - Σ λ_i(s; ξ) (V_Ci(s) - d_γi) ],   λ_i(s; ξ) ≥ 0

    a limit at every state: the cost-to-go from s, discounted, is to stay below
    ``d_γ = (d/T) (1 - γᵀ)/(1 - γ)``. The policy takes a TRPO step on
    ``E[ratio · (A - Σ λ_i(s) A_Ci)]``; then Adam raises λ(s) where the returns of the batch exceed
    d_γ and lowers it elsewhere.

    :param policy: policy class or its alias
    :param env: environment or its id
    :param learning_rate: of the critics
    :param lambda_lr: learning rate of the multiplier networks
    :param lambda_epochs: steps of the multiplier networks per update, on the whole rollout
    :param lambda_init: multiplier to start near; None for about log 2, where softplus is of 0
    :param mode: ``"statewise"`` as above; ``"expected"`` raises the mean of λ(s) by J_C - d, as
        the GUARD paper writes it: all states then see the same violation

    Other parameters are those of :class:`TrustRegion`.
    """

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        *,
        lambda_lr: float = 1e-4,
        lambda_epochs: int = 1,
        lambda_init: float | None = None,
        mode: Literal["statewise", "expected"] = "statewise",
        **kwargs: Any,
    ) -> None:
        self.lambda_lr = lambda_lr
        self.lambda_epochs = lambda_epochs
        self.lambda_init = lambda_init
        self.mode = mode
        super().__init__(policy, env, learning_rate, **kwargs)

    def _check_hyperparameters(self) -> None:
        super()._check_hyperparameters()
        check_number("lambda_lr", self.lambda_lr)
        check_integer("lambda_epochs", self.lambda_epochs)
        if self.lambda_init is not None:
            check_number("lambda_init", self.lambda_init, ends="()")
        check_choice("mode", self.mode, "statewise", "expected")

    def _setup_model(self) -> None:
        super()._setup_model()
        self.multiplier = StateMultiplier(
            self.policy, len(self.cost_keys), self.lambda_lr, self.lambda_init
        )

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "multiplier", "multiplier.optimizer"], tensors

    def surrogate(self, batch: CostRolloutBufferSamples, ratio: th.Tensor) -> th.Tensor:
        price = self.multiplier.predict(batch.observations)  # [N, m]
        return (ratio * (batch.advantages - (price * batch.cost_advantages).sum(dim=1))).mean()

    def fit(self, batch: CostRolloutBufferSamples) -> None:
        assert self.costs is not None
        if self.mode == "statewise":
            gamma = self.rollout_buffer.cost_gamma
            limit = discounted_limit(self.cost_limits, self.costs.horizon, gamma)
            excess = batch.cost_returns - th.as_tensor(limit).to(batch.cost_returns)
        else:
            violation = th.as_tensor(self.costs.episode_cost - self.cost_limits)
            excess = violation.to(batch.cost_returns).expand_as(batch.cost_returns)
        # As with the critics' rate: what the attribute says, not what a file has restored.
        update_learning_rate(self.multiplier.optimizer, self.lambda_lr)
        for _ in range(self.lambda_epochs):
            self.multiplier.ascend(batch.observations, excess)
        price = self.multiplier.predict(batch.observations).cpu().numpy()
        self._record_per_cost("train/multiplier", price.mean(axis=0))
        self._record_per_cost("train/multiplier_std", price.std(axis=0))

"""TRPO-Lagrangian: the cost joins the objective at a price that follows the violation."""

from typing import Any, Literal

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import update_learning_rate

from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.checks import check_choice, check_number
from sb3_guard.algorithms.common.multipliers import Multiplier
from sb3_guard.algorithms.common.trust_region import TrustRegion


class TRPOLag(TrustRegion):
    """TRPO on the Lagrangian (Ray et al., 2019; Bohez et al., 2019, arXiv 1902.04623).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    The policy takes a TRPO step on ``E[ratio · (A - Σ λ_i A_Ci)] / (1 + Σ λ_i)``, then the
    multipliers ascend: ``λ ← max(0, λ + η (J_C - d))``, with J_C and d of whole episodes. The
    division keeps the objective's scale; the direction of a trust-region step does not depend
    on it.

    :param policy: policy class or its alias
    :param env: environment or its id
    :param learning_rate: of the critics
    :param lambda_lr: η
    :param lambda_init: multipliers before the first update
    :param lambda_max: bound on the multipliers; None for none
    :param lambda_optimizer: ``"sgd"`` ascends as above, ``"adam"`` lets Adam choose the steps
    :param proportional_gain: with ``derivative_gain``, turns the ascent into a PID controller
        (Stooke et al., 2020, arXiv 2007.03964) whose integral gain is ``lambda_lr``
    :param derivative_gain: of the rise of J_C from one update to the next

    Other parameters are those of :class:`TrustRegion`.
    """

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        *,
        lambda_lr: float = 0.005,
        lambda_init: float = 0.0,
        lambda_max: float | None = None,
        lambda_optimizer: Literal["sgd", "adam"] = "sgd",
        proportional_gain: float = 0.0,
        derivative_gain: float = 0.0,
        **kwargs: Any,
    ) -> None:
        self.lambda_lr = lambda_lr
        self.lambda_init = lambda_init
        self.lambda_max = lambda_max
        self.lambda_optimizer = lambda_optimizer
        self.proportional_gain = proportional_gain
        self.derivative_gain = derivative_gain
        super().__init__(policy, env, learning_rate, **kwargs)

    def _check_hyperparameters(self) -> None:
        super()._check_hyperparameters()
        for name in ("lambda_lr", "lambda_init", "proportional_gain", "derivative_gain"):
            check_number(name, getattr(self, name))
        if self.lambda_max is not None:
            check_number("lambda_max", self.lambda_max, float(self.lambda_init))
        check_choice("lambda_optimizer", self.lambda_optimizer, "sgd", "adam")

    def _setup_model(self) -> None:
        super()._setup_model()
        self.multiplier = Multiplier(
            len(self.cost_keys),
            self.lambda_lr,
            self.lambda_init,
            self.lambda_max,
            self.lambda_optimizer == "adam",
            self.proportional_gain,
            self.derivative_gain,
        )

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "multiplier", "multiplier.optimizer"], tensors

    def surrogate(self, batch: CostRolloutBufferSamples, ratio: th.Tensor) -> th.Tensor:
        price = self.multiplier.value.to(batch.cost_advantages)
        advantages = batch.advantages - batch.cost_advantages @ price
        return (ratio * advantages).mean() / (1.0 + price.sum())

    def fit(self, batch: CostRolloutBufferSamples) -> None:
        assert self.costs is not None
        # As with the critics' rate: what the attribute says, not what a file has restored.
        update_learning_rate(self.multiplier.optimizer, self.lambda_lr)
        self.multiplier.update(self.costs.episode_cost, self.cost_limits)
        self._record_per_cost("train/multiplier", self.multiplier.value.numpy())

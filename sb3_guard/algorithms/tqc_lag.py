"""TQC-Lagrangian: TQC with critics of the costs' distributions, and multipliers."""

from typing import Any

import torch as th
from sb3_contrib import TQC
from sb3_contrib.common.utils import quantile_huber_loss
from stable_baselines3.common.policies import BasePolicy

from sb3_guard.algorithms.common.cost_critics import CostQ
from sb3_guard.algorithms.common.soft import SoftActorCritic


class CostQuantiles(CostQ):
    """Quantiles of the discounted cost-to-go, of networks like those of TQC's critic.

    TQC drops the highest quantiles of the return-to-go from its targets, since an actor that
    climbs a critic seeks out what the critic overrates. What it underrates of a cost is sought out
    in the same way, so the lowest quantiles are dropped here.

    :param policy: TQC's
    :param n_costs: number m of costs
    :param learning_rate: at the beginning
    :param drop: quantiles to drop per network
    """

    def __init__(
        self,
        policy: BasePolicy,
        n_costs: int,
        learning_rate: float,
        drop: int,
    ) -> None:
        kwargs: dict[str, Any] = policy.critic_kwargs  # type: ignore[assignment]
        networks, outputs = kwargs["n_critics"], kwargs["n_quantiles"]
        super().__init__(policy, n_costs, learning_rate, networks, outputs)
        self.dropped = drop * networks

    def value(self, predicted: th.Tensor) -> th.Tensor:
        """Mean over networks and quantiles."""
        return predicted.mean(dim=(2, 3))

    def samples(self, predicted: th.Tensor) -> th.Tensor:
        """The quantiles of all networks without the lowest ones."""
        return predicted.flatten(2).sort(dim=2).values[:, :, self.dropped :]

    def loss(self, predicted: th.Tensor, target: th.Tensor) -> th.Tensor:
        """TQC's, the mean over costs."""
        return quantile_huber_loss(
            predicted.flatten(0, 1), target.flatten(0, 1)[:, None], sum_over_quantiles=False
        )


class TQCLag(SoftActorCritic, TQC):
    """TQC on the Lagrangian (Kuznetsov et al., 2020, arXiv 2005.04269, with multipliers).

    ::

        max_π min_{λ ≥ 0}   J(π) + α H(π) - Σ λ_i (J_Ci(π) - d_i)

    Returns-to-go and costs-to-go are learnt as distributions. The actor descends
    ``(α log π - Q + Σ λ_i Q_Ci) / (1 + Σ λ_i)`` with the means of both; the multipliers follow the
    mean cost of the latest episodes. With ``ent_coef="auto"`` and while no limit is exceeded the
    run equals SB3-contrib's TQC, bit for bit.
    """

    label, family, paper = "TQC-Lagrangian", "Lagrangian", "Kuznetsov et al. 2020"

    def make_cost_critic(self) -> CostQ:
        rate, drop = self.lr_schedule(1), self.top_quantiles_to_drop_per_net
        return CostQuantiles(self.policy, len(self.cost_keys), rate, drop)

    def next_values(self, values: th.Tensor) -> th.Tensor:
        dropped = self.top_quantiles_to_drop_per_net * self.critic.n_critics
        kept = self.critic.quantiles_total - dropped
        return values.flatten(1).sort().values[:, :kept]

    def critic_loss(self, values: th.Tensor, target: th.Tensor) -> th.Tensor:
        return quantile_huber_loss(values, target[:, None], sum_over_quantiles=False)

    def estimate(self, values: th.Tensor) -> th.Tensor:
        return values.mean(dim=2).mean(dim=1, keepdim=True)

    expected = estimate

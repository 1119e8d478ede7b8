"""TRPO-FAC: TRPO with multipliers that depend on the state."""

from typing import Any, ClassVar, Literal

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import update_learning_rate
from torch import nn
from torch.nn import functional as F

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.batches import chunks, rows
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.critics import StateNetwork
from sb3_guard.algorithms.common.lagrangian import HIGHEST
from sb3_guard.algorithms.common.trust_region import TrustRegion

TINY = 1e-12
LOWEST = -4.0  # an output that lowers λ no more: 0.018


class StateMultiplier(nn.Module):
    """λ_i(s) ≥ 0 for each constraint: networks of the observation with a softplus output.

    :param policy: the policy whose extractor and architecture each network copies
    :param n_costs: number m of constraints, and of networks
    :param rate: learning rate of their Adam
    :param init: λ that a network without inputs would start at; None leaves the output bias as it
        was drawn, which starts λ near log 2 ≈ 0.69
    :param ascent: see :class:`TRPOFAC`
    :param maximum: λ above it falls, whatever the excess
    """

    def __init__(
        self,
        policy: ActorCriticPolicy,
        n_costs: int,
        rate: float,
        init: float | None = None,
        ascent: Literal["output", "value"] = "output",
        maximum: float = np.inf,
    ) -> None:
        super().__init__()
        self.ascent = ascent
        self.maximum = maximum
        self.networks = nn.ModuleList(StateNetwork(policy, 1) for _ in range(n_costs))
        if init is not None:
            for network in self.networks:
                *_, last = network.parameters()
                # softplus(x) = init
                nn.init.constant_(last, init + np.log(-np.expm1(-init)))
        self.optimizer = th.optim.Adam(self.parameters(), lr=rate)

    @th.no_grad()
    def predict(self, observations: PyTorchObs) -> th.Tensor:
        """Multipliers at observations, shape [B, m], in slices that bound the memory."""
        each = [network.predict(observations) for network in self.networks]  # type: ignore
        return F.softplus(th.cat(each, dim=1))

    def ascend(self, observations: PyTorchObs, excess: th.Tensor) -> None:
        """One step up the mean over the batch of ``Σ_i λ_i(s) · excess_i``, or of outputs for λ.

        :param observations: batch of N observations
        :param excess: how far each state's cost is above its limit, shape [N, m]
        """
        self.optimizer.zero_grad(set_to_none=True)
        for index in chunks(len(excess)):
            part, above = rows(observations, index), excess[index]
            moved = th.cat([network(part) for network in self.networks], dim=1)
            value = F.softplus(moved)
            above = th.where(value.detach() > self.maximum, -above.abs(), above)
            if self.ascent == "value":
                moved = value
            else:
                above = above * ((above > 0.0) | (moved.detach() > LOWEST))
            gain = (moved * above).sum() / len(excess)
            (-gain).backward()
        self.optimizer.step()


class TRPOFAC(TrustRegion):
    """TRPO with the state-wise multipliers of feasible actor-critic (Ma et al., 2021, 2105.10682).

    ::

        max_π min_ξ   E_s[ V(s) - Σ λ_i(s; ξ) (V_Ci(s) - d_γi) ],   λ_i(s; ξ) ≥ 0

    a limit at every state: the cost-to-go from s, discounted, is to stay below
    ``d_γ = (d/T) (1 - γᵀ)/(1 - γ)``, or ``(d/T) / (1 - γ)`` where a time limit cuts episodes, whose
    cost is bootstrapped. The policy takes a TRPO step on
    ``E[ratio · (A - Σ p_i A_Ci)]``; then Adam raises λ(s) where the returns of the batch exceed
    d_γ and lowers it elsewhere. The weight p of an action begins with
    ``λ(s) + K_P (V_C(s) - d_γ) / d_γ``, from 0 to 5, the fraction between -1 and 1, which keeps λ
    from circling the optimum. As the action changes the cost to come of all states before it, its
    weight is the highest of theirs, discounted. A and A_C are both standardised, so λ weighs a
    standard deviation of the one against one of the other, and the unit of the costs does not
    matter.

    :param lambda_lr: learning rate of the multiplier networks
    :param lambda_epochs: steps of the multiplier networks per update, on the whole rollout
    :param lambda_init: multiplier to start near; None starts near log 2, the softplus of 0
    :param mode: ``"statewise"`` as above; ``"expected"`` raises the mean of λ(s) by J_C - d, as
        the GUARD paper writes it: all states then see the same violation
    :param units: ``"relative"`` as above; ``"cost"`` leaves A_C in the unit of the costs, and λ and
        p without a bound, as the papers do
    :param proportional_gain: K_P; 0 in the papers
    :param lambda_ascent: ``"output"`` moves the argument of the softplus by the violation itself,
        down to -4, where λ is 0.018; ``"value"`` by the gradient of λ as in the papers, which
        vanishes as λ does, so that a λ that has fallen stays there
    :param trace: whether the weights of earlier states apply to an action too; in the papers its
        weight is that of its own state
    """

    label, family, paper = "TRPO-FAC", "Lagrangian", "Ma et al. 2021"
    search_space: ClassVar[dict[str, Any]] = {
        "lambda_lr": {"low": 1e-5, "high": 1e-2, "log": True},
        "lambda_epochs": {"low": 1, "high": 20, "log": True},
        "proportional_gain": {"low": 0.0, "high": 10.0},
    }

    lambda_lr: float = hyperparameter(3e-3)
    lambda_epochs: int = hyperparameter(3)
    lambda_init: float | None = hyperparameter(None, ends="()")
    mode: Literal["statewise", "expected"] = hyperparameter("statewise")
    units: Literal["relative", "cost"] = hyperparameter("relative")
    lambda_ascent: Literal["output", "value"] = hyperparameter("output")
    proportional_gain: float = hyperparameter(5.0)
    trace: bool = hyperparameter(True)

    def _setup_model(self) -> None:
        super()._setup_model()
        highest = max(HIGHEST, self.lambda_init or 0.0) if self.units == "relative" else np.inf
        self.multiplier = StateMultiplier(
            self.policy,
            len(self.cost_keys),
            self.lambda_lr,
            self.lambda_init,
            self.lambda_ascent,
            highest,
        )

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "multiplier", "multiplier.optimizer"], tensors

    def advantages(self, batch: CostRolloutBufferSamples) -> th.Tensor:
        weight = self.weights(batch)
        self._record_per_cost("train/cost_weight", weight.mean(dim=0).cpu().numpy())
        return batch.advantages - (weight * batch.cost_advantages).sum(dim=1)

    def weights(self, batch: CostRolloutBufferSamples) -> th.Tensor:
        """What a unit of each cost's advantage is worth at each step of the rollout, [N, m]."""
        weight = self.multiplier.predict(batch.observations)
        if self.proportional_gain:
            excess = self.proportional_gain * self._excess(batch)
            weight = (weight + excess).clamp(0.0, self.multiplier.maximum)
        if self.trace:
            weight = self._trace(weight)
        if self.units == "relative":
            deviation = batch.cost_advantages.std(dim=0)
            weight = self.advantage_unit() * weight / (deviation + TINY)
        return weight

    def _excess(self, batch: CostRolloutBufferSamples) -> th.Tensor:
        """By what part of its limit the cost to come exceeds it, between -1 and 1, [N, m]."""
        buffer = self.rollout_buffer
        expected = th.as_tensor(buffer.swap_and_flatten(buffer.cost_values)).to(batch.cost_returns)
        # the critic has not seen this rollout, whose mean is known
        expected = expected + (batch.cost_returns - expected).mean(dim=0)
        excess, limit = self._violation(expected)
        unit = th.where(limit == 0.0, batch.cost_returns.mean(dim=0), limit).abs()
        return (excess / (unit + TINY)).clamp(-1.0, 1.0)

    def _trace(self, weight: th.Tensor) -> th.Tensor:
        """The highest weight of the steps up to each of its episode, discounted, [N, m].

        An action changes the costs to come of all states before it. A rollout that begins within an
        episode knows of no step before its first.
        """
        buffer = self.rollout_buffer
        steps = weight.reshape(buffer.n_envs, buffer.buffer_size, -1).clone()
        kept = th.as_tensor(buffer.cost_gamma * (1.0 - buffer.episode_starts)).to(steps)  # [T, n]
        for t in range(1, buffer.buffer_size):
            th.maximum(steps[:, t], kept[t, :, None] * steps[:, t - 1], out=steps[:, t])
        return steps.reshape(weight.shape)

    def _violation(self, to_come: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """By how much costs exceed their limit, [N, m], and the limit, [m].

        :param to_come: each step's discounted cost to come, [N, m]
        """
        if self.mode == "statewise":
            bound = self.discounted_limits()
        else:
            bound = self.costs.limits
            to_come = th.as_tensor(self.costs.episode_cost).to(to_come).expand_as(to_come)
        limit = th.tensor(bound).to(to_come)
        return to_come - limit, limit

    def fit(self, batch: CostRolloutBufferSamples) -> None:
        excess, _ = self._violation(batch.cost_returns)
        # As with the critics' rate: what the attribute says, not what a file has restored.
        update_learning_rate(self.multiplier.optimizer, self.lambda_lr)
        for _ in range(self.lambda_epochs):
            self.multiplier.ascend(batch.observations, excess)
        weight = self.multiplier.predict(batch.observations).cpu().numpy()
        self._record_per_cost("train/multiplier", weight.mean(axis=0))
        self._record_per_cost("train/multiplier_std", weight.std(axis=0))

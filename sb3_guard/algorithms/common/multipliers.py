"""Lagrange multipliers: numbers that follow the violation, and functions of the state."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

from sb3_guard.algorithms.common.actor import n_rows, rows
from sb3_guard.algorithms.common.critics import StateNetwork
from sb3_guard.algorithms.common.mlp import chunks


def _only_of_its_kind(optimizer: th.optim.Optimizer, state: dict[str, Any]) -> dict[str, Any]:
    """The state to load: begun afresh where it is SGD's and the optimizer Adam, or vice versa."""
    both = optimizer.param_groups, state["param_groups"]
    adam, was_adam = ("betas" in groups[0] for groups in both)
    return state if adam == was_adam else optimizer.state_dict()


class Multiplier(nn.Module):
    """One λ ≥ 0 per constraint, raised while its limit is broken and lowered while it holds.

    With violation Δ = J_C - d, in the units of an episode's cost, an update is

        I ← clip(I + η Δ, 0, max)
        λ ← clip(I + K_P Δ + K_D max(0, J_C - J_C before), 0, max)

    With both gains zero this is projected gradient ascent of the Lagrangian; otherwise the
    controller of Stooke et al. (2020, arXiv 2007.03964, algorithm 2).

    :param n_costs: number m of constraints
    :param rate: η
    :param init: λ before the first update
    :param maximum: bound on λ and I; None for none
    :param adam: let Adam scale the ascent of I instead of taking it as it is
    :param proportional: K_P
    :param derivative: K_D
    """

    def __init__(
        self,
        n_costs: int,
        rate: float,
        init: float = 0.0,
        maximum: float | None = None,
        adam: bool = False,
        proportional: float = 0.0,
        derivative: float = 0.0,
    ) -> None:
        super().__init__()
        self.maximum = maximum
        self.proportional = proportional
        self.derivative = derivative
        start = th.full((n_costs,), float(init), dtype=th.float64)
        self.integral = nn.Parameter(start)
        self.register_buffer("value", start.clone())
        self.register_buffer("last_cost", th.full_like(start, np.inf))  # nothing has risen yet
        kind = th.optim.Adam if adam else th.optim.SGD
        self.optimizer = kind([self.integral], lr=rate)
        self.optimizer.register_load_state_dict_pre_hook(_only_of_its_kind)

    value: th.Tensor
    last_cost: th.Tensor

    @th.no_grad()
    def update(self, cost: np.ndarray, limit: np.ndarray) -> None:
        """Follow the violation.

        :param cost: J_C, shape (m,)
        :param limit: d, shape (m,)
        """
        now = th.tensor(cost)
        violation = now - th.tensor(limit)
        self.integral.grad = -violation
        self.optimizer.step()
        self.integral.clamp_(0.0, self.maximum)
        rise = (now - self.last_cost).clamp_(min=0.0)
        self.last_cost.copy_(now)
        self.value.copy_(self.integral + self.proportional * violation + self.derivative * rise)
        self.value.clamp_(0.0, self.maximum)


class StateMultiplier(nn.Module):
    """λ_i(s) ≥ 0 for each constraint: networks of the observation with a softplus output.

    :param policy: the policy whose extractor and architecture each network copies
    :param n_costs: number m of constraints, and of networks
    :param rate: learning rate of their Adam
    :param init: λ that a network without inputs would start at; None leaves the output bias as it
        was drawn, which starts λ near log 2 ≈ 0.69
    """

    def __init__(
        self,
        policy: ActorCriticPolicy,
        n_costs: int,
        rate: float,
        init: float | None = None,
    ) -> None:
        super().__init__()
        self.networks = nn.ModuleList(StateNetwork(policy, 1) for _ in range(n_costs))
        if init is not None:
            for network in self.networks:
                *_, last = network.parameters()
                # softplus(x) = init
                nn.init.constant_(last, init + np.log(-np.expm1(-init)))
        self.optimizer = th.optim.Adam(self.parameters(), lr=rate)

    def forward(self, observations: PyTorchObs) -> th.Tensor:
        """Multipliers at observations, shape [B, m]."""
        return F.softplus(th.cat([network(observations) for network in self.networks], dim=1))

    @th.no_grad()
    def predict(self, observations: PyTorchObs) -> th.Tensor:
        """:meth:`forward` without gradients, in slices that bound the memory."""
        slices = chunks(n_rows(observations))
        return th.cat([self(rows(observations, index)) for index in slices])

    def ascend(self, observations: PyTorchObs, excess: th.Tensor) -> None:
        """One step up the mean over the batch of ``Σ_i λ_i(s) · excess_i``.

        :param observations: batch of N observations
        :param excess: how far each state's cost is above its limit, shape [N, m]
        """
        self.optimizer.zero_grad(set_to_none=True)
        self.networks.train(True)
        for index in chunks(len(excess)):
            gain = (self(rows(observations, index)) * excess[index]).sum() / len(excess)
            (-gain).backward()
        self.networks.train(False)
        self.optimizer.step()

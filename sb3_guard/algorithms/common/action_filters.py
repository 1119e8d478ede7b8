"""Filters that replace an action by a near one whose learned cost is below a threshold.

A filter sees actions in units of the action space: each runs from -1 to 1. It owns its network,
the network's optimizer, its thresholds, the units that the network measures costs in, and whether
it is switched on, so a policy that carries it acts the same wherever it is loaded. Filters compute
in torch's operators, with gradients written out, so that the same code acts and is exported.
"""

from collections.abc import Callable
from typing import Any

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

from sb3_guard.algorithms.common.critics import StateNetwork, regress

SWEEPS = 50  # corrections of an action where there are several costs


class ActionFilter(nn.Module):
    """What the filters share: a network, thresholds and units of cost, a switch.

    :param network: what is learned
    :param n_costs: number m of constraints
    """

    #: Whether :meth:`forward` makes use of what the last step cost.
    acts_on_cost = False

    def __init__(self, network: StateNetwork, n_costs: int) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("threshold", th.zeros(n_costs, dtype=th.float64))
        self.register_buffer("unit", th.ones(n_costs))
        # 0 or 1: a number, since SB3's tools draw, average and compare whole state dictionaries.
        self.register_buffer("active", th.zeros(()))

    threshold: th.Tensor
    unit: th.Tensor
    active: th.Tensor

    @property
    def optimizer(self) -> th.optim.Optimizer:
        """The network's."""
        return self.network.optimizer

    def predicted(self, batch: Any) -> th.Tensor:
        """What the filter believes of costs, in units of ``unit``, shape [B, k]."""
        raise NotImplementedError

    def learn(self, batch: Any, targets: th.Tensor, n_epochs: int, batch_size: int | None) -> float:
        """Fit :meth:`predicted` to targets, see :func:`regress`."""
        moving = self.network.parameters()
        return regress(self.predicted, moving, self.optimizer, batch, targets, n_epochs, batch_size)

    def forward(
        self, observations: PyTorchObs, actions: th.Tensor, costs: th.Tensor | None
    ) -> th.Tensor:
        """Actions to execute instead.

        :param observations: batch of B observations
        :param actions: in units of the action space, shape [B, k]
        :param costs: what the last step cost, shape [B, m], NaN where that is not known; None if
            it is known of none
        :return: actions inside the action space, shape [B, k]
        """
        raise NotImplementedError


def clip_along(actions: th.Tensor, normals: th.Tensor, limits: th.Tensor) -> th.Tensor:
    """Nearest points of the box [-1, 1]ᵏ in a half-space each: ``normal · x ≤ limit``.

    The solution is ``clip(a - μ normal, -1, 1)`` for the least μ ≥ 0 that does it. What has to be
    lowered is piecewise linear in μ with a kink where a coordinate meets the box, so μ follows
    from its values at two kinks: the greatest at which the half-space is not yet reached, and the
    least at which it is. Where the box has no point in the half-space, the coordinates move as far
    towards it as they can.

    :param actions: points a of the box, shape [B, k]
    :param normals: shape [B, k]
    :param limits: shape [B, 1]
    :return: shape [B, k]
    """
    # Where a coordinate meets its wall; one that does not move meets none.
    still = normals.abs() < 1e-12
    kinks = (normals.sign() + actions) / th.where(still, 1.0, normals)
    kinks = th.where(still, 0.0, kinks)
    kinks = th.cat([th.zeros_like(limits), kinks], dim=1)  # [B, 1 + k]
    points = actions.unsqueeze(1) - kinks.unsqueeze(2) * normals.unsqueeze(1)  # [B, 1 + k, k]
    excess = (points.clamp(-1.0, 1.0) * normals.unsqueeze(1)).sum(dim=2) - limits
    above = excess > 0.0
    last = kinks.amax(dim=1, keepdim=True)
    before = th.where(above, kinks, 0.0).amax(dim=1, keepdim=True)
    after = th.where(above, last, kinks).amin(dim=1, keepdim=True)
    high = th.where(above, excess, th.inf).amin(dim=1, keepdim=True)
    low = th.where(above, -th.inf, excess).amax(dim=1, keepdim=True)
    # Where even the last kink is not far enough, `after` and `before` are equal to it.
    mu = before + high / (high - low) * (after - before)
    mu = th.where(excess[:, :1] > 0.0, mu, 0.0)
    return (actions - mu * normals).clamp(-1.0, 1.0)


class SafetyLayer(ActionFilter):
    """Projects actions on half-spaces of a cost that is linear in the action (Dalal et al., 2018).

    The model is ``ĉ_i(s, a) = c_i + g_i(s) · a``, where c_i is what the last step cost and g a
    network; the layer executes the nearest action of the box with ĉ_i ≤ threshold_i. It
    leaves alone what exceeds that by at most noise_i, or where a unit of every action changes ĉ_i
    by at most noise_i. A second output ``h_i(s) ≈ c_i`` stands in where the last cost is not known.

    :param policy: the policy that carries the filter
    :param n_costs: number m of constraints
    :param drift: add ``b_i(s)`` to the model, for cost that changes whatever the robot does
    """

    acts_on_cost = True

    def __init__(self, policy: ActorCriticPolicy, n_costs: int, drift: bool = False) -> None:
        self.n_actions = get_action_dim(policy.action_space)
        self.drift = drift
        outputs = n_costs * (self.n_actions + 1 + drift)
        super().__init__(StateNetwork(policy, outputs), n_costs)
        self.register_buffer("noise", th.zeros(n_costs, dtype=th.float64))

    noise: th.Tensor

    def _split(self, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Slopes g [B, m, k], last costs h [B, m], drifts b [B, m], in the units of ``outputs``."""
        pieces = outputs.unflatten(1, (len(self.threshold), -1))
        slopes = pieces[..., : self.n_actions]
        drifts = pieces[..., -1] if self.drift else th.zeros_like(pieces[..., 0])
        return slopes, pieces[..., self.n_actions], drifts

    @th.no_grad()
    def error(
        self, observations: PyTorchObs, actions: th.Tensor, last: th.Tensor, costs: th.Tensor
    ) -> th.Tensor:
        """Root mean square error of ĉ, shape [m].

        :param observations: batch of B observations
        :param actions: executed ones, in units of the action space, shape [B, k]
        :param last: what the steps before cost, shape [B, m]
        :param costs: what these steps cost, shape [B, m]
        """
        slopes, _, drifts = self._split(self.network.predict(observations))
        change = (slopes * actions[:, None]).sum(dim=2) + drifts
        predicted = last + self.unit * change
        return (predicted - costs).square().mean(dim=0).sqrt()

    def predicted(self, batch: Any) -> th.Tensor:
        """Costs of a step and of the one before it, from (observations, executed actions, last)."""
        observations, actions, costs = batch
        slopes, last, drifts = self._split(self.network(observations))
        now = costs + (slopes * actions[:, None]).sum(dim=2) + drifts
        return th.cat([now, last], dim=1)

    def forward(
        self, observations: PyTorchObs, actions: th.Tensor, costs: th.Tensor | None
    ) -> th.Tensor:
        unit = self.unit.double()
        slopes, last, drifts = self._split(self.network(observations).double())
        slopes, last, drifts = unit[:, None] * slopes, unit * last, unit * drifts
        if costs is not None:
            # Of an infinite cost there would be no correction.
            last = th.where(th.isnan(costs), last, costs.double().clamp(max=1e30))
        limits = self.threshold - last - drifts
        actions = actions.double().clamp(-1.0, 1.0)
        excess = (slopes * actions.unsqueeze(1)).sum(dim=2) - limits  # [B, m]
        certain = (excess <= 0.0) | (excess > self.noise)
        certain = certain & (slopes.abs().sum(dim=2) > self.noise)
        slopes = th.where(certain.unsqueeze(2), slopes, 0.0)
        if len(self.threshold) == 1:
            return clip_along(actions, slopes[:, 0], limits)
        limits = th.maximum(limits, -slopes.abs().sum(dim=2))  # what the box can reach
        # Dykstra's alternating projections, on each half-space and the box, end at the nearest
        # point of them all.
        squares = slopes.square().sum(dim=2, keepdim=True).clamp(min=1e-24)
        moved, clipped = th.zeros_like(slopes), th.zeros_like(actions)
        for _ in range(SWEEPS):
            for i in range(len(self.threshold)):
                start, normal = actions + moved[:, i], slopes[:, i]
                beyond = (start * normal).sum(dim=1, keepdim=True) - limits[:, i : i + 1]
                moved[:, i] = beyond.clamp(min=0.0) / squares[:, i] * normal
                actions = start - moved[:, i]
            start = actions + clipped
            actions = start.clamp(-1.0, 1.0)
            clipped = start - actions
        return actions


_aten = th.ops.aten
#: What each activation makes of a gradient g, from its input x, its output h and its layer.
GRADIENTS: dict[type[nn.Module], Callable[..., th.Tensor]] = {
    nn.Tanh: lambda g, x, h, layer: _aten.tanh_backward(g, h),
    nn.ReLU: lambda g, x, h, layer: _aten.threshold_backward(g, h, 0.0),
    nn.ELU: lambda g, x, h, layer: _aten.elu_backward(g, layer.alpha, 1.0, 1.0, False, x),
    nn.LeakyReLU: lambda g, x, h, layer: g * th.where(x > 0.0, 1.0, layer.negative_slope),
    nn.SiLU: lambda g, x, h, layer: g * th.sigmoid(x) * (1.0 + x - h),
}


class UnrolledSafetyLayer(ActionFilter):
    """Descends a learned cost-to-go from the action (Zhang et al., 2022).

    ``Q_i(s, a) > 0`` are the discounted costs to come. Where one exceeds its threshold, the action
    takes up to ``steps`` steps of length ``rate`` (in its fastest coordinate) down
    ``Σ max(0, Q_i - threshold_i) / unit_i``.

    :param policy: the policy that carries the filter
    :param n_costs: number m of constraints
    :param steps: steps at most
    :param rate: length of a step
    :raises ValueError: the policy's activation is none whose derivative is known here
    """

    def __init__(
        self, policy: ActorCriticPolicy, n_costs: int, steps: int = 20, rate: float = 0.05
    ) -> None:
        self.steps = steps
        self.rate = rate
        self.n_actions = get_action_dim(policy.action_space)
        if policy.activation_fn not in GRADIENTS:
            names = ", ".join(kind.__name__ for kind in GRADIENTS)
            raise ValueError(
                f"activation_fn={policy.activation_fn.__name__}: the filter's gradient is written "
                f"out for {names}"
            )
        super().__init__(StateNetwork(policy, n_costs, self.n_actions), n_costs)

    def predicted(self, batch: Any) -> th.Tensor:
        """Costs to come, from (observations, actions)."""
        return F.softplus(self.network(*batch))

    @th.no_grad()
    def values(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """Discounted costs to come, shape [B, m].

        :param observations: batch of B observations
        :param actions: in units of the action space, shape [B, k]
        """
        return self.unit * F.softplus(self.network.predict(observations, actions))

    def forward(
        self, observations: PyTorchObs, actions: th.Tensor, costs: th.Tensor | None
    ) -> th.Tensor:
        features = self.network.extract_features(observations)
        first: Any = self.network.network[0]
        # The observation's share of the first layer stays the same.
        state = F.linear(features, first.weight[:, : -self.n_actions], first.bias)
        weight = first.weight[:, -self.n_actions :]
        least = (self.threshold / self.unit).float().clamp(min=1e-30)
        bound = least + th.log(-th.expm1(-least))  # where softplus is the threshold, [m]
        actions = actions.float().clamp(-1.0, 1.0)
        for _ in range(self.steps):
            down = self._slope(state, weight, bound, actions)
            if not (th.compiler.is_exporting() or bool(down.any())):
                break
            length = down.abs().amax(dim=1, keepdim=True)
            # rate · down / (length + 1e-8), in numbers that no optimiser of graphs takes for zero
            step = (self.rate * 1e8) * down / (1e8 * length + 1.0)
            actions = (actions - step).clamp(-1.0, 1.0)
        return actions

    def _slope(
        self, state: th.Tensor, weight: th.Tensor, bound: th.Tensor, actions: th.Tensor
    ) -> th.Tensor:
        """Gradient of ``Σ max(0, Q_i - threshold_i) / unit_i`` in the actions, shape [B, k].

        :param state: the first layer's outputs for the observations alone, shape [B, n]
        :param weight: the first layer's weights of the actions, shape [n, k]
        :param bound: outputs of the network at the thresholds, shape [m]
        """
        layers: list[Any] = [*self.network.network]
        x, passed = th.addmm(state, actions, weight.t()), []
        for activation, layer in zip(layers[1::2], layers[2::2], strict=True):
            h = activation(x)
            passed.append((x, h, activation, layer))
            x = F.linear(h, layer.weight, layer.bias)
        gradient = th.where(x > bound, th.sigmoid(x), 0.0)
        for x, h, activation, layer in reversed(passed):
            gradient = GRADIENTS[type(activation)](gradient @ layer.weight, x, h, activation)
        return gradient @ weight

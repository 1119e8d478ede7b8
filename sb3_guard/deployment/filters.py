"""The safety filters of TRPO-SL and TRPO-USL in tensor operators, their gradients written out.

No exporter knows ``autograd.grad``. The filters of ``algorithms/common/action_filters.py`` compute
in NumPy; those here compute the same in torch, on batches whose size may vary.
"""

from collections.abc import Callable
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

from sb3_guard.algorithms.common.action_filters import (
    ActionFilter,
    SafetyLayer,
    UnrolledSafetyLayer,
)


class Filter(nn.Module):
    """A filter of actions in units of the action space."""

    def forward(
        self, observations: PyTorchObs, actions: th.Tensor, last_cost: th.Tensor | None
    ) -> th.Tensor:
        """Corrected actions within [-1, 1], [B, k].

        :param observations: batch of B observations
        :param actions: [B, k]
        :param last_cost: what the last step cost, [B, 1], NaN where that is not known; None if the
            filter does not use it
        """
        raise NotImplementedError


def clip_along(actions: th.Tensor, normals: th.Tensor, limits: th.Tensor) -> th.Tensor:
    """Nearest points of the box [-1, 1]ᵏ in a half-space each: ``normal · x ≤ limit``.

    The solution is ``clip(a - μ normal, -1, 1)``, as in ``action_filters.clip_along``. There the
    kinks of what μ lowers are sorted; here the two on either side of zero are the greatest kink at
    which the half-space is not yet reached and the least at which it is.

    :param actions: points a of the box, [B, k]
    :param normals: [B, k]
    :param limits: [B, 1]
    :return: [B, k]
    """
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


class Projection(Filter):
    """TRPO-SL's layer for one cost: the nearest action whose predicted cost is low enough.

    :param layer: the policy's own
    """

    threshold: th.Tensor
    unit: th.Tensor
    noise: th.Tensor

    def __init__(self, layer: SafetyLayer) -> None:
        super().__init__()
        self.network, self.n_actions, self.drift = layer.network, layer.n_actions, layer.drift
        for name in ("threshold", "unit", "noise"):
            self.register_buffer(name, getattr(layer, name).detach().double())

    def forward(
        self, observations: PyTorchObs, actions: th.Tensor, last_cost: th.Tensor | None
    ) -> th.Tensor:
        assert last_cost is not None
        outputs = self.unit * self.network(observations).double()  # slopes, last cost, drift
        slopes, estimate = outputs[:, : self.n_actions], outputs[:, self.n_actions, None]
        last_cost = last_cost.double()
        last_cost = th.where(last_cost > 1e30, 1e30, last_cost)  # infinity would have no correction
        limits = self.threshold - th.where(th.isnan(last_cost), estimate, last_cost)
        if self.drift:
            limits = limits - outputs[:, -1:]
        actions = actions.double().clamp(-1.0, 1.0)
        excess = (slopes * actions).sum(dim=1, keepdim=True) - limits
        certain = (excess <= 0.0) | (excess > self.noise)
        certain = certain & (slopes.abs().sum(dim=1, keepdim=True) > self.noise)
        return clip_along(actions, th.where(certain, slopes, 0.0), limits)


def _elu(x: th.Tensor, h: th.Tensor, layer: nn.ELU) -> th.Tensor:
    return th.where(x > 0.0, 1.0, h + layer.alpha)


def _leaky_relu(x: th.Tensor, h: th.Tensor, layer: nn.LeakyReLU) -> th.Tensor:
    return th.where(x > 0.0, 1.0, layer.negative_slope)


def _silu(x: th.Tensor, h: th.Tensor, layer: nn.SiLU) -> th.Tensor:
    return th.sigmoid(x) * (1.0 + x - h)


#: The derivative of each activation from its input, its output and its layer.
DERIVATIVES: dict[type[nn.Module], Callable[..., th.Tensor]] = {
    nn.Tanh: lambda x, h, layer: 1.0 - h * h,
    nn.ReLU: lambda x, h, layer: (x > 0.0).float(),
    nn.ELU: _elu,
    nn.LeakyReLU: _leaky_relu,
    nn.SiLU: _silu,
}


class Descent(Filter):
    """TRPO-USL's layer: steps down the gradient of the predicted cost above the thresholds.

    :param layer: the policy's own
    :raises ValueError: its network has an activation whose derivative is not known here
    """

    bound: th.Tensor

    def __init__(self, layer: UnrolledSafetyLayer) -> None:
        super().__init__()
        self.network, self.n_actions = layer.network, layer.n_actions
        self.steps, self.rate = layer.steps, layer.rate
        layers: list[Any] = [*self.network.network]
        self.linear, self.activations = layers[0::2], layers[1::2]
        for activation in self.activations:
            if type(activation) not in DERIVATIVES:
                names = ", ".join(kind.__name__ for kind in DERIVATIVES)
                raise ValueError(
                    f"a safety filter with activation_fn={type(activation).__name__} can't be "
                    f"exported, since its gradient is written out; allowed: {names}"
                )
        least = (layer.threshold / layer.unit).float().clamp(min=1e-30)
        # where softplus is the threshold, [m]
        self.register_buffer("bound", least + th.log(-th.expm1(-least)))

    def forward(
        self, observations: PyTorchObs, actions: th.Tensor, last_cost: th.Tensor | None
    ) -> th.Tensor:
        features = self.network.extract_features(observations)
        # The observation's share of the first layer stays the same.
        first = self.linear[0]
        state = F.linear(features, first.weight[:, : -self.n_actions], first.bias)
        a = actions.clamp(-1.0, 1.0)
        for _ in range(self.steps):
            down = self._slope(state, a)
            length = down.abs().amax(dim=1, keepdim=True)
            # down / (length + 1e-8), in numbers that no optimiser of graphs takes for zero
            a = (a - self.rate * (1e8 * down) / (1e8 * length + 1.0)).clamp(-1.0, 1.0)
        return a

    def _slope(self, state: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Gradient of ``Σ max(0, softplus(network) - threshold)`` in the actions, [B, k]."""
        weight = self.linear[0].weight[:, -self.n_actions :]
        x = state + actions @ weight.t()
        derivatives = []
        for activation, layer in zip(self.activations, self.linear[1:], strict=True):
            h = activation(x)
            derivatives.append(DERIVATIVES[type(activation)](x, h, activation))
            x = layer(h)
        gradient = th.where(x > self.bound, th.sigmoid(x), 0.0)
        for derivative, layer in zip(reversed(derivatives), reversed(self.linear[1:]), strict=True):
            gradient = gradient @ layer.weight * derivative
        return gradient @ weight


def filter_of(layer: ActionFilter) -> Filter:
    """The filter that a policy carries, in operators.

    :raises ValueError: it can't be exported
    """
    if type(layer) is UnrolledSafetyLayer:
        return Descent(layer)
    if type(layer) is not SafetyLayer:
        raise ValueError(
            f"the safety filter {type(layer).__name__} can't be exported; "
            "allowed: SafetyLayer and UnrolledSafetyLayer"
        )
    if len(layer.threshold) > 1:
        raise ValueError(
            f"TRPO-SL with {len(layer.threshold)} costs can't be exported: its layer then solves a "
            "quadratic program; train it with one cost, or use trpo_usl"
        )
    return Projection(layer)

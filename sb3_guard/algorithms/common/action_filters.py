"""Filters that replace an action by a near one whose learned cost is below a threshold.

A filter sees actions in units of the action space: each runs from -1 to 1. It owns its network,
the network's optimizer, its thresholds, the units that the network measures costs in, and whether
it is switched on, so a policy that carries it acts the same wherever it is loaded.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

from sb3_guard.algorithms.common.critics import Regression, StateNetwork
from sb3_guard.algorithms.common.natural_gradient import shortest
from sb3_guard.algorithms.fast.mlp import TanhMlp, softplus_slope


class ActionFilter(nn.Module):
    """What the filters share: a network, thresholds and units of cost, a switch.

    :param network: what is learned
    :param n_costs: number m of constraints
    """

    #: Whether :meth:`correct` makes use of what the last step cost.
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

    def correct(
        self, observations: PyTorchObs, actions: np.ndarray, costs: np.ndarray | None
    ) -> np.ndarray:
        """Actions to execute instead.

        :param observations: batch of B observations
        :param actions: in units of the action space, shape [B, k]
        :param costs: what the last step cost, shape [B, m]; None if not known
        :return: actions inside the action space, shape [B, k]
        """
        raise NotImplementedError


def clip_along(actions: np.ndarray, normals: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Nearest points of the box [-1, 1]ᵏ in a half-space each: ``normal · x ≤ limit``.

    The solution is ``clip(a - μ normal, -1, 1)`` for the least μ ≥ 0 that does it. What has to be
    lowered is piecewise linear in μ with a kink where a coordinate meets the box, so μ follows
    from its values at the kinks. Where the box has no point in the half-space, the coordinates
    move as far towards it as they can.

    :param actions: points a of the box, shape [B, k]
    :param normals: shape [B, k]
    :param limits: shape [B]
    :return: shape [B, k]
    """
    k = normals.shape[1]
    # Where a coordinate meets its wall, [B, k]; one that does not move meets none.
    still = np.abs(normals) < 1e-12
    kinks = (np.sign(normals) + actions) / np.where(still, 1.0, normals)
    kinks = np.concatenate([np.zeros_like(limits)[:, None], np.where(still, 0.0, kinks)], axis=1)
    kinks.sort(axis=1)  # [B, 1 + k]
    points = np.clip(actions[:, None] - kinks[..., None] * normals[:, None], -1.0, 1.0)
    excess = np.einsum("bik,bk->bi", points, normals) - limits[:, None]  # [B, 1 + k], falling
    after = np.argmax(excess <= 0.0, axis=1)  # first kink that is far enough
    after[excess[:, -1] > 0.0] = k
    rows, before = np.arange(len(after)), np.maximum(after - 1, 0)
    drop = excess[rows, before] - excess[rows, after]
    share = np.clip(excess[rows, before] / np.where(drop > 0.0, drop, 1.0), 0.0, 1.0)
    mu = kinks[rows, before] + share * (kinks[rows, after] - kinks[rows, before])
    mu = np.where(excess[:, 0] <= 0.0, 0.0, mu)
    return np.clip(actions - mu[:, None] * normals, -1.0, 1.0)


# Weight of a squared violation against a squared change of the action, both as distances.
_SLACK = 1e8


def nearest_in_box(action: np.ndarray, normals: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Nearest point of the box [-1, 1]ᵏ with ``normals @ x ≤ limits``.

    A limit below what the box can reach on its own is first raised to that. Where the limits then
    contradict each other, the sum of the squared distances to the half-spaces is least.

    :param action: a point of the box, shape [k]
    :param normals: shape [m, k]
    :param limits: shape [m]
    :return: shape [k]
    """
    lengths = np.linalg.norm(normals, axis=1)
    moves = lengths > 1e-12
    limits = np.maximum(limits, -np.abs(normals).sum(axis=1))[moves] / lengths[moves]
    units = normals[moves] / lengths[moves, None]
    k, m = len(action), len(units)
    # Unknowns: the change of the action, and a scaled slack per half-space.
    half_spaces = np.hstack([units, -np.eye(m) / np.sqrt(_SLACK)])
    walls = np.hstack([np.vstack([np.eye(k), -np.eye(k)]), np.zeros((2 * k, m))])
    offsets = np.concatenate([units @ action - limits, action - 1.0, -action - 1.0])
    stacked = np.vstack([half_spaces, walls])
    multipliers, phi = shortest(stacked, offsets)
    change = -(stacked.T @ multipliers)[:k] / max(phi, 1e-12)
    return np.clip(action + change, -1.0, 1.0)


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

    def regression(self) -> Regression:
        """Fits batches (observations, executed actions, last costs) to (costs, last costs).

        Both costs are in units of ``unit``.
        """

        def readout(outputs: th.Tensor, batch: Any) -> th.Tensor:
            _, actions, costs = batch
            slopes, last, drifts = self._split(outputs)
            predicted = costs + (slopes * actions[:, None]).sum(dim=2) + drifts
            return th.cat([predicted, last], dim=1)

        return Regression.of_network(
            self.network, lambda batch: self.network.extract_features(batch[0]), readout
        )

    @th.no_grad()
    def correct(
        self, observations: PyTorchObs, actions: np.ndarray, costs: np.ndarray | None
    ) -> np.ndarray:
        slopes, last, drifts = (
            each.cpu().numpy().astype(np.float64)
            for each in self._split(self.network(observations))
        )
        unit = self.unit.cpu().numpy().astype(np.float64)
        slopes, last, drifts = unit[:, None] * slopes, unit * last, unit * drifts
        clipped = np.clip(actions.astype(np.float64), -1.0, 1.0)
        noise = self.noise.cpu().numpy()
        limits = self.threshold.cpu().numpy() - (last if costs is None else costs) - drifts
        excess = np.einsum("bmk,bk->bm", slopes, clipped) - limits
        certain = ((excess <= 0.0) | (excess > noise)) & (np.abs(slopes).sum(axis=2) > noise)
        slopes = np.where(certain[..., None], slopes, 0.0)
        if limits.shape[1] == 1:
            return clip_along(clipped, slopes[:, 0], limits[:, 0])
        broken = (certain & (excess > 0.0)).any(axis=1)
        for i in np.flatnonzero(broken):
            clipped[i] = nearest_in_box(clipped[i], slopes[i], limits[i])
        return clipped


class UnrolledSafetyLayer(ActionFilter):
    """Descends a learned cost-to-go from the action (Zhang et al., 2022).

    ``Q_i(s, a) > 0`` are the discounted costs to come. Where one exceeds its threshold, the action
    takes up to ``steps`` steps of length ``rate`` (in its fastest coordinate) down
    ``Σ max(0, Q_i - threshold_i) / unit_i``.

    :param policy: the policy that carries the filter
    :param n_costs: number m of constraints
    :param steps: steps at most
    :param rate: length of a step
    """

    def __init__(
        self, policy: ActorCriticPolicy, n_costs: int, steps: int = 20, rate: float = 0.05
    ) -> None:
        self.steps = steps
        self.rate = rate
        self.n_actions = get_action_dim(policy.action_space)
        super().__init__(StateNetwork(policy, n_costs, self.n_actions), n_costs)

    def regression(self) -> Regression:
        """Fits batches (observations, actions) to costs to come in units of ``unit``."""

        def inputs(batch: Any) -> th.Tensor:
            observations, actions = batch
            return th.cat([self.network.extract_features(observations), actions], dim=1)

        return Regression.of_network(self.network, inputs, lambda outputs, _: F.softplus(outputs))

    @th.no_grad()
    def values(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """Discounted costs to come, shape [B, m].

        :param observations: batch of B observations
        :param actions: in units of the action space, shape [B, k]
        """
        return self.unit * F.softplus(self.network.predict(observations, actions))

    def excess(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """What the layer descends, ``Σ max(0, Q_i - threshold_i) / unit_i``, shape [B].

        :param observations: batch of B observations
        :param actions: in units of the action space, shape [B, k]
        """
        above = self.values(observations, actions) - self.threshold.to(self.unit)
        return (above.clamp(min=0.0) / self.unit).sum(dim=1)

    def correct(
        self, observations: PyTorchObs, actions: np.ndarray, costs: np.ndarray | None
    ) -> np.ndarray:
        with th.no_grad():
            features = self.network.extract_features(observations)
        slope = self._slope(features)
        a = np.clip(actions, -1.0, 1.0).astype(np.float32)
        for _ in range(self.steps):
            down = slope(a)
            if not down.any():
                break
            length = np.abs(down).max(axis=1, keepdims=True)
            a = np.clip(a - self.rate * down / (length + 1e-8), -1.0, 1.0)
        return a

    def _slope(self, features: th.Tensor) -> Callable[[np.ndarray], np.ndarray]:
        """Gradient of ``Σ max(0, Q_i - threshold_i) / unit_i`` in the actions, each [B, k]."""
        layers = TanhMlp.layers([*self.network.network])
        threshold = (self.threshold / self.unit).to(features)
        if layers is not None and features.device.type == "cpu":
            return softplus_slope(TanhMlp(layers), features, self.n_actions, threshold.numpy())

        def slope(actions: np.ndarray) -> np.ndarray:
            a = th.as_tensor(actions, device=features.device).requires_grad_()
            with th.enable_grad():
                values = F.softplus(self.network.network(th.cat([features, a], dim=1)))
                excess = (values - threshold).clamp(min=0.0).sum()
            return th.autograd.grad(excess, a)[0].cpu().numpy()

        return slope

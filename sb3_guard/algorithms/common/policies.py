"""Policies that carry a filter of their actions: saved, loaded and acting with it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_guard.algorithms.common.action_filters import ActionFilter


class Box(nn.Module):
    """The bounds of actions, which no file keeps: the action space has them.

    :param space: the action space
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, space: spaces.Box) -> None:
        super().__init__()
        for name in ("low", "high"):
            bound = th.as_tensor(getattr(space, name).flatten()).float()
            self.register_buffer(name, bound, persistent=False)

    def clip(self, actions: th.Tensor) -> th.Tensor:
        """Actions inside the bounds, [B, k]."""
        return th.minimum(th.maximum(actions, self.low), self.high)

    def scale(self, unit: th.Tensor) -> th.Tensor:
        """Actions of the environment from those in [-1, 1], [B, k]."""
        return self.low + 0.5 * (unit + 1.0) * (self.high - self.low)

    def unit(self, actions: th.Tensor) -> th.Tensor:
        """The other way round, [B, k]."""
        half = ((self.high - self.low) / 2.0).clamp(min=th.finfo(th.float32).tiny)
        return (actions - self.low) / half - 1.0


class FilteredPolicy(ActorCriticPolicy):
    """An actor-critic policy whose ``predict`` corrects actions, once its filter is switched on.

    Distributions, log-probabilities and ``forward`` are those of the policy alone: the filter
    stands between policy and environment. Any policy class becomes one that carries a filter by
    ``class Mine(FilteredPolicy, TheirPolicy)``.

    :param action_filter: class and further arguments of the filter; None: none until
        :meth:`carry`

    Other parameters are those of SB3's ``ActorCriticPolicy``.
    """

    action_filter: Any  #: an :class:`~sb3_guard.algorithms.common.action_filters.ActionFilter`
    box: Box
    _filter: tuple[Callable[..., ActionFilter], dict[str, Any]] | None = None

    def __init__(
        self,
        *args: Any,
        action_filter: tuple[Callable[..., ActionFilter], dict[str, Any]] | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        if isinstance(self.action_space, spaces.Box):
            self.box = Box(self.action_space).to(self.device)
        if action_filter is not None:
            self.carry(*action_filter)

    def carry(self, kind: Callable[..., ActionFilter], arguments: dict[str, Any]) -> None:
        """Make a filter and carry it from now on.

        :param kind: its class
        :param arguments: of the class, in addition to the policy
        """
        self._filter = (kind, arguments)
        self.action_filter = kind(self, **arguments).to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "action_filter": self._filter}

    @property
    def acts_on_cost(self) -> bool:
        """Whether ``predict`` wants the last costs as its state."""
        return self._filter is not None and self.action_filter.acts_on_cost

    @property
    def corrects(self) -> bool:
        """Whether there is a filter, switched on."""
        return self._filter is not None and bool(self.action_filter.active)

    def executable(self, actions: np.ndarray) -> np.ndarray:
        """Sampled actions, flat or not, as SB3 hands them to the environment, shape [B, …]."""
        assert isinstance(self.action_space, spaces.Box)
        actions = actions.reshape(-1, *self.action_space.shape)
        if self.squash_output:
            return self.unscale_action(actions)
        return np.clip(actions, self.action_space.low, self.action_space.high)

    def filtered(
        self, observations: PyTorchObs, actions: th.Tensor, costs: th.Tensor | None
    ) -> th.Tensor:
        """What the filter, switched on or off, makes of actions.

        :param observations: batch of B observations
        :param actions: actions of the environment, flat, shape [B, k]
        :param costs: what the last step cost, shape [B, m], NaN where not known; None if of none
        :return: actions of the environment, flat, shape [B, k]
        """
        unit = self.box.unit(actions)
        corrected = self.action_filter(observations, unit, costs)
        # What is not corrected stays as it is, to the last bit.
        moved = (corrected - unit).abs().amax(dim=1, keepdim=True) > 1e-6
        scaled = self.box.scale(corrected).to(actions)
        return self.box.clip(th.where(moved, scaled, actions))

    @th.no_grad()
    def correct(
        self, observations: PyTorchObs, actions: np.ndarray, costs: np.ndarray | None = None
    ) -> np.ndarray:
        """The actions to execute; the same ones while the filter is switched off.

        :param observations: batch of B observations
        :param actions: actions of the environment, shape [B, …]
        :param costs: what the last step cost, shape [B, m]; None if not known
        :return: actions of the environment, shape [B, …]
        """
        if not self.corrects:
            return actions
        flat = th.as_tensor(actions.reshape(len(actions), -1), device=self.device)
        last = None if costs is None else th.as_tensor(costs).to(self.device)
        return self.filtered(observations, flat, last).cpu().numpy().reshape(actions.shape)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Corrected actions.

        :param observation: one observation or a batch
        :param state: ``(costs,)`` with what the last step cost, shape [B, m], if that is known and
            the filter makes use of it; None lets the filter estimate it
        :param episode_start: where an episode has just begun, shape [B]: nothing has cost yet
        :param deterministic: take the most likely action instead of sampling
        :return: actions to execute, and the state as it was given
        """
        actions, _ = super().predict(observation, None, episode_start, deterministic)
        if not self.corrects:
            return actions, state
        tensor, vectorized = self.obs_to_tensor(observation)
        batch = actions if vectorized else actions[None]
        costs = None
        if state is not None and self.acts_on_cost:
            costs = np.asarray(state[0], dtype=np.float64)
            if episode_start is not None:
                costs = np.where(np.asarray(episode_start, dtype=bool)[:, None], 0.0, costs)
        corrected = self.correct(tensor, batch, costs)
        return corrected if vectorized else corrected[0], state


class FilteredCnnPolicy(FilteredPolicy, ActorCriticCnnPolicy):
    """:class:`FilteredPolicy` of images."""


class FilteredMultiInputPolicy(FilteredPolicy, MultiInputActorCriticPolicy):
    """:class:`FilteredPolicy` of dictionaries."""

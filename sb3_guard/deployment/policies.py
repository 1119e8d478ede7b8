"""How a policy of Stable-Baselines3 acts, as a module of tensor operators without ``predict``.

An exporter sees operators alone, but ``predict`` uses NumPy for what comes after the network:
noise, squashing, clipping and safety filters. The modules here repeat it in operators.
"""

from typing import Any

import torch as th
from gymnasium import spaces
from sb3_contrib.tqc.policies import Actor as TQCActor
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.sac.policies import Actor as SACActor
from stable_baselines3.td3.policies import Actor as TD3Actor
from torch import nn

from sb3_guard.algorithms.common.action_filters import SafetyLayer
from sb3_guard.algorithms.common.policies import Box, FilteredPolicy


class Actor(nn.Module):
    """A policy, as a function of preprocessed observations and, if it samples, of noise.

    :param policy: the policy or actor whose networks it uses
    :param space: the action space
    :param sampled: whether it samples
    """

    policy: Any

    def __init__(self, policy: Any, space: spaces.Space, sampled: bool) -> None:
        super().__init__()
        self.policy, self.sampled = policy, sampled
        self.box: Any = Box(space) if isinstance(space, spaces.Box) else None

    def forward(self, observations: PyTorchObs, noise: th.Tensor | None) -> th.Tensor:
        """Actions of the environment, a Box's in float32 and flat, [B, k]; a Discrete's, [B].

        :param observations: batch of B observations, as the policy knows them
        :param noise: standard normal numbers, [B, k]; None if the policy does not sample
        """
        raise NotImplementedError


class Gaussian(Actor):
    """Actor of PPO, TRPO and their like for a Box: clipped mean, or mean plus scaled noise."""

    def forward(self, observations: PyTorchObs, noise: th.Tensor | None) -> th.Tensor:
        actions = _output(self.policy, observations)
        if noise is not None:
            actions = actions + th.exp(self.policy.log_std) * noise
        return self.box.clip(actions)


class Categorical(Actor):
    """The same for a Discrete space: the likeliest action."""

    def forward(self, observations: PyTorchObs, noise: th.Tensor | None) -> th.Tensor:
        return _output(self.policy, observations).argmax(dim=1)


class Squashed(Actor):
    """Actor of SAC and TQC: the hyperbolic tangent of a Gaussian, scaled to the box."""

    def forward(self, observations: PyTorchObs, noise: th.Tensor | None) -> th.Tensor:
        actions, log_std, _ = self.policy.get_action_dist_params(observations)
        if noise is not None:
            actions = actions + th.exp(log_std) * noise
        return self.box.scale(th.tanh(actions))


class Deterministic(Actor):
    """Actor of TD3 and DDPG, whose network ends in a hyperbolic tangent."""

    def forward(self, observations: PyTorchObs, noise: th.Tensor | None) -> th.Tensor:
        return self.box.scale(self.policy(observations))


def _output(policy: Any, observations: PyTorchObs) -> th.Tensor:
    """Means or logits, [B, k]."""
    # the actor's alone: where the critic has an extractor of its own, SB3's method returns both
    features = super(ActorCriticPolicy, policy).extract_features(
        observations, policy.pi_features_extractor
    )
    return policy.action_net(policy.mlp_extractor.forward_actor(features))


def actor_of(model: BaseAlgorithm, sampled: bool) -> Actor:
    """How a model acts, without its safety filter.

    :param model: the model
    :param sampled: whether it samples its actions
    :raises ValueError: the model is of a kind that can't be exported
    """
    policy, space, name = model.policy, model.action_space, type(model).__name__
    can = "can't be exported"
    if not isinstance(space, spaces.Box | spaces.Discrete):
        raise ValueError(f"{name} {can}: its actions are {space}; Box and Discrete can be")
    if getattr(model, "use_sde", False):
        raise ValueError(f"{name} {can}: its noise is gSDE's; train it with use_sde=False")
    if hasattr(policy, "lstm_actor"):
        raise ValueError(f"{name} {can}: its policy is recurrent; use frame_stack instead")
    actor: Any = getattr(policy, "actor", None)
    if isinstance(policy, ActorCriticPolicy) and isinstance(space, spaces.Box):
        return Gaussian(policy, space, sampled)
    if isinstance(actor, SACActor | TQCActor):
        return Squashed(actor, space, sampled)
    if sampled and (isinstance(space, spaces.Discrete) or isinstance(actor, TD3Actor)):
        raise ValueError(f"{name} {can} with sampled actions: leave out sampled (--deterministic)")
    if isinstance(policy, ActorCriticPolicy):
        return Categorical(policy, space, sampled)
    if isinstance(actor, TD3Actor):
        return Deterministic(actor, space, sampled)
    raise ValueError(
        f"{name} {can}: its policy is a {type(policy).__name__}; those of PPO, TRPO, A2C, SAC, "
        "TQC, TD3, DDPG and of all algorithms of sb3_guard can be"
    )


class Acting(nn.Module):
    """An actor with or without the safety filter that its policy carries.

    :param model: the model
    :param sampled: whether it samples its actions
    :raises ValueError: the model is of a kind that can't be exported
    """

    def __init__(self, model: BaseAlgorithm, sampled: bool) -> None:
        super().__init__()
        self.actor = actor_of(model, sampled)
        policy = model.policy
        corrects = isinstance(policy, FilteredPolicy) and policy.corrects
        #: the policy's filter, if it is switched on
        self.layer: Any = policy.action_filter if corrects else None
        if isinstance(self.layer, SafetyLayer) and len(self.layer.threshold) > 1:
            raise ValueError(
                f"TRPO-SL with {len(self.layer.threshold)} costs can't be exported: train it with "
                "one cost, or use trpo_usl"
            )
        #: whether what the last step cost is an input
        self.acts_on_cost = corrects and policy.acts_on_cost

    def forward(
        self, observations: PyTorchObs, noise: th.Tensor | None, last_cost: th.Tensor | None
    ) -> th.Tensor:
        """Actions of the environment; see :class:`Actor`.

        :param last_cost: what the last step cost, [B, 1], NaN where that is not known; None if the
            policy does not act on it
        """
        actions = self.actor(observations, noise)
        if self.layer is None:
            return actions
        return self.actor.policy.filtered(observations, actions, last_cost)

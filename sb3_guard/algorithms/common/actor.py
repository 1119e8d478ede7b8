"""The actor as a natural gradient sees it: parameters, score, Fisher products, KL, trust region.

Any ``ActorCriticPolicy`` works, through autograd; ``fast/actor.py`` has the same for tanh networks.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution, kl_divergence
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor

from sb3_guard.algorithms.common.batches import chunks, n_rows, rows
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.vectors import conjugate_gradient, flatten, unflatten


def kl(old: Distribution, new: Distribution) -> th.Tensor:
    """KL(old ‖ new) per state, summed over the action dimensions, shape (B,)."""
    divergence = kl_divergence(old, new)
    return divergence.sum(dim=1) if divergence.ndim > 1 else divergence


def _reached(output: th.Tensor, policy: ActorCriticPolicy) -> list[th.Tensor]:
    parameters = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    gradients = th.autograd.grad(output.sum(), parameters, allow_unused=True)
    return [p for p, gradient in zip(parameters, gradients, strict=True) if gradient is not None]


def actor_parameters(policy: ActorCriticPolicy) -> list[th.Tensor]:
    """The parameters that the action distribution depends on, found by differentiating it."""
    policy.set_training_mode(False)  # batch normalisation refuses one observation
    observation = _zero_observation(policy)
    distribution = policy.get_distribution(observation)
    return _reached(distribution.log_prob(distribution.get_actions(deterministic=True)), policy)


def value_parameters(policy: ActorCriticPolicy) -> list[th.Tensor]:
    """The parameters of the value function that the actor does not share.

    A shared extractor belongs to the actor: moving it to please the critic would leave the trust
    region.
    """
    actor = {id(parameter) for parameter in actor_parameters(policy)}
    values = policy.predict_values(_zero_observation(policy))
    return [parameter for parameter in _reached(values, policy) if id(parameter) not in actor]


def _zero_observation(policy: ActorCriticPolicy) -> PyTorchObs:
    empty = gym.vector.utils.create_empty_array(policy.observation_space, n=1)
    return obs_as_tensor(empty, policy.device)  # type: ignore[arg-type]


def combined(
    distributions: Sequence[Distribution], function: Callable[[list[th.Tensor]], th.Tensor]
) -> Distribution:
    """The distribution whose parameters a function makes of those of others, of one kind.

    :param function: maps tensors of shapes [B_i, …], one per distribution, to one of [B, …]
    """

    def of(parts: Sequence[th.distributions.Distribution]) -> th.distributions.Distribution:
        kind: Any = type(parts[0])
        names = kind.arg_constraints.keys()
        arguments = {
            name: function([getattr(part, name) for part in parts])
            for name in (["logits"] if "logits" in names else names)
        }
        return kind(**arguments, validate_args=False)

    inner: list[Any] = [each.distribution for each in distributions]
    result = copy.copy(distributions[0])
    several = isinstance(inner[0], list)
    result.distribution = (
        [of(parts) for parts in zip(*inner, strict=True)] if several else of(inner)
    )
    return result


class Before:
    """A policy as it was, on the rows of a rollout: distances from it are measured as it learns.

    :param policy: any actor-critic policy
    :param observations: batch of N observations
    :param actions: sampled actions, as the policy's distribution takes them
    """

    @th.no_grad()
    def __init__(
        self, policy: ActorCriticPolicy, observations: PyTorchObs, actions: th.Tensor
    ) -> None:
        policy.set_training_mode(False)
        slices = chunks(n_rows(observations))
        # The policy hands out one distribution object again and again.
        parts = [copy.copy(policy.get_distribution(rows(observations, each))) for each in slices]
        self.distribution = combined(parts, th.cat)
        self.log_prob = self.distribution.log_prob(actions)  # [N]

    def at(self, places: th.Tensor) -> Distribution:
        """Its distributions at some of the rows."""
        return combined([self.distribution], lambda tensors: tensors[0][places])


class Actor:
    """A policy on one batch: the old policy is what it was when this view was made.

    :param policy: any actor-critic policy
    :param observations: batch of N observations
    :param actions: sampled actions, as the policy's distribution takes them
    """

    def __init__(
        self, policy: ActorCriticPolicy, observations: PyTorchObs, actions: th.Tensor
    ) -> None:
        self.policy = policy
        self.observations = observations
        self.actions = actions
        self.slices = chunks(n_rows(observations))
        self.parameters = self._parameters()
        with th.no_grad():
            # The policy hands out one distribution object again and again.
            self.old = [copy.copy(self._distribution(index)) for index in self.slices]
            self.old_log_prob = self._log_prob(self.old)

    def _parameters(self) -> list[th.Tensor]:
        return actor_parameters(self.policy)

    def _distribution(self, index: slice) -> Distribution:
        return self.policy.get_distribution(rows(self.observations, index))

    def _log_prob(self, distributions: Sequence[Distribution]) -> th.Tensor:
        pairs = zip(distributions, self.slices, strict=True)
        return th.cat([each.log_prob(self.actions[index]) for each, index in pairs])

    @th.no_grad()
    def evaluate(self) -> tuple[th.Tensor, float]:
        """Likelihood ratios to the old policy, shape (N,), and the mean KL(old ‖ new)."""
        log_prob, divergence = [], 0.0
        for old, index in zip(self.old, self.slices, strict=True):
            new = self._distribution(index)
            log_prob.append(new.log_prob(self.actions[index]))
            # Summed on the CPU: not every device has float64.
            divergence += float(kl(old, new).cpu().sum(dtype=th.float64))
        ratio = th.exp(th.cat(log_prob) - self.old_log_prob)
        return ratio, divergence / len(ratio)

    def score(self, weights: th.Tensor) -> th.Tensor:
        """``Σ_n weights_n ∇ log π(a_n | s_n)`` at the current parameters.

        Every surrogate's gradient at the old policy has this form, because a ratio's is the score.

        :param weights: shape (N,)
        :return: gradient, shape (P,)
        """
        total = [th.zeros_like(parameter) for parameter in self.parameters]
        for index in self.slices:
            log_prob = self._distribution(index).log_prob(self.actions[index])
            gradients = th.autograd.grad(log_prob @ weights[index], self.parameters)
            for each, gradient in zip(total, gradients, strict=True):
                each.add_(gradient)
        return flatten(total)

    def fisher(self, vector: th.Tensor) -> th.Tensor:
        """Product with the Fisher matrix of the old policy, by differentiating the KL twice.

        :param vector: shape (P,)
        :return: shape (P,); no damping is added
        """
        pieces = unflatten(vector, self.parameters)
        total = [th.zeros_like(parameter) for parameter in self.parameters]
        for old, index in zip(self.old, self.slices, strict=True):
            divergence = kl(old, self._distribution(index)).sum()
            slopes = th.autograd.grad(divergence, self.parameters, create_graph=True)
            along = sum((slope * piece).sum() for slope, piece in zip(slopes, pieces, strict=True))
            assert isinstance(along, th.Tensor)
            for each, product in zip(total, th.autograd.grad(along, self.parameters), strict=True):
                each.add_(product)
        return flatten(total) / len(self.old_log_prob)


class Trial(NamedTuple):
    """A candidate of the line search, compared with the old policy.

    :param kl: mean KL(old ‖ candidate)
    :param improvement: change of the surrogate
    :param cost_change: changes of mean(ratio · cost advantage), shape (m,)
    """

    kl: float
    improvement: float
    cost_change: np.ndarray


Accept = Callable[[Trial], bool]


@dataclass(eq=False)
class Region:
    """The update's local picture: a linear surrogate inside a quadratic trust region.

    :param actor: the policy on the batch
    :param batch: the batch
    :param gradient: of the surrogate at the old policy, shape (P,)
    :param delta: bound on the mean KL
    :param damping: added to the Fisher matrix's diagonal
    :param cg_max_steps: conjugate-gradient iterations per solve
    """

    actor: Actor
    batch: CostRolloutBufferSamples
    gradient: th.Tensor
    delta: float
    damping: float
    cg_max_steps: int

    @cached_property
    def cost_gradients(self) -> th.Tensor:
        """Gradients of mean(ratio · cost advantage) at the old policy, shape (m, P)."""
        weights = self.batch.cost_advantages / len(self.batch.cost_advantages)
        return th.stack([self.actor.score(column) for column in weights.unbind(dim=1)])

    def cost_changes(self, ratio: th.Tensor) -> np.ndarray:
        """By how much mean(ratio · cost advantage) differs from the old policy's, shape (m,).

        :param ratio: likelihood ratios of the actor's present policy, shape (N,)
        """
        change = ((ratio - 1.0) @ self.batch.cost_advantages) / len(ratio)
        return change.cpu().numpy().astype(np.float64)

    def product(self, vector: th.Tensor) -> th.Tensor:
        """F · vector, damped, shape (P,)."""
        return self.actor.fisher(vector).add_(vector, alpha=self.damping)

    def solve(self, vector: th.Tensor) -> th.Tensor:
        """F⁻¹ · vector by conjugate gradients, shape (P,)."""
        return conjugate_gradient(self.product, vector, self.cg_max_steps)

    def natural_step(self) -> th.Tensor:
        """The unconstrained step: along F⁻¹ gradient, as far as the region goes, shape (P,)."""
        direction = self.solve(self.gradient)
        length = float(self.gradient @ direction)
        if not length > 0.0:
            return th.zeros_like(direction)
        return direction * float(np.sqrt(2 * self.delta / length))

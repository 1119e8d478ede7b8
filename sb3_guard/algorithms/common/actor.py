"""The actor as a natural gradient sees it: parameters, score, Fisher products, KL.

Any ``ActorCriticPolicy`` works through autograd. Where the policy is a plain tanh network under a
Gaussian, categorical or Bernoulli head, the same quantities come from the network's written-out
passes: the Fisher matrix of such a policy is ``E[Jᵀ M J]``, with J the Jacobian of the head's
inputs and M the Fisher matrix of the head, so a product takes one tangent and one adjoint pass.
"""

import copy
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    MultiCategoricalDistribution,
    kl_divergence,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import (
    CombinedExtractor,
    FlattenExtractor,
    MlpExtractor,
)
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor
from torch import nn

from sb3_guard.algorithms.common.mlp import TanhMlp, chunks
from sb3_guard.algorithms.common.natural_gradient import flatten, unflatten
from sb3_guard.algorithms.common.threads import accumulate


def rows(batch: Any, index: slice | th.Tensor) -> Any:
    """Some rows of a batch of tensors, or of dictionaries and tuples of them."""
    if isinstance(batch, dict):
        return {key: rows(value, index) for key, value in batch.items()}
    if isinstance(batch, tuple):
        return tuple(rows(value, index) for value in batch)
    return batch[index]


def n_rows(observations: PyTorchObs) -> int:
    """Length of a batch of observations, dictionaries included."""
    if isinstance(observations, dict):
        return len(next(iter(observations.values())))
    return len(observations)


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
    policy.set_training_mode(False)  # of one observation there is nothing to normalise by
    observation = _zero_observation(policy)
    distribution = policy.get_distribution(observation)
    return _reached(distribution.log_prob(distribution.get_actions(deterministic=True)), policy)


def actor_modules(policy: ActorCriticPolicy) -> list[nn.Module]:
    """The modules that compute the action distribution, found by calling them."""
    policy.set_training_mode(False)
    called: list[nn.Module] = []
    hooks = [
        module.register_forward_hook(lambda module, *_: called.append(module))
        for module in policy.modules()
    ]
    try:
        with th.no_grad():
            policy.get_distribution(_zero_observation(policy))
    finally:
        for hook in hooks:
            hook.remove()
    return called


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

    @staticmethod
    def of(policy: ActorCriticPolicy, observations: PyTorchObs, actions: th.Tensor) -> "Actor":
        """The fastest view that is exact for this policy."""
        kind = TanhActor if tanh_actor(policy) is not None else Actor
        return kind(policy, observations, actions)

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


def parameterless(extractor: nn.Module) -> bool:
    """Whether an extractor only rearranges its input, so that its features are constants."""
    return type(extractor) in (FlattenExtractor, CombinedExtractor) and not any(
        True for _ in extractor.parameters()
    )


def tanh_actor(policy: ActorCriticPolicy) -> list[nn.Linear] | None:
    """The layers of a policy whose actor is exactly a tanh network, else None."""
    standard = all(
        getattr(type(policy), name) is getattr(ActorCriticPolicy, name)
        for name in ("get_distribution", "extract_features", "_get_action_dist_from_latent")
    )
    heads = (
        DiagGaussianDistribution,
        CategoricalDistribution,
        MultiCategoricalDistribution,
        BernoulliDistribution,
    )
    if not (
        standard
        and type(policy.action_dist) in heads
        and parameterless(policy.pi_features_extractor)
        and type(policy.mlp_extractor) is MlpExtractor
    ):
        return None
    if isinstance(policy.action_dist, DiagGaussianDistribution) and not (
        policy.log_std.requires_grad and policy.log_std.dtype is th.float32
    ):
        return None
    return TanhMlp.layers([*policy.mlp_extractor.policy_net, policy.action_net])


class TanhActor(Actor):
    """:class:`Actor` of a tanh network: the same numbers from cached activations."""

    def _parameters(self) -> list[th.Tensor]:
        layers = tanh_actor(self.policy)
        assert layers is not None
        self.network = TanhMlp(layers)
        with th.no_grad():
            policy = self.policy
            features = [
                super(ActorCriticPolicy, policy).extract_features(
                    rows(self.observations, index), policy.pi_features_extractor
                )
                for index in self.slices
            ]
        self.activations = [self.network.forward(each) for each in features]
        gaussian = isinstance(policy.action_dist, DiagGaussianDistribution)
        return self.network.parameters + ([policy.log_std] if gaussian else [])

    def _head(self, inputs: th.Tensor) -> tuple[Distribution, list[th.Tensor]]:
        """The distribution on the head's inputs, and the tensors it depends on."""
        distribution = copy.copy(self.policy.action_dist)
        inputs = inputs.detach().requires_grad_()
        if isinstance(distribution, DiagGaussianDistribution):
            log_std = self.policy.log_std
            return distribution.proba_distribution(inputs, log_std), [inputs, log_std]
        return distribution.proba_distribution(inputs), [inputs]

    def _curvature(self, index: int, change: th.Tensor) -> th.Tensor:
        """Product of the head's Fisher matrix with a change of its inputs, shape [n, k]."""
        old = self.old[index]
        if isinstance(old, DiagGaussianDistribution):
            return change / old.distribution.variance
        if isinstance(old, BernoulliDistribution):
            return change * old.distribution.variance
        if isinstance(old, CategoricalDistribution):
            parts = [old.distribution]
        else:
            assert isinstance(old, MultiCategoricalDistribution)
            parts = old.distribution
        sizes = [part.probs.shape[1] for part in parts]
        products = []
        for part, piece in zip(parts, change.split(sizes, dim=1), strict=True):
            mean = (part.probs * piece).sum(dim=1, keepdim=True)
            products.append(part.probs * (piece - mean))
        return th.cat(products, dim=1)

    def score(self, weights: th.Tensor) -> th.Tensor:
        n = len(self.network.parameters)

        def add(number: int, total: list[th.Tensor]) -> float:
            activations, index = self.activations[number], self.slices[number]
            distribution, inputs = self._head(activations[-1])
            log_prob = distribution.log_prob(self.actions[index])
            slopes = th.autograd.grad(log_prob @ weights[index], inputs)
            self.network.adjoint(activations, slopes[0], total[:n])
            for each, slope in zip(total[n:], slopes[1:], strict=True):
                each.add_(slope)
            return 0.0

        return flatten(accumulate(add, len(self.slices), self.parameters)[0])

    @th.no_grad()
    def fisher(self, vector: th.Tensor) -> th.Tensor:
        pieces = unflatten(vector, self.parameters)
        n = len(self.network.parameters)

        def add(number: int, total: list[th.Tensor]) -> float:
            activations = self.activations[number]
            change = self.network.tangent(activations, pieces[:n])
            self.network.adjoint(activations, self._curvature(number, change), total)
            return 0.0

        total, _ = accumulate(add, len(self.slices), self.network.parameters)
        size = len(self.old_log_prob)
        # A Gaussian's log standard deviations have Fisher matrix 2 I, apart from the mean.
        return flatten([*(each / size for each in total), *(2.0 * p for p in pieces[n:])])

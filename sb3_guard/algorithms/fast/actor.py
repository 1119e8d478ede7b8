"""The natural gradient of a tanh network from cached activations.

The Fisher matrix of a policy that is a plain tanh network under a Gaussian, categorical or
Bernoulli head is ``E[Jᵀ M J]``, with J the Jacobian of the head's inputs and M the Fisher matrix of
the head, so a product takes one tangent and one adjoint pass.
"""

import copy

import torch as th
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import (
    CombinedExtractor,
    FlattenExtractor,
    MlpExtractor,
)
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_guard.algorithms.common.actor import Actor
from sb3_guard.algorithms.common.batches import rows
from sb3_guard.algorithms.common.vectors import flatten, unflatten
from sb3_guard.algorithms.fast.mlp import TanhMlp
from sb3_guard.algorithms.fast.threads import accumulate


def parameterless(extractor: nn.Module) -> bool:
    """Whether an extractor only rearranges its input, so that its features are constants."""
    return type(extractor) in (FlattenExtractor, CombinedExtractor) and not any(
        True for _ in extractor.parameters()
    )


def tanh_actor(policy: ActorCriticPolicy) -> TanhMlp | None:
    """The network of a policy whose actor is exactly a tanh network, else None."""
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
    return TanhMlp.of([*policy.mlp_extractor.policy_net, policy.action_net])


class TanhActor(Actor):
    """:class:`Actor` of a tanh network: the same numbers from cached activations."""

    def _parameters(self) -> list[th.Tensor]:
        policy, network = self.policy, tanh_actor(self.policy)
        assert network is not None
        self.network = network
        with th.no_grad():
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

        def add(number: int, total: list[th.Tensor]) -> None:
            activations, index = self.activations[number], self.slices[number]
            distribution, inputs = self._head(activations[-1])
            log_prob = distribution.log_prob(self.actions[index])
            slopes = th.autograd.grad(log_prob @ weights[index], inputs)
            self.network.adjoint(activations, slopes[0], total[:n])
            for each, slope in zip(total[n:], slopes[1:], strict=True):
                each.add_(slope)

        return flatten(accumulate(add, len(self.slices), self.parameters))

    @th.no_grad()
    def fisher(self, vector: th.Tensor) -> th.Tensor:
        pieces = unflatten(vector, self.parameters)
        n = len(self.network.parameters)

        def add(number: int, total: list[th.Tensor]) -> None:
            activations = self.activations[number]
            change = self.network.tangent(activations, pieces[:n])
            self.network.adjoint(activations, self._curvature(number, change), total)

        total = accumulate(add, len(self.slices), self.network.parameters)
        size = len(self.old_log_prob)
        # A Gaussian's log standard deviations have Fisher matrix 2 I, apart from the mean.
        return flatten([*(each / size for each in total), *(2.0 * p for p in pieces[n:])])


def actor_of(policy: ActorCriticPolicy, observations: PyTorchObs, actions: th.Tensor) -> Actor:
    """The fastest view that is exact for this policy."""
    kind = TanhActor if tanh_actor(policy) is not None else Actor
    return kind(policy, observations, actions)

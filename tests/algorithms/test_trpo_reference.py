"""TRPO beside sb3-contrib's, which is another program: the same rollout, the same direction."""

import copy
from typing import Any

import numpy as np
import pytest
import sb3_contrib
import torch as th
from cost_envs import SB3_POLICY, CostPoint, collect
from sb3_contrib.common.utils import conjugate_gradient_solver
from stable_baselines3.common.distributions import kl_divergence
from stable_baselines3.common.env_util import make_vec_env
from torch import nn

from sb3_guard.algorithms import TRPO


def _reference(cls: type, **kwargs: Any) -> Any:
    """A model with its first rollout collected; the global generators are its own until then."""
    env = make_vec_env(lambda: CostPoint(episode_length=30), 4, seed=3)
    model = cls(
        "MlpPolicy",
        env,
        n_steps=64,
        gamma=0.98,
        gae_lambda=0.9,
        seed=3,
        device="cpu",
        policy_kwargs=SB3_POLICY,
        **kwargs,
    )
    collect(model, 256)
    return model


def test_collection_is_bit_exact_with_sb3_contrib() -> None:
    ours, theirs = _reference(TRPO), _reference(sb3_contrib.TRPO, batch_size=64)
    for name in ("observations", "actions", "rewards", "values", "log_probs", "advantages"):
        a, b = getattr(ours.rollout_buffer, name), getattr(theirs.rollout_buffer, name)
        np.testing.assert_array_equal(a, b, err_msg=name)


def test_update_direction_is_that_of_sb3_contrib() -> None:
    """Its KL averages over two action dimensions: half the Fisher matrix and half the damping."""
    ours = _reference(TRPO, cg_max_steps=60, cg_damping=0.1)
    theirs = _reference(sb3_contrib.TRPO, cg_max_steps=60, cg_damping=0.05, batch_size=64)
    region = []
    ours.plan = lambda r: region.append(r) or (th.zeros_like(r.gradient), bool)  # type: ignore
    ours.train()
    x = region[0].solve(region[0].gradient)

    batch = next(theirs.rollout_buffer.get(batch_size=None))
    advantages = (batch.advantages - batch.advantages.mean()) / (batch.advantages.std() + 1e-8)
    with th.no_grad():
        old = copy.copy(theirs.policy.get_distribution(batch.observations))
    distribution = theirs.policy.get_distribution(batch.observations)
    ratio = th.exp(distribution.log_prob(batch.actions) - batch.old_log_prob)
    divergence = kl_divergence(distribution, old).mean()
    parameters, gradient, slope, _ = theirs._compute_actor_grad(
        divergence, (advantages * ratio).mean()
    )

    def product(vector: th.Tensor, retain_graph: bool = True) -> th.Tensor:
        return theirs.hessian_vector_product(parameters, slope, vector, retain_graph)

    expected = conjugate_gradient_solver(product, gradient, max_iter=60) / 2
    actor = region[0].actor
    pieces = dict(zip(_names(ours, actor.parameters), _split(x, actor.parameters), strict=True))
    found = th.cat([pieces[name] for name in _names(theirs, parameters)])
    assert nn.functional.cosine_similarity(found, expected, dim=0) > 1 - 1e-4
    assert found.norm() / expected.norm() == pytest.approx(1.0, rel=1e-2)


def _names(model: Any, parameters: list[th.Tensor]) -> list[str]:
    names = {id(parameter): name for name, parameter in model.policy.named_parameters()}
    return [names[id(parameter)] for parameter in parameters]


def _split(vector: th.Tensor, parameters: list[th.Tensor]) -> tuple[th.Tensor, ...]:
    return vector.split([parameter.numel() for parameter in parameters])

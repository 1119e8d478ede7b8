"""Small models on small environments, shared by the tests of algorithms."""

import random
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch as th
from cost_envs import CostPoint
from stable_baselines3.common.env_util import make_vec_env

KEYS = ("cost", "cost_1")


def points(n_envs: int = 2, **kwargs: Any) -> Any:
    """Episodes of 30 steps that start inside a hazard: there is always a cost to learn from."""
    options = {"episode_length": 30, "hazard": (-1.0, 0.0), **kwargs}
    return make_vec_env(lambda: CostPoint(**options), n_envs, seed=0)


def make(cls: Any, n_costs: int = 1, **kwargs: Any) -> Any:
    """A trust-region algorithm with short rollouts and quick critics in four of them."""
    keys = KEYS[:n_costs]
    env = make_vec_env(lambda: CostPoint(cost_keys=keys, hazard=(-1.0, 0.0)), 4, seed=0)
    quick = {"n_steps": 100, "n_critic_updates": 5, "seed": 0, "device": "cpu", "cost_keys": keys}
    return cls("MlpPolicy", env, **{**quick, **kwargs})


def batch_of(advantages: Any, cost_advantages: Any, observations: Any = None) -> Any:
    """Rows of a rollout with what losses and advantages are computed from."""
    return SimpleNamespace(
        observations=observations,
        advantages=th.as_tensor(advantages),
        cost_advantages=th.as_tensor(cost_advantages),
        places=None,
    )


def state_of(model: Any) -> list[Any]:
    """Weights, optimizer and generators as plain values."""
    optimizer = model.policy.optimizer.state_dict()["state"]
    moments = [value for entry in optimizer.values() for value in entry.values()]
    tensors = [*model.policy.state_dict().values(), *moments, th.get_rng_state()]
    return [*(tensor.tolist() for tensor in tensors), random.getstate(), np.random.get_state()[2]]  # noqa: NPY002

"""Both algorithms against a linear program's answer on a small finite-horizon CMDP."""

from typing import Any

import numpy as np
import pytest
import torch as th
from cost_envs import TabularCMDP
from stable_baselines3.common.env_util import make_vec_env

from sb3_guard.algorithms import CPO, TRPO, TrustRegion

WORLD = 0


def solve(cls: type[TrustRegion], n_costs: int, seed: int, **kwargs: Any) -> tuple[float, Any]:
    """Train, and return the exact return and costs of the policy: no sampling error remains."""
    world = TabularCMDP(seed=WORLD, n_costs=n_costs)
    env = make_vec_env(lambda: TabularCMDP(seed=WORLD, n_costs=n_costs), 20, seed=seed)
    model = cls(
        "MlpPolicy",
        env,
        n_steps=50,
        gamma=1.0,
        gae_lambda=0.95,
        target_kl=0.05,
        learning_rate=1e-2,
        n_critic_updates=20,
        cost_keys=world.cost_keys,
        seed=seed,
        policy_kwargs={"net_arch": [32]},
        **kwargs,
    ).learn(40_000)
    with th.no_grad():
        states = th.arange(world.observation_space.n)
        policy = model.policy.get_distribution(states).distribution.probs
    return world.evaluate(policy.double().numpy())


@pytest.mark.parametrize("seed", [0, 1])
def test_trpo_reaches_the_unconstrained_optimum(seed: int) -> None:
    best, costs = TabularCMDP(seed=WORLD).optimum()
    value, cost = solve(TRPO, 1, seed)
    assert value >= 0.98 * best
    # The limit of the next test would be broken by a third.
    assert cost[0] >= 0.95 * costs[0]


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("n_costs", "shares"), [(1, [0.75]), (2, [0.8, 0.85])])
def test_cpo_reaches_the_constrained_optimum(seed: int, n_costs: int, shares: list[float]) -> None:
    """Limits are shares of the unconstrained optimum's costs; each of them binds."""
    world = TabularCMDP(seed=WORLD, n_costs=n_costs)
    unconstrained, costs = world.optimum()
    limits = costs * shares
    best, _ = world.optimum(limits)
    assert best < 0.95 * unconstrained
    value, cost = solve(CPO, n_costs, seed, cost_limit=list(limits))
    assert value >= 0.95 * best
    assert np.all(cost <= 1.05 * limits)


def test_the_world_agrees_with_its_linear_program() -> None:
    """The exact evaluation, the simulation and the program describe one process."""
    world = TabularCMDP(seed=WORLD, n_costs=2)
    rng = np.random.default_rng(0)
    uniform = np.full((world.observation_space.n, 3), 1 / 3)
    expected, expected_costs = world.evaluate(uniform)
    world.reset(seed=0)
    totals = []
    for _ in range(3000):
        world.reset()
        total, done = np.zeros(3), False
        while not done:
            _, reward, done, _, info = world.step(rng.integers(3))
            total += [reward, *(info[key] for key in world.cost_keys)]
        totals.append(total)
    error = 4 * np.std(totals, axis=0) / np.sqrt(len(totals))
    assert np.all(np.abs(np.mean(totals, axis=0) - [expected, *expected_costs]) < error)
    assert expected < world.optimum()[0]

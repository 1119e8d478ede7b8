"""SCPO: increments of the highest cost, what its critic learns from, limits on the worst step."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th
from cost_envs import CostPoint
from known_optima import Outcomes, problems, solve
from stable_baselines3.common.env_util import make_vec_env

from sb3_guard import CPO, SCPO, CostEvalCallback, evaluate_policy
from sb3_guard.common.vec_budgets import VecMaxCost
from sb3_guard.errors import NumberError

KEYS = ("cost", "cost_1")


def make(**kwargs: Any) -> Any:
    env = make_vec_env(lambda: CostPoint(30, cost_keys=KEYS, hazard=(-0.6, 0.0)), 3, seed=0)
    settings = {"n_steps": 40, "n_critic_updates": 2, "seed": 0, "device": "cpu", **kwargs}
    return SCPO("MlpPolicy", VecMaxCost(env, KEYS), cost_keys=KEYS, **settings)


def test_it_sums_what_the_wrapper_calls_the_increases() -> None:
    """The buffer's costs are those of VecMaxCost, in the middle of episodes and at their ends."""
    model = make(cost_limit=[0.1, 0.3])
    told: list[list[list[float]]] = []
    peaks: list[list[float]] = []
    highest = np.zeros((3, 2))

    def record(local: dict[str, Any], _: dict[str, Any]) -> bool:
        told.append([[info[f"{key}_increase"] for key in KEYS] for info in local["infos"]])
        costs = np.array([[info[key] for key in KEYS] for info in local["infos"]])
        highest[:] = np.maximum(highest, costs)
        for row in np.flatnonzero(local["dones"]):
            peaks.append(highest[row].tolist())
            highest[row] = 0.0
        return True

    train = model.train

    def spy() -> None:
        expected = np.array(told)
        np.testing.assert_allclose(model.rollout_buffer.costs, expected, rtol=1e-5)
        assert (expected > 0).any() and (expected == 0).any()
        np.testing.assert_allclose(model.costs.episode_cost, np.mean(peaks, axis=0), rtol=1e-9)
        violation = (model.costs.episode_cost - [0.1, 0.3]) / 30
        np.testing.assert_allclose(model.costs.violation, violation)
        told.clear()
        peaks.clear()
        train()

    model.train = spy
    model.learn(3 * 40 * 3, callback=record)
    assert model.costs.latest[0][0] > model.costs.episode_cost[0], "sums, as under the others"
    with pytest.raises(TypeError, match="SCPO takes no argument 'cost_gamma'"):
        make(cost_gamma=0.99)


@pytest.mark.parametrize(("positive", "kept"), [(2, 4), (0, 10), (7, 10)])
def test_the_critic_learns_from_as_many_zeros_as_others(positive: int, kept: int) -> None:
    targets = th.zeros(10, 2)
    targets[3 : 3 + positive, 1] = 1.0
    index = make().critic_rows(targets)
    rows = th.arange(10)[index]
    assert len(rows.unique()) == len(rows) == kept
    assert set(range(3, 3 + positive)) <= set(rows.tolist())


def test_evaluations_hold_the_worst_step_against_the_limit() -> None:
    model = make(cost_limit=[0.2, 0.4])
    evaluation = evaluate_policy(model, model.env, 4, seed=0)
    assert evaluation.max_costs.shape == (4, 2) and "worst step" in str(evaluation)
    np.testing.assert_allclose(evaluation.max_costs[:, 1], 2 * evaluation.max_costs[:, 0])
    assert (0 < evaluation.max_costs).all()
    assert (evaluation.max_costs < evaluation.key_costs).all()
    callback = CostEvalCallback(make().env)
    callback.model = model
    calm = replace(evaluation, max_costs=evaluation.max_costs * 0.0)
    deep = replace(evaluation, max_costs=evaluation.max_costs * 0.0 + 0.5)
    assert callback.score(calm)[0] and not callback.score(deep)[0]


@pytest.mark.slow
def test_the_worst_step_keeps_its_limit_where_a_limited_sum_does_not() -> None:
    """Stopping 0.5 beyond the wall costs 10 in all, which CPO spends on going farther."""
    problem = replace(problems()["wall"], updates=20)
    fast: dict[str, Any] = {"learning_rate": 3e-3, "n_critic_updates": 10, "target_kl": 0.05}
    outcome = solve(SCPO, problem, 0, **fast)
    assert outcome.good, outcome
    problem = replace(problem, updates=40)  # its margin needs as many
    seen = Outcomes(problem.total_timesteps)
    env = problem.make_env()
    CPO("MlpPolicy", env, n_steps=problem.n_steps, cost_limit=10.0, seed=0, **fast).learn(
        problem.total_timesteps, callback=seen
    )
    assert np.mean(seen.costs) <= 1.05 * 10.0
    assert np.mean(seen.worst) >= 1.5 * problem.limits[0]


def test_negative_costs_are_refused() -> None:
    """The highest cost so far begins at 0, so that they would count as nothing."""

    class Credit(CostPoint):
        def step(self, action: np.ndarray) -> Any:
            *rest, info = super().step(action)
            return *rest, {**info, "cost": -0.5}

    model = SCPO("MlpPolicy", make_vec_env(Credit, 2), cost_limit=1.0, n_steps=20)
    with pytest.raises(
        NumberError, match=r"a cost is -0\.5: a limit on .* needs costs of at least 0"
    ):
        model.learn(40)

"""TRPO-Lagrangian and TRPO-FAC: multipliers by hand, and what they do to the objective."""

from functools import partial
from pathlib import Path
from typing import Any

import agents
import numpy as np
import pytest
import torch as th
from agents import batch_of
from cost_envs import SB3_POLICY, told
from known_optima import problems, solve
from stable_baselines3.common.logger import Logger

from sb3_guard.algorithms import TRPO, TRPOFAC, TRPOLag, TrustRegion
from sb3_guard.algorithms.common.costs import discounted_limit
from sb3_guard.algorithms.common.lagrangian import Multiplier
from sb3_guard.algorithms.trpo_fac import StateMultiplier

# Plain ascent, as published.
RAW = {"lambda_units": "cost", "proportional_gain": 0.0, "derivative_gain": 0.0}


make: Any = partial(agents.make, policy_kwargs=SB3_POLICY)


# The multiplier of TRPO-Lagrangian


def follow(costs: Any, limit: float, rate: float, init: float = 0.0, **law: Any) -> list[float]:
    multiplier, values = Multiplier(1, init), []
    for cost in costs:
        multiplier.update(np.array([cost]), np.array([limit]), rate, **law)
        values.append(float(multiplier.value[0]))
    return values


def test_ascent_by_hand() -> None:
    """0 + 0.1·(7-5), then -0.1·3 stops at zero, then 0.1·10."""
    values = follow([7.0, 2.0, 15.0, 4.0], 5.0, 0.1)
    np.testing.assert_allclose(values, [0.2, 0.0, 1.0, 0.9])


def test_initial_value_and_bound_by_hand() -> None:
    values = follow([8.0, 8.0, 8.0, 3.0], 5.0, 0.1, init=0.5, maximum=0.9)
    # Bounded, and it comes down at once: nothing has wound up beyond the bound.
    np.testing.assert_allclose(values, [0.8, 0.9, 0.9, 0.7])


def test_pid_by_hand() -> None:
    """η = 0.1, K_P = 0.5, K_D = 0.25, d = 5.

    J_C = 7: I = 0.2, P = 1, no rise before the second update: 1.2
    J_C = 9: I = 0.6, P = 2, D = 0.5: 3.1
    J_C = 4: I = 0.5, P = -0.5, a fall is no rise: 0
    J_C = 6: I = 0.6, P = 0.5, D = 0.5: 1.6
    """
    values = follow([7.0, 9.0, 4.0, 6.0], 5.0, 0.1, proportional=0.5, derivative=0.25)
    np.testing.assert_allclose(values, [1.2, 3.1, 0, 1.6], atol=1e-9)


def test_relative_violations_by_hand() -> None:
    """η = 0.5, K_P = 2, d = 4: violations 0.25, 1 (of 2.5), -1 (of -1), 0."""
    values = follow([5.0, 14.0, 0.0, 4.0], 4.0, 0.5, proportional=2.0, relative=True)
    np.testing.assert_allclose(values, [0.125 + 0.5, 0.625 + 2.0, 0.0, 0.125])


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_relative_multipliers_do_not_know_the_unit(scale: float) -> None:
    costs = [5.0, 14.0, 3.0, 4.5]
    kwargs: dict[str, Any] = {
        "rate": 0.5, "proportional": 2.0, "derivative": 1.0, "smoothing": 0.5, "relative": True
    }  # fmt: skip
    for limit in (4.0, 0.0):
        a = follow(costs, limit, **kwargs)
        b = follow([scale * cost for cost in costs], scale * limit, **kwargs)
        np.testing.assert_allclose(a, b, rtol=1e-9)
        assert a[1] > 0.0


def test_smoothing_by_hand() -> None:
    """Averages of J_C: 4, 6, 7; of the violation 0, 2, 3."""
    kwargs: dict[str, Any] = {"proportional": 0.5, "derivative": 2.0, "smoothing": 0.5}
    values = follow([4.0, 8.0, 8.0], 4.0, 0.0, **kwargs)
    np.testing.assert_allclose(values, [0.0, 1.0 + 4.0, 1.5 + 2.0])


@pytest.mark.parametrize("limit", [1.0, 1e-6])
def test_a_rise_far_above_a_small_limit_is_no_more_than_it_is(limit: float) -> None:
    """J_C of 50 ± 5, whose rises are a tenth of it and many limits."""
    costs = 50.0 + 5.0 * np.random.default_rng(0).standard_normal(12)
    gains = {"proportional": 2.0, "smoothing": 0.5, "relative": True}
    without = follow(costs, limit, 0.5, **gains)
    values = follow(costs, limit, 0.5, derivative=2.0, **gains)
    assert 0.0 < np.max(np.subtract(values, without)) < 0.4


@pytest.mark.parametrize("moment", ["before", "after"])
def test_the_multiplier_ascends_before_or_after_the_step(moment: str) -> None:
    """λ of update k is η times the violations of the updates up to it, in episode units."""
    model = make(TRPOLag, cost_limit=2.0, lambda_lr=0.1, lambda_update=moment, **RAW)
    prices, violations = [], []
    plan, fit = model.plan, model.fit
    model.plan = lambda region: prices.append(float(model.prices[0])) or plan(region)
    model.fit = lambda batch: violations.append(model.costs.episode_cost[0] - 2.0) or fit(batch)
    model.learn(2000)
    expected = [0.0]
    for violation in violations:
        expected.append(max(0.0, expected[-1] + 0.1 * violation))
    used = expected[1:] if moment == "before" else expected[:-1]
    np.testing.assert_allclose(prices, used, rtol=1e-6)
    assert len(prices) == 5 and prices[-1] > 0.0
    assert model.logger.name_to_value["train/multiplier"] == pytest.approx(expected[-1])


def test_the_lagrangian_by_hand() -> None:
    model = make(TRPOLag, n_costs=2, **RAW)
    model.prices = np.array([0.5, 2.0])
    batch = batch_of([1.0, -1.0, 2.0], [[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]])
    assert model.advantages(batch).tolist() == [0.5, -3.0, 4.5]  # A - λ·A_C


def test_the_relative_lagrangian_by_hand() -> None:
    """The same with λ in standard deviations: cost advantages of 100 and -100 count as (1, -1)."""
    model = make(TRPOLag)
    model.set_logger(Logger(None, []))
    model.prices = np.array([0.5])
    batch = batch_of([1.0, -1.0], [[100.0], [-100.0]])
    assert model.advantages(batch).tolist() == pytest.approx([0.5, -0.5])  # A - λ·A_C/100


def test_without_multiplier_it_is_trpo() -> None:
    """λ stays zero under a limit that holds: the same trajectories, bit for bit."""
    models = [make(cls, cost_limit=1e6).learn(800) for cls in (TRPO, TRPOLag)]
    a, b = (model.policy.state_dict() for model in models)
    assert float(models[1].multiplier.value[0]) == 0.0
    for name in a:
        assert th.equal(a[name], b[name]), name


# The multipliers of TRPO-FAC


@pytest.mark.slow
def test_fac_settles_with_its_defaults() -> None:
    """At a return of 0.97 of the optimum; without the proportional term it circles."""
    assert solve(TRPOFAC, problems()["bandit-2"], 0).good


def network(n_costs: int = 1, **kwargs: Any) -> StateMultiplier:
    th.manual_seed(0)
    return StateMultiplier(make(TRPO).policy, n_costs, **{"rate": 1e-2, **kwargs})


@pytest.mark.parametrize("init", [1e-4, 50.0])
def test_multipliers_start_where_they_are_told(init: float) -> None:
    assert float(network(init=init).predict(th.zeros(1, 4))) == pytest.approx(init, rel=1e-4)
    assert float(network().predict(th.zeros(1, 4))) == pytest.approx(np.log(2.0), abs=0.2)


@pytest.mark.parametrize("ascent", ["output", "value"])
def test_multipliers_that_have_fallen_rise_again(ascent: Any) -> None:
    """200 steps down, 60 up: on the outputs alone, which λ's gradient hardly moves down there."""
    multiplier, observations = network(ascent=ascent), th.randn(100, 4)
    for excess in [-1.0] * 200 + [1.0] * 60:
        multiplier.ascend(observations, th.full((100, 1), excess))
    risen = float(multiplier.predict(observations).mean())
    assert risen > 1.0 if ascent == "output" else risen < 0.1


@pytest.mark.parametrize("ascent", ["output", "value"])
def test_multipliers_of_states_have_a_bound_and_come_down_from_it(ascent: Any) -> None:
    """Nothing winds up beyond the bound, to be taken back before a price falls."""
    multiplier, observations = network(ascent=ascent, maximum=2.0), th.randn(100, 4)
    for _ in range(400):
        multiplier.ascend(observations, th.ones(100, 1))
    highest = float(multiplier.predict(observations).mean())
    for _ in range(60):
        multiplier.ascend(observations, -th.ones(100, 1))
    assert highest == pytest.approx(2.0, rel=0.1)
    assert float(multiplier.predict(observations).mean()) < 1.0


@pytest.mark.parametrize(("units", "highest"), [("relative", 5.0), ("cost", 9.0)])
def test_the_price_of_a_state_has_the_bound_of_other_prices(units: str, highest: float) -> None:
    """λ = 4 and K_P = 5 at a violation of a limit or more; in units of cost there is no bound."""
    model = make(TRPOFAC, units=units, trace=False)
    model.multiplier.predict = lambda observations: th.tensor([[4.0], [0.5]])
    model._excess = lambda batch: th.tensor([[1.0], [-1.0]])
    price = model.weights(batch_of([0.0, 0.0], [[1.0], [-1.0]]))
    deviation = 2.0**0.5 if units == "relative" else 1.0
    th.testing.assert_close(price * deviation, th.tensor([[highest], [0.0]]))


def test_ascent_is_the_gradient_of_the_mean() -> None:
    """Batches longer than a slice give the gradient of the whole, by plain autograd."""
    multiplier = network(2, ascent="value")
    observations, excess = th.randn(5000, 4), th.randn(5000, 2)
    outputs = th.cat([each(observations) for each in multiplier.networks], dim=1)
    objective = (th.nn.functional.softplus(outputs) * excess).sum(dim=1).mean()
    expected = th.autograd.grad(objective, list(multiplier.parameters()))
    multiplier.ascend(observations, excess)
    for parameter, gradient in zip(multiplier.parameters(), expected, strict=True):
        th.testing.assert_close(parameter.grad, -gradient, rtol=1e-3, atol=1e-6)


def test_limits_of_discounted_costs() -> None:
    """25 per episode of 1000 steps is a cost of 0.025 a step: 2.5 at γ = 0.99, all of it at 1.

    Of 30 steps that a time limit cuts, it is what a critic says that values what comes after them.
    """
    limits = np.array([25.0, 0.0])
    found = discounted_limit(limits, 1000.0, 0.99, cut=False)
    np.testing.assert_allclose(found, [0.025 * sum(0.99**k for k in range(1000)), 0.0])
    for cut in (False, True):
        np.testing.assert_allclose(discounted_limit(limits, 1000.0, 1.0, cut), limits)
    found = discounted_limit(limits, 30.0, 0.99, cut=True)
    np.testing.assert_allclose(found, [25.0 / 30.0 * 100.0, 0.0])


@pytest.mark.parametrize("mode", ["statewise", "expected"])
def test_what_the_multipliers_ascend_on(mode: Any) -> None:
    model = make(TRPOFAC, cost_limit=2.0, mode=mode, lambda_epochs=3)
    seen: list[Any] = []
    model.multiplier.ascend = lambda observations, excess: seen.append(excess)
    returns: list[Any] = []
    fit = model.fit
    model.fit = lambda batch: returns.append((batch.cost_returns, model.costs)) or fit(batch)
    model.learn(400)
    assert len(seen) == 3
    cost_returns, costs = returns[0]
    if mode == "statewise":
        limit = 2.0 / 50 / (1 - 0.99)  # a time limit cuts the episodes
        th.testing.assert_close(seen[0], cost_returns - limit)
    else:
        expected = th.full_like(cost_returns, costs.episode_cost[0] - 2.0)
        th.testing.assert_close(seen[0], expected)


def test_the_state_wise_lagrangian_by_hand() -> None:
    model = make(TRPOFAC, n_costs=2, proportional_gain=0.0, trace=False)
    model.set_logger(Logger(None, []))
    model.multiplier.predict = lambda observations: th.tensor([[0.5, 0.0], [2.0, 1.0], [0.0, 3.0]])
    batch = batch_of([1.0, -1.0, 2.0], [[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]])
    assert model.advantages(batch).tolist() == [0.5, -2.0, 5.0]
    prices = [model.logger.name_to_value[f"train/cost_weight/{key}"] for key in model.cost_keys]
    assert prices == pytest.approx([2.5 / 3, 4.0 / 3]), "their means over the states"


def test_states_price_the_actions_after_them() -> None:
    """Two episodes of three and two steps in one of the environments, one of five in the other."""
    model = make(TRPOFAC, n_steps=5, gamma=0.5, proportional_gain=0.0, units="cost")
    buffer = model.rollout_buffer
    buffer.n_envs = 2
    buffer.episode_starts = np.array([[1, 1], [0, 0], [0, 0], [1, 0], [0, 0]], np.float32)
    price = th.tensor([8.0, 1.0, 3.0, 1.0, 0.0, 0.0, 8.0, 0.0, 0.0, 0.0])[:, None]
    expected = [8.0, 4.0, 3.0, 1.0, 0.5, 0.0, 8.0, 4.0, 2.0, 1.0]
    model.multiplier.predict = lambda observations: price
    assert model.weights(batch_of([0.0], [0.0]))[:, 0].tolist() == expected


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_the_state_wise_violation_is_relative_and_that_of_this_rollout(scale: float) -> None:
    """d_γ is 2 · (1 - γ²)/(1 - γ) = 3 for a limit of 4 in 2 steps at γ = 0.5."""
    model = make(TRPOFAC, cost_limit=4.0 * scale, gamma=0.5)
    told(model, [0.0], 2.0)
    buffer = model.rollout_buffer
    # the critic says 1, 2, 9 where the mean of the returns is 1 more than the mean of those
    buffer.cost_values = scale * np.array([[[1.0]], [[2.0]], [[9.0]]], np.float32)
    batch = batch_of([0.0] * 3, [[0.0]] * 3)
    batch.cost_returns = scale * th.tensor([[5.0], [5.0], [5.0]])
    assert model._excess(batch)[:, 0].tolist() == pytest.approx([-1 / 3, 0.0, 1.0], abs=1e-6)


@pytest.mark.parametrize("cls", [TRPOLag, TRPOFAC])
def test_the_rate_given_to_load_is_the_rate(cls: type[TrustRegion], tmp_path: Path) -> None:
    """As it is with learning_rate, and what the multipliers have learnt is loaded."""

    def learnt(model: Any) -> list[list[float]]:
        multiplier = model.multiplier
        parts = [multiplier.integral] if cls is TRPOLag else multiplier.parameters()
        return [part.tolist() for part in parts]

    model = make(cls, n_critic_updates=1, lambda_lr=0.5).learn(400)
    model.save(tmp_path / "model")
    again: Any = cls.load(tmp_path / "model", env=model.env, device="cpu", lambda_lr=0.0)
    assert learnt(again) == learnt(model) != learnt(make(cls))
    again.learn(400, reset_num_timesteps=False)
    assert learnt(again) == learnt(model)
    again.lambda_lr = 0.5
    again.learn(400, reset_num_timesteps=False)
    assert all(a != b for a, b in zip(learnt(again), learnt(model), strict=True))

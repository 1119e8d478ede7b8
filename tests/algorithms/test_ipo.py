"""TRPO-IPO: its barrier, the weight it puts on the cost, and its line search."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import agents
import numpy as np
import pytest
import torch as th
from agents import batch_of
from cost_envs import told
from stable_baselines3.common.logger import Logger

from sb3_guard.algorithms import TRPOIPO
from sb3_guard.algorithms.common.actor import Trial
from sb3_guard.algorithms.trpo_ipo import barrier

make: Any = partial(agents.make, TRPOIPO)


@pytest.mark.parametrize(("t", "slope"), [(0.01, 0.5), (100.0, 20.0)])
def test_barrier_is_the_logarithm_and_its_tangent(t: float, slope: float) -> None:
    margin = 1.0 / (t * slope)
    inside = -margin * th.tensor([1.0, 1.5, 3.0, 100.0], dtype=th.float64)
    expected = np.log(-inside.numpy()) / t
    np.testing.assert_allclose(barrier(inside, t, slope).numpy(), expected, rtol=1e-12)
    outside = margin * th.tensor([-1.0, -0.3, 0.0, 1.0, 50.0], dtype=th.float64)
    expected = np.log(margin) / t - slope * (outside.numpy() + margin)
    np.testing.assert_allclose(barrier(outside, t, slope).numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize(("t", "slope"), [(0.01, 0.5), (100.0, 20.0)])
def test_barrier_has_no_kink(t: float, slope: float) -> None:
    margin = 1.0 / (t * slope)
    x = margin * th.linspace(-3.0, 2.0, 4001, dtype=th.float64)
    x.requires_grad_()
    (derivative,) = th.autograd.grad(barrier(x, t, slope).sum(), x)
    expected = np.minimum(1 / (t * np.maximum(-x.detach().numpy(), 1e-300)), slope)
    np.testing.assert_allclose(-derivative.numpy(), expected, rtol=1e-9)


def _estimate(model: Any, cost: list[float], horizon: float) -> None:
    told(model, cost, horizon)


def _accept(model: Any) -> Any:
    return model.plan(SimpleNamespace(natural_step=lambda: th.zeros(1)))[1]


def _weight(model: Any, cost: float, scale: float = 1.0) -> float:
    """What a standard deviation of A_C weighs in the gradient of the surrogate."""
    _estimate(model, [cost], 40.0)
    costs = scale * th.randn(200, 1, generator=th.Generator().manual_seed(0))
    batch = batch_of(th.zeros(200), costs - costs.mean())
    deviation = costs.std()
    ratio = th.ones(200, requires_grad=True)
    (found,) = th.autograd.grad(model.surrogate(batch, ratio), ratio)
    shape = batch.cost_advantages[:, 0] / deviation
    weight = float(-200 * (found @ shape) / (shape @ shape))
    th.testing.assert_close(found, -weight * shape / 200)
    model.set_logger(Logger(None, []))
    model.fit(batch)
    price = model.logger.name_to_value["train/cost_weight"]
    assert price * float(deviation) == pytest.approx(weight, rel=1e-4), "per unit of the advantage"
    return weight


@pytest.mark.parametrize(
    ("cost", "weight"),
    [(0.0, 1 / 2), (4.0, 5 / 2), (4.9, 3.0), (5.0, 3.0), (80.0, 3.0)],
)
@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_weight_of_the_cost(cost: float, weight: float, scale: float) -> None:
    """min(d / (t (d - J_C)), max_multiplier), whatever the unit of the costs."""
    model = make(cost_limit=5.0 * scale, t=2.0, max_multiplier=3.0)
    assert _weight(model, cost * scale, scale) == pytest.approx(weight, rel=1e-4)
    assert model.logger.name_to_value["train/multiplier"] == pytest.approx(weight)


def test_weight_of_the_cost_in_its_own_unit() -> None:
    model = make(cost_limit=5.0, t=2.0, max_multiplier=3.0, units="cost")
    weights = [_weight(model, cost, 0.5) for cost in (0.0, 4.0, 4.9, 5.0)]
    np.testing.assert_allclose(weights, 0.5 * np.array([1 / 10, 1 / 2, 3.0, 3.0]), rtol=0.1)


def test_several_barriers_are_sharper() -> None:
    """1 / (m t) of each limit, so that m barriers together cost what one does."""
    model = make(2, cost_limit=[5.0, 9.0], t=2.0, max_multiplier=3.0)
    _estimate(model, [0.0, 8.0], 40.0)
    model.set_logger(Logger(None, []))
    model.fit(batch_of([0.0] * 3, [[1.0, 10.0], [-1.0, -10.0], [0.0, 0.0]]))
    logged = model.logger.name_to_value
    weights = [logged[f"train/multiplier/{key}"] for key in model.cost_keys]
    assert weights == pytest.approx([1 / 4, 9 / 4])
    prices = [logged[f"train/cost_weight/{key}"] for key in model.cost_keys]
    assert prices == pytest.approx([1 / 4, 9 / 40])


def test_several_barriers_add_up() -> None:
    model = make(2, cost_limit=[5.0, 9.0], t=2.0, max_multiplier=3.0, units="cost")
    _estimate(model, [4.0, 80.0], 40.0)
    batch = batch_of(th.randn(200), th.randn(200, 2))
    ratio = th.ones(200, requires_grad=True)
    (found,) = th.autograd.grad(model.surrogate(batch, ratio), ratio)
    expected = batch.advantages - 0.5 * batch.cost_advantages[:, 0]
    expected -= 3.0 * batch.cost_advantages[:, 1]
    th.testing.assert_close(found, expected / 200)


@pytest.mark.parametrize(
    ("cost", "kl", "improvement", "change", "accepted"),
    [
        (4.0, 0.01, 0.1, 0.02, True),  # 4 + 40 · 0.02 = 4.8 of 5
        (4.0, 0.01, 9.0, 0.025, False),  # on the limit
        (4.0, 0.01, -0.1, -0.1, False),
        (4.0, 0.03, 0.1, -0.1, False),
        (6.0, 0.01, 0.1, 0.1, True),  # infeasible: the objective alone decides
        (5.0, 0.01, 0.1, 0.1, True),  # on the limit is not strictly feasible
        (4.0, 0.01, 0.1, np.nan, False),
    ],
)
def test_line_search_test(
    cost: float, kl: float, improvement: float, change: float, accepted: bool
) -> None:
    model = make(cost_limit=5.0, target_kl=0.02)
    _estimate(model, [cost], 40.0)
    assert _accept(model)(Trial(kl, improvement, np.array([change]))) is accepted


@pytest.mark.parametrize(
    ("cost", "change", "accepted"),
    [
        ([4.0, 8.0], [0.02, 0.02], True),
        ([4.0, 8.0], [0.02, 0.03], False),
        # The first limit is broken: that is no reason to break the second.
        ([6.0, 8.0], [0.1, 0.02], True),
        ([6.0, 8.0], [-0.1, 0.03], False),
        ([6.0, 9.0], [0.1, 0.1], True),
    ],
)
def test_each_limit_that_is_kept_stays_so(
    cost: list[float], change: list[float], accepted: bool
) -> None:
    model = make(2, cost_limit=[5.0, 9.0], target_kl=0.02)
    _estimate(model, cost, 40.0)
    assert _accept(model)(Trial(0.01, 0.1, np.array(change))) is accepted


def test_from_inside_no_step_reaches_the_limit() -> None:
    """Over a training: whenever the estimate was feasible, the accepted step keeps it so."""
    model = make(cost_limit=12.0, t=100.0, target_kl=0.2)
    inside = []
    search = model._line_search

    def spy(region: Any, *args: Any) -> Any:
        fraction, trial = search(region, *args)
        violation = model.costs.violation
        if np.all(violation < 0.0):
            inside.append(float((violation + trial.cost_change).max()))
        return fraction, trial

    model._line_search = spy
    model.learn(6000)
    assert len(inside) > 3 and max(inside) < 0.0

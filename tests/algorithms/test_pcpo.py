"""PCPO: its projection against an independent optimiser, and its line search."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import agents
import numpy as np
import pytest
import torch as th
from cost_envs import told
from scipy.optimize import minimize
from stable_baselines3.common.logger import Logger
from step_problems import StepProblem

from sb3_guard.algorithms import PCPO
from sb3_guard.algorithms.common.actor import Trial
from sb3_guard.algorithms.common.natural_gradient import projected_step

SIZE = 6


class Problem(StepProblem):
    """A projection problem, and the distance that an independent optimiser finds."""

    @property
    def natural(self) -> np.ndarray:
        v = self.inverse @ self.g
        return np.sqrt(2 * self.delta / (self.g @ v)) * v

    def solve(self, euclidean: bool, dtype: th.dtype = th.float64) -> tuple[np.ndarray, np.ndarray]:
        g, B, v, W = self.tensors(dtype)
        x, pull = projected_step(g, B, self.c, v, W, self.delta, euclidean)
        return x.numpy(), pull

    def distance(self, x: np.ndarray, euclidean: bool) -> float:
        """From the natural step, in radii of the trust region."""
        gap = x - self.natural
        return float(np.sqrt(gap @ gap if euclidean else gap @ self.F @ gap) / self.radius)

    @property
    def radius(self) -> float:
        return float(np.sqrt(2 * self.delta))

    def reference(self, euclidean: bool) -> float:
        """The shortest distance by SLSQP, in coordinates where it is Euclidean."""
        root = np.eye(SIZE) if euclidean else np.linalg.inv(np.linalg.cholesky(self.F)).T
        root = root * self.radius
        centre, B = np.linalg.solve(root, self.natural), self.B @ root
        scale = np.linalg.norm(B, axis=1)
        answer = minimize(
            lambda y: (0.5 * np.sum((y - centre) ** 2), y - centre),
            centre,
            jac=True,
            constraints={
                "type": "ineq",
                "fun": lambda y: -(self.c + B @ y) / scale,
                "jac": lambda y: -B / scale[:, None],
            },
            method="SLSQP",
            options={"ftol": 1e-13, "maxiter": 500},
        )
        assert np.all((self.c + B @ answer.x) / scale <= 1e-6)
        return float(np.linalg.norm(answer.x - centre))


@pytest.mark.parametrize("euclidean", [False, True])
@pytest.mark.parametrize("m", [1, 2, 3])
def test_projection_against_an_optimiser(m: int, euclidean: bool) -> None:
    """Of costs in like units, and in units that lie up to twelve orders of magnitude apart."""
    rng = np.random.default_rng(10 * m + euclidean)
    projected = outside = 0
    for i in range(300):
        scales = 10 ** rng.uniform(-4, 8, size=m) if i % 2 else None
        problem = Problem(rng, rng.uniform(-1.5, 2.5, size=m), scales)
        x, pull = problem.solve(euclidean)
        assert np.all((problem.c + problem.B @ x) / problem.reach <= 1e-7) and np.all(pull >= 0.0)
        # The nearest point is unique: a feasible one as near as it is the same one.
        assert problem.distance(x, euclidean) <= problem.reference(euclidean) * (1 + 1e-5) + 1e-6
        projected += pull.any()
        outside += bool(x @ problem.F @ x > 2.001 * problem.delta)
    assert 100 < projected < 300 and outside > 50, "the projection knows no trust region"


@pytest.mark.parametrize("euclidean", [False, True])
def test_one_constraint_has_yangs_closed_form(euclidean: bool) -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        problem = Problem(rng, rng.uniform(-1.0, 2.0, size=1))
        b, y = problem.B[0], problem.natural
        image = b if euclidean else problem.inverse @ b
        expected = y - max(0.0, (b @ y + problem.c[0]) / (b @ image)) * image
        np.testing.assert_allclose(problem.solve(euclidean)[0], expected, rtol=1e-8, atol=1e-12)
        single, _ = problem.solve(euclidean, th.float32)
        np.testing.assert_allclose(single, expected, rtol=1e-2, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("euclidean", [False, True])
def test_contradictory_limits_are_violated_least(euclidean: bool) -> None:
    """Opposite half-spaces, both violated: least squares within the trust region."""
    rng = np.random.default_rng(1)
    for _ in range(100):
        problem = Problem(rng, rng.uniform(0.1, 1.0, size=2))
        problem.B[1] = -problem.B[0]
        x, _ = problem.solve(euclidean)
        assert 0.5 * x @ problem.F @ x <= problem.delta * (1 + 1e-8)
        # The compromise evens out the two violations, as far as the region allows.
        w = problem.inverse @ problem.B[0]
        s = problem.B[0] @ w
        wanted = (problem.c[1] - problem.c[0]) / 2
        reach = np.sqrt(2 * problem.delta * s)
        np.testing.assert_allclose(problem.B[0] @ x, np.clip(wanted, -reach, reach), rtol=1e-4)


@pytest.mark.parametrize("noise", [1e-7, 1e-3])
@pytest.mark.parametrize("euclidean", [False, True])
@pytest.mark.parametrize("m", [2, 3])
def test_half_spaces_that_meet_far_away_count_as_contradictory(
    m: int, euclidean: bool, noise: float
) -> None:
    """Opposite but for the noise of float32 or of an estimate: no step of a thousand radii."""
    rng = np.random.default_rng(m)
    for _ in range(50):
        problem = Problem(rng, rng.uniform(0.1, 1.0, size=m))
        problem.B[1] = -problem.B[0] + noise * rng.normal(size=SIZE)
        x, _ = problem.solve(euclidean, th.float32)
        x = x.astype(np.float64)
        assert 0.5 * x @ problem.F @ x <= problem.delta * (1 + 1e-3)
        excess = np.maximum(0.0, problem.c + problem.B @ x)
        assert excess @ excess <= problem.c @ problem.c


def test_half_spaces_that_only_seem_to_meet_count_as_contradictory() -> None:
    """Conjugate gradients that stop early leave W inexact, and opposite costs look less so."""
    rng = np.random.default_rng(2)
    for _ in range(50):
        problem = Problem(rng, rng.uniform(0.3, 1.0, size=2))
        problem.B[1] = -problem.B[0]
        tensors = (problem.g, problem.B, problem.inverse @ problem.g, problem.B @ problem.inverse)
        g, B, v, W = (th.as_tensor(each) for each in tensors)
        W[1] *= 1.02
        x = projected_step(g, B, problem.c, v, W, problem.delta)[0].numpy()
        assert 0.5 * x @ problem.F @ x <= 1.05 * problem.delta


@pytest.mark.parametrize("c", [-0.5, 0.0, 0.5])
def test_without_cost_gradient(c: float) -> None:
    """The TRPO step, also where the limit is exceeded and nothing can change that."""
    problem = Problem(np.random.default_rng(0), np.zeros(1))
    problem.B[:], problem.c[:] = 0.0, c
    x, pull = problem.solve(False)
    np.testing.assert_allclose(x, problem.natural)
    assert not pull.any()


make: Any = partial(agents.make, PCPO)


def acceptance(model: PCPO) -> Any:
    """The line search's test, whatever the step."""
    model.set_logger(Logger(None, []))
    told(model, [1.0])
    one = th.ones(1)
    region: Any = SimpleNamespace(
        gradient=one, cost_gradients=one[None], delta=model.target_kl, solve=lambda b: b
    )
    return model.plan(region)[1]


@pytest.mark.parametrize("projection", ["kl", "l2"])
@pytest.mark.parametrize("limit", [0.0, 3.0])
def test_steps_satisfy_the_linearised_limit(projection: Any, limit: float) -> None:
    model = make(projection=projection, cost_limit=limit, cg_max_steps=60)
    plan, residuals = model.plan, []

    def spy(region: Any) -> Any:
        x, accept = plan(region)
        c = model.margin.violation(model.costs)
        residuals.append(float((c + (region.cost_gradients @ x).numpy())[0]))
        return x, accept

    model.plan = spy  # type: ignore[method-assign]
    model.learn(1200)
    assert len(residuals) == 3 and max(residuals) <= 1e-4
    assert model.logger.name_to_value["train/kl"] <= model.target_kl


def test_line_search_asks_for_nothing_but_kl() -> None:
    accept = acceptance(make(target_kl=0.02))
    for kl, accepted in [(0.019, True), (0.021, False), (np.nan, False)]:
        assert accept(Trial(kl, -5.0, np.array([5.0]))) is accepted


def test_without_line_search_the_step_is_taken_whole() -> None:
    model = make(line_search=False)
    accept = acceptance(model)
    assert accept(Trial(9.0, -5.0, np.array([5.0])))
    assert not accept(Trial(np.inf, 0.0, np.zeros(1)))
    assert not accept(Trial(np.nan, 0.0, np.zeros(1)))
    fractions, kls = [], []
    record = model._line_search

    def spy(*args: Any) -> Any:
        fraction, trial = record(*args)
        fractions.append(fraction)
        kls.append(trial.kl)
        return fraction, trial

    model._line_search = spy  # type: ignore[method-assign]
    model.learn(1200)
    assert fractions == [1.0] * 3
    assert max(kls) > model.target_kl, "at a limit of 0 the projection leaves the trust region"

"""The step's linear algebra against direct solves and an independent optimiser."""

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
import torch as th
from scipy.optimize import minimize
from step_problems import StepProblem, definite

from sb3_guard.algorithms.common.natural_gradient import Case, Step, constrained_step
from sb3_guard.algorithms.common.vectors import assign, conjugate_gradient, flatten, unflatten

FEW_OR_MANY = [50, pytest.param(500, marks=pytest.mark.slow)]  # random problems


def test_flat_round_trip() -> None:
    tensors = [th.randn(2, 3), th.randn(4), th.randn(1, 1)]
    vector = flatten(tensors)
    assert vector.shape == (11,)
    for piece, tensor in zip(unflatten(vector, tensors), tensors, strict=True):
        th.testing.assert_close(piece, tensor, rtol=0, atol=0)
    parameters = [th.nn.Parameter(th.zeros_like(tensor)) for tensor in tensors]
    assign(parameters, vector)
    th.testing.assert_close(flatten(parameters).detach(), vector, rtol=0, atol=0)


@pytest.mark.parametrize("size", [1, 5, 40])
def test_conjugate_gradient_equals_direct_solve(size: int) -> None:
    rng = np.random.default_rng(size)
    F, b = th.as_tensor(definite(rng, size)), th.as_tensor(rng.normal(size=size))
    x = conjugate_gradient(lambda vector: F @ vector, b, max_steps=10 * size, tolerance=1e-24)
    th.testing.assert_close(x, th.linalg.solve(F, b), rtol=1e-8, atol=1e-8)


def test_conjugate_gradient_stopped_early_still_knows_its_length() -> None:
    rng = np.random.default_rng(0)
    F, b = th.as_tensor(definite(rng, 30)), th.as_tensor(rng.normal(size=30))
    x = conjugate_gradient(lambda vector: F @ vector, b, max_steps=4)
    assert float(x @ F @ x) == pytest.approx(float(b @ x), rel=1e-10)
    again = conjugate_gradient(lambda vector: F @ vector, b, max_steps=4)
    assert th.equal(x, again)


def test_conjugate_gradient_of_nothing() -> None:
    calls: list[int] = []

    def product(vector: th.Tensor) -> th.Tensor:
        calls.append(1)
        return vector

    assert not conjugate_gradient(product, th.zeros(3), 10).any() and not calls


class Problem(StepProblem):
    """A step problem, and what an optimiser that knows none of our algebra says of it."""

    def solve(self, dtype: th.dtype = th.float64, recovery: float = 1.0) -> Step:
        g, B, v, W = self.tensors(dtype)
        return constrained_step(g, B, self.c, v, W, self.delta, recovery)

    def scale(self, lost: bool) -> np.ndarray:
        """What violations are measured in, shape (m,): a sum of squares knows one unit alone."""
        reach = np.sqrt(2 * self.delta * np.diag(self.B @ self.inverse @ self.B.T))
        return np.full_like(reach, reach.max()) if lost else reach

    def reference(self, rng: np.random.Generator, lost: bool) -> float:
        """The optimal value found by SLSQP in coordinates where the trust region is a unit ball."""
        radius = np.sqrt(2 * self.delta)
        root = np.linalg.inv(np.linalg.cholesky(self.F)).T * radius  # x = root @ y
        g, B = self.g @ root, self.B @ root
        scale = self.scale(lost)
        constraints = [{"type": "ineq", "fun": lambda y: 1 - y @ y, "jac": lambda y: -2 * y}]
        if lost:

            def objective(y: np.ndarray) -> tuple[float, np.ndarray]:
                excess = np.maximum(0.0, (self.c + B @ y) / scale)
                return float(excess @ excess), 2 * (B.T / scale) @ excess

        else:

            def objective(y: np.ndarray) -> tuple[float, np.ndarray]:
                return -float(g @ y) / np.linalg.norm(g), -g / np.linalg.norm(g)

            constraints.append(
                {
                    "type": "ineq",
                    "fun": lambda y: -(self.c + B @ y) / scale,
                    "jac": lambda y: -(B.T / scale).T,
                }
            )
        # Near a constraint that only touches the ball, a start can strand: take the best of some.
        values = []
        for _ in range(6):
            start = 0.3 * rng.normal(size=len(g))
            answer = minimize(
                objective,
                start,
                jac=True,
                constraints=constraints,
                method="SLSQP",
                options={"ftol": 1e-13, "maxiter": 300},
            )
            y = answer.x
            if y @ y <= 1 + 1e-7 and (lost or np.all((self.c + B @ y) / scale <= 1e-7)):
                values.append(float(answer.fun))
                if answer.success:
                    break
        assert values, "the reference found no feasible point"
        return min(values)

    def check(self, rng: np.random.Generator) -> Case:
        step = self.solve()
        x, lost = step.x.numpy(), step.case is Case.LOST
        assert 0.5 * x @ self.F @ x <= self.delta * (1 + 1e-8)
        radius = np.sqrt(2 * self.delta)
        root = np.linalg.inv(np.linalg.cholesky(self.F)).T * radius
        scale = self.scale(lost)
        if lost:
            value = float(np.sum(np.maximum(0.0, (self.c + self.B @ x) / scale) ** 2))
            assert value > 0.0
        else:
            assert np.all((self.c + self.B @ x) / scale <= 1e-7)
            value = -float(self.g @ x) / np.linalg.norm(self.g @ root)
            # The multipliers explain the step: g = λ F x + Bᵀν with ν ≥ 0.
            assert np.all(step.nu >= 0.0)
            gap = self.g - step.lambda_kl * self.F @ x - self.B.T @ step.nu
            assert np.linalg.norm(gap) <= 1e-6 * (
                np.linalg.norm(self.g) + np.linalg.norm(self.B.T @ step.nu)
            )
        assert value <= self.reference(rng, lost) + 1e-6
        return step.case


def _ratios(case: Case, m: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    low, high = {
        Case.INACTIVE: (-3.0, -1.01),
        Case.BINDING: (-0.99, -0.01),
        Case.RECOVERABLE: (0.01, 0.99),
        Case.LOST: (1.01, 3.0),
    }[case]
    while True:
        ratios = rng.uniform(-1.5, 1.5, size=m)
        ratios[rng.integers(m)] = rng.uniform(low, high)
        if case in (Case.INACTIVE, Case.BINDING):
            ratios = -np.abs(ratios)
        if case is Case.INACTIVE:
            ratios = np.minimum(ratios, rng.uniform(low, high, size=m))
        yield ratios


@pytest.mark.parametrize("case", [Case.INACTIVE, Case.BINDING, Case.RECOVERABLE, Case.LOST])
@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize("wanted", FEW_OR_MANY)
def test_constrained_step_against_an_optimiser(wanted: int, case: Case, m: int) -> None:
    """Random problems for each case and number of constraints."""
    rng = np.random.default_rng(100 * m + case)
    seen = Counter[Case]()
    for ratios in _ratios(case, m, rng):
        problem = Problem(rng, ratios)
        # With several constraints the geometry decides: keep drawing until the case comes up.
        if problem.solve().case is case:
            problem.check(rng)
            seen[case] += 1
        else:
            assert m > 1, f"{ratios} is not {case.name}"
        if seen[case] == wanted:
            break


@pytest.mark.parametrize("case", [Case.BINDING, Case.RECOVERABLE])
@pytest.mark.parametrize("m", [2, 3])
def test_constraints_of_different_size_against_an_optimiser(case: Case, m: int) -> None:
    """Costs in units that lie up to twelve orders of magnitude apart."""
    rng = np.random.default_rng(10 * m + case)
    seen = 0
    for ratios in _ratios(case, m, rng):
        problem = Problem(rng, ratios, scales=10 ** rng.uniform(-4, 8, size=m))
        if problem.solve().case is case:
            problem.check(rng)
            seen += 1
        if seen == 25:
            break


def _one_after_the_other(ratios: np.ndarray, normals: np.ndarray) -> Iterator[float]:
    """Least violations within the unit ball by SLSQP, each given those before it.

    :param ratios: violations at the origin, shape (m,)
    :param normals: how they change, shape (m, n)
    """
    y = np.zeros(normals.shape[1])
    constraints = [{"type": "ineq", "fun": lambda y: 1 - y @ y, "jac": lambda y: -2 * y}]
    for ratio, normal in zip(ratios, normals, strict=True):
        answer = minimize(
            lambda y, ratio=ratio, normal=normal: (ratio + normal @ y, normal),
            y,
            jac=True,
            constraints=constraints,
            method="SLSQP",
            options={"ftol": 1e-13, "maxiter": 300},
        )
        least, y = max(0.0, float(answer.fun)), 0.999 * answer.x
        yield least
        room = least + 1e-8 - ratio
        constraints.append(
            {
                "type": "ineq",
                "fun": lambda y, room=room, normal=normal: room - normal @ y,
                "jac": lambda y, normal=normal: -normal,
            }
        )


@pytest.mark.parametrize(("m", "decades"), [(2, 5), (2, 8), (3, 4)])
def test_a_lost_constraint_of_small_gradient_is_lowered_as_far_as_the_larger_ones_allow(
    m: int, decades: int
) -> None:
    """Of gradients so different in size, the sum of squares is a hierarchy."""
    rng = np.random.default_rng(m)
    for _ in range(25):
        ratios = np.append(rng.uniform(-0.9, 0.9, size=m - 1), rng.uniform(1.05, 1.5))
        problem = Problem(rng, ratios, scales=10.0 ** (-decades * np.arange(m) + 7))
        x, case, *_ = problem.solve()
        x, reach = x.numpy(), problem.scale(False)
        assert case is Case.LOST
        assert 0.5 * x @ problem.F @ x <= problem.delta * (1 + 1e-6)
        root = np.linalg.inv(np.linalg.cholesky(problem.F)).T * np.sqrt(2 * problem.delta)
        least = list(_one_after_the_other(ratios, problem.B @ root / reach[:, None]))
        assert np.all((problem.c + problem.B @ x) / reach <= np.array(least) + 1e-3)


@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize("problems", FEW_OR_MANY)
def test_constrained_step_on_the_boundary(problems: int, m: int) -> None:
    """c = 0 exactly, the usual state at cost_limit = 0: feasible, and the boundary binds."""
    rng = np.random.default_rng(m)
    for _ in range(problems):
        assert Problem(rng, np.zeros(m)).check(rng) is Case.BINDING


@pytest.mark.parametrize("m", [1, 2, 3])
@pytest.mark.parametrize("c", [-0.5, 0.0, 0.5])
def test_without_cost_gradient_it_takes_the_trpo_step(m: int, c: float) -> None:
    """Also where a limit is exceeded: nothing that the policy does would change that."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        problem = Problem(rng, np.zeros(m))
        problem.B[:], problem.c[:] = 0.0, c
        step = problem.solve()
        v = problem.inverse @ problem.g
        expected = np.sqrt(2 * problem.delta / (problem.g @ v)) * v
        np.testing.assert_allclose(step.x.numpy(), expected, rtol=1e-10)
        assert step.case is Case.NO_GRADIENT and not step.nu.any()
        assert step.lambda_kl == pytest.approx(
            np.sqrt(problem.g @ v / (2 * problem.delta)), rel=1e-10
        )


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_unit_of_cost_does_not_matter(scale: float) -> None:
    rng = np.random.default_rng(0)
    problem = Problem(rng, np.array([0.5]))
    step = problem.solve()
    problem.B[:], problem.c[:] = scale * problem.B, scale * problem.c
    scaled = problem.solve()
    assert scaled.case is step.case is Case.RECOVERABLE
    np.testing.assert_allclose(scaled.x.numpy(), step.x.numpy(), rtol=1e-6)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_a_share_of_the_recovery_leaves_room_for_the_reward(m: int) -> None:
    """Against the optimiser: the best reward that lowers each cost by nine tenths of the most."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        problem = Problem(rng, rng.uniform(1.5, 3.0, m))
        all_of_it, step = problem.solve(), problem.solve(recovery=0.9)
        assert step.case is all_of_it.case is Case.LOST
        x = step.x.numpy()
        assert 0.5 * x @ problem.F @ x <= problem.delta * (1 + 1e-8)
        change = problem.B @ all_of_it.x.numpy()
        problem.c = np.where(change < 0.0, -0.9 * change, -change)
        assert np.all((problem.c + problem.B @ x) / problem.scale(False) <= 1e-7)
        root = np.linalg.inv(np.linalg.cholesky(problem.F)).T * np.sqrt(2 * problem.delta)
        best = problem.reference(rng, False)
        assert -float(problem.g @ x) / np.linalg.norm(problem.g @ root) <= best + 1e-6


def test_a_hopeless_constraint_does_not_stop_the_others() -> None:
    """One violated constraint has no gradient; the other one is lowered as far as possible."""
    rng = np.random.default_rng(0)
    problem = Problem(rng, np.array([0.5, 1.5]))
    problem.B[0] = 0.0
    step = problem.solve()
    w = problem.inverse @ problem.B[1]
    expected = -np.sqrt(2 * problem.delta / (problem.B[1] @ w)) * w
    assert step.case is Case.LOST
    np.testing.assert_allclose(step.x.numpy(), expected, rtol=1e-6)


@pytest.mark.parametrize("ratio", [-0.5, 0.0, 0.5, 1.5])
def test_a_constraint_stated_twice_changes_nothing(ratio: float) -> None:
    """m = 2 goes through the dual, m = 1 through the closed form: they agree."""
    rng = np.random.default_rng(3)
    for _ in range(50):
        once = Problem(rng, np.array([ratio]))
        single = once.solve()
        once.B, once.c = np.repeat(once.B, 2, axis=0), np.repeat(once.c, 2)
        double = once.solve()
        assert single.case is double.case
        np.testing.assert_allclose(double.x.numpy(), single.x.numpy(), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("m", [1, 2])
@pytest.mark.parametrize("ratio", [-0.5, 0.0, 0.5, 1.5])
def test_without_reward_gradient_the_step_is_recovery(m: int, ratio: float) -> None:
    rng = np.random.default_rng(4)
    problem = Problem(rng, np.full(m, ratio))
    problem.g[:] = 0.0
    x = problem.solve().x.numpy()
    single = problem.solve(th.float32).x.numpy()
    np.testing.assert_allclose(single, x, rtol=1e-3, atol=1e-6)
    if ratio <= 0.0:
        assert not x.any()
    else:
        assert np.all(problem.B @ x < 0.0) or m > 1
        assert np.sum(np.maximum(0, problem.c + problem.B @ x) ** 2) < np.sum(problem.c**2)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_parallel_gradients(sign: float) -> None:
    """Reward along the cost: the boundary is as far as it goes, and nothing divides by zero."""
    rng = np.random.default_rng(5)
    problem = Problem(rng, np.array([-0.5]))
    problem.g = sign * problem.B[0]
    x = problem.solve().x.numpy()
    reached = float(problem.B[0] @ x)
    if sign > 0:
        assert reached == pytest.approx(-problem.c[0], rel=1e-8)
    else:
        assert 0.5 * x @ problem.F @ x == pytest.approx(problem.delta, rel=1e-8)


@pytest.mark.parametrize("noise", [1e-7, 1e-4])
@pytest.mark.parametrize("m", [2, 3])
def test_nearly_parallel_gradients_in_float32(m: int, noise: float) -> None:
    """Reward along a binding cost, but for rounding: within the region, the limits and 0.2 %."""
    rng = np.random.default_rng(m)
    for _ in range(25):
        problem = Problem(rng, np.append(rng.uniform(-1.0, 1.0, 1), np.full(m - 1, -0.7)), size=30)
        problem.g = problem.B[0] + noise * rng.normal(size=30)
        exact, (x, case, *_) = problem.solve(), problem.solve(th.float32)
        assert case is exact.case
        if case is Case.LOST:
            continue
        x = x.double().numpy()
        reach = np.sqrt(2 * problem.delta * np.diag(problem.B @ problem.inverse @ problem.B.T))
        assert 0.5 * x @ problem.F @ x <= problem.delta * (1 + 1e-3)
        assert np.all(problem.c + problem.B @ x <= 1e-3 * reach)
        assert problem.g @ x >= problem.g @ exact.x.numpy() - 2e-3 * reach[0]


@pytest.mark.parametrize("error", [0.0, 0.02])
def test_opposite_costs_are_weighed_without_leaving_the_region(error: float) -> None:
    """Of float32 and an inexact F⁻¹, as conjugate gradients that stop early give it."""
    rng = np.random.default_rng(6)
    for _ in range(50):
        problem = Problem(rng, rng.uniform(0.3, 1.0, size=2))
        problem.B[1] = -problem.B[0] + 1e-6 * rng.normal(size=6)
        tensors = (problem.g, problem.B, problem.inverse @ problem.g, problem.B @ problem.inverse)
        g, B, v, W = (th.as_tensor(each, dtype=th.float32) for each in tensors)
        W[1] *= 1 + error
        x, case, *_ = constrained_step(g, B, problem.c, v, W, problem.delta)
        x = x.double().numpy()
        assert case is Case.LOST
        assert 0.5 * x @ problem.F @ x <= problem.delta * (1.05 if error else 1.001)
        excess = np.maximum(0.0, problem.c + problem.B @ x)
        assert excess @ excess <= (1.05 if error else 1.0) * problem.c @ problem.c


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-9])
def test_a_violation_without_a_usable_gradient_stops_nothing(size):
    g, b = th.tensor([1.0, -2.0, 0.5]), size * th.tensor([[0.3, 1.0, -1.0]])
    for c in (0.5, -0.5, 0.0):
        x, case, *_ = constrained_step(g, b, np.array([c]), g, b, 0.02)
        assert x.any(), case

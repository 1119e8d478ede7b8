"""The known optima are right: each by a second method, on which its first does not rest."""

import numpy as np
import pytest
from cost_envs import TabularCMDP
from known_optima import Bandit, Street, Table, Worlds, problems
from scipy.optimize import minimize, minimize_scalar
from stable_baselines3.common.env_util import make_vec_env

PROBLEMS = problems()
TABLES = [name for name, problem in PROBLEMS.items() if problem.world().__class__ is Table]
BANDITS = [name for name, problem in PROBLEMS.items() if problem.world().__class__ is Bandit]


def lagrangian(cmdp: TabularCMDP, prices: np.ndarray) -> float:
    """Best expected return minus priced costs, by backward induction."""
    gains = cmdp.rewards - np.tensordot(prices, cmdp.costs, axes=1)  # [S, A]
    value = np.zeros(cmdp.n_states)
    for _ in range(cmdp.horizon):
        value = (gains + cmdp.transitions @ value).max(axis=1)
    return float(value[0])


@pytest.mark.parametrize("name", TABLES)
def test_the_dual_of_a_table_is_its_linear_programme(name: str) -> None:
    """min over λ >= 0 of max over π of J - λᵀ(J_C - d): no duality gap in a CMDP."""
    problem = PROBLEMS[name]
    cmdp, limits = problem.world().cmdp, np.array(problem.limits)
    # λ in units of return per limit, so that one step size fits all.
    answer = minimize(
        lambda x: lagrangian(cmdp, np.exp(x) / limits) + np.exp(x).sum(),
        np.full(len(limits), np.log(problem.best / 4)),
        method="Nelder-Mead",
        options={"maxiter": 2000, "xatol": 1e-7, "fatol": 1e-9},
    )
    assert answer.fun == pytest.approx(problem.best, rel=1e-4)
    assert lagrangian(cmdp, np.zeros(len(limits))) == pytest.approx(problem.unconstrained)


def test_a_policy_without_the_time_loses_little_in_the_chain() -> None:
    """The optimum is over all policies, but the time is not observed: what that costs is < 1 %."""
    problem = PROBLEMS["chain"]
    cmdp = problem.world().cmdp

    def evaluate(logits: np.ndarray) -> tuple[float, np.ndarray]:
        policy = np.exp(logits.reshape(cmdp.n_states, cmdp.n_actions))
        policy /= policy.sum(axis=1, keepdims=True)
        return cmdp.evaluate(np.tile(policy, (cmdp.horizon, 1)))

    found = minimize(
        lambda x: -evaluate(x)[0],
        np.zeros(cmdp.n_states * cmdp.n_actions),
        constraints={"type": "ineq", "fun": lambda x: problem.limits[0] - evaluate(x)[1][0]},
        bounds=[(-8.0, 8.0)] * (cmdp.n_states * cmdp.n_actions),
        method="SLSQP",
    )
    value, cost = evaluate(found.x)
    assert cost[0] <= problem.limits[0] * 1.0001
    assert 0.99 * problem.best <= value <= problem.best * 1.0001


@pytest.mark.parametrize("name", BANDITS)
def test_a_grid_of_actions_finds_a_bandits_optimum(name: str) -> None:
    problem = PROBLEMS[name]
    world = problem.world()
    axis = np.linspace(-1.0, 1.0, 401)
    actions = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    costs = actions @ world.normals.T  # [A, m]
    best = [
        world.reward(actions)[(costs + offset <= np.array(problem.limits) + 1e-9).all(axis=1)].max()
        for offset in world.offsets
    ]
    assert np.mean(best) == pytest.approx(problem.best, rel=1e-2)
    assert world.reward(actions).max() == pytest.approx(problem.unconstrained, rel=1e-3)


def test_dynamic_programming_finds_the_streets_optimum() -> None:
    """On a grid of positions and speeds, with the best price of the cost."""
    problem = PROBLEMS["street"]
    cell = Street.size / 20
    speeds = np.arange(-20, 21) / 20.0  # one cell to twenty per step
    positions = Street.position + cell * np.arange(-20, 20 * Street.horizon + 21)
    zone = Street.inside(positions)
    reach = np.clip(
        np.arange(len(positions))[:, None] + np.arange(-20, 21), 0, len(positions) - 1
    )  # [cells, speeds]

    def dual(price: float) -> float:
        value = np.zeros(len(positions))
        for _ in range(Street.horizon):
            value = (value[reach] + speeds - price * speeds**2 * zone[:, None]).max(axis=1)
        return float(value[20]) + price * problem.limits[0]

    answer = minimize_scalar(dual, bounds=(0.5, 20.0), method="bounded", options={"xatol": 1e-3})
    assert answer.fun == pytest.approx(problem.best, rel=0.01)
    assert dual(0.0) == problem.unconstrained


def test_whoever_stops_at_the_limit_has_the_walls_optimum() -> None:
    problem = PROBLEMS["wall"]
    world = problem.world()

    def drive(depth: float) -> tuple[float, float]:
        rng = np.random.default_rng(0)
        state, total, worst = world.start(rng, 4000), 0.0, 0.0
        for time in range(world.horizon):
            action = np.clip((depth - state) / 0.1, -1.0, 1.0)[:, None]
            state, reward, cost = world.move(state, time, action, rng)
            total, worst = total + reward.mean(), max(worst, cost.max())
        return total, worst

    value, worst = drive(problem.limits[0])
    assert worst == pytest.approx(problem.limits[0]) and value == pytest.approx(1.25, rel=0.01)
    value, worst = drive(10.0)
    assert value == pytest.approx(problem.unconstrained) and worst > 4 * problem.limits[0]


def test_whoever_brakes_in_time_has_the_brinks_optimum() -> None:
    """The fastest speed from which the cart can still stop reaches the brink, at no cost."""
    problem = PROBLEMS["brink"]
    world = problem.world()
    pushes = np.linspace(-1.0, 1.0, 201)

    def drive(brakes: bool) -> tuple[float, float]:
        rng = np.random.default_rng(0)
        state, total, costs = world.start(rng, 2000), 0.0, 0.0
        for time in range(world.horizon):
            action = np.ones(len(state))
            if brakes:
                speed = np.clip(state[:, 1:] + world.push * pushes, -world.top, world.top)
                slower = (np.maximum(speed - k * world.push, 0.0) for k in range(1, 5))
                stops = state[:, :1] + speed + sum(slower) <= 1e-12
                action = np.where(stops, pushes, -1.0).max(axis=1)
            state, reward, cost = world.move(state, time, action[:, None], rng)
            total, costs = total + reward.mean(), costs + cost.mean()
        return total, costs

    value, cost = drive(brakes=True)
    assert cost == 0.0 and value == pytest.approx(problem.best, rel=0.01)
    value, cost = drive(brakes=False)
    assert value == pytest.approx(problem.unconstrained)
    assert cost == pytest.approx(problem.unit, rel=0.01)


def test_rows_are_the_environment_that_gymnasium_has() -> None:
    """Means of random episodes agree between a batch and SB3's vectorised single environments."""
    problem = PROBLEMS["table-3"]
    cmdp = problem.world().cmdp
    value, costs = cmdp.evaluate(np.full((cmdp.horizon * cmdp.n_states, 3), 1 / 3))
    batch = Worlds(problem.world(), 4000, seed=1)
    single = make_vec_env(lambda: cmdp, 1, seed=0)
    rng = np.random.default_rng(0)
    batch.reset()
    single.reset()
    for step in range(cmdp.horizon):
        _, _, dones, infos = batch.step(rng.integers(3, size=4000))
        assert dones.all() == (step == cmdp.horizon - 1)
    returns = [info["episode"]["r"] for info in infos]
    sums = np.mean([info["episode"]["costs"] for info in infos], axis=0)
    assert np.mean(returns) == pytest.approx(value, rel=0.03)
    np.testing.assert_allclose(sums, costs, rtol=0.03)
    totals = []
    for _ in range(300):
        for _ in range(cmdp.horizon):
            _, _, dones, infos = single.step(rng.integers(3, size=1))
        assert dones[0]
        totals.append(infos[0]["episode"]["r"])
    assert np.mean(totals) == pytest.approx(value, rel=0.05)

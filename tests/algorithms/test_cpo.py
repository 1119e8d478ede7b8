"""CPO: its step, its line-search test, its units, and what it does where nothing is at stake."""

import copy
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from cost_envs import CostPoint, told
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_guard.algorithms import CPO
from sb3_guard.algorithms.common.actor import Trial
from sb3_guard.algorithms.common.constrained import Constrained
from sb3_guard.algorithms.common.natural_gradient import Case, Step

KEYS = ("cost", "cost_1")


def make(env: Any = CostPoint, n_envs: int = 4, **kwargs: Any) -> CPO:
    defaults: dict[str, Any] = {"n_steps": 100, "n_critic_updates": 5, "seed": 0, "device": "cpu"}
    return CPO("MlpPolicy", make_vec_env(env, n_envs, seed=0), **{**defaults, **kwargs})


def acceptance(model: CPO, violation: list[float], case: Case, monkeypatch: Any) -> Any:
    """The line search's test where the solver says so, at violations of limits of 0."""
    m = len(violation)
    step = Step(th.zeros(1), case, 0.0, np.zeros(m), np.ones(m, bool))
    monkeypatch.setattr("sb3_guard.algorithms.cpo.constrained_step", lambda *args: step)
    model.set_logger(Logger(None, []))
    told(model, violation)
    gradients = {"gradient": None, "cost_gradients": th.zeros(m, 1), "solve": lambda b: b}
    return model.plan(SimpleNamespace(delta=model.target_kl, **gradients))[1]  # type: ignore


@pytest.mark.parametrize(
    ("violation", "case", "kl", "improvement", "cost_change", "accepted"),
    [
        # Feasible: reward must not fall, cost may rise up to the limit.
        (-0.5, Case.BINDING, 0.01, 0.1, 0.4, True),
        (-0.5, Case.BINDING, 0.01, 0.1, 0.6, False),
        (-0.5, Case.BINDING, 0.01, -0.1, -0.4, False),
        # Violated: cost must not rise, reward may fall.
        (0.5, Case.RECOVERABLE, 0.01, -0.1, -0.1, True),
        (0.5, Case.LOST, 0.01, -9.0, -1e-6, True),
        (0.5, Case.LOST, 0.01, 0.1, 1e-6, False),
        # On the limit, and nothing to be gained or lost.
        (0.0, Case.NO_GRADIENT, 0.01, 0.1, 0.0, True),
        (0.0, Case.BINDING, 0.01, 0.1, 1e-6, False),
        # The trust region and numbers that are none.
        (-0.5, Case.BINDING, 0.021, 0.1, 0.0, False),
        (-0.5, Case.BINDING, np.nan, 0.1, 0.0, False),
        (0.5, Case.LOST, 0.01, 0.1, np.nan, False),
    ],
)
def test_line_search_test(
    violation: float,
    case: Case,
    kl: float,
    improvement: float,
    cost_change: float,
    accepted: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    accept = acceptance(make(target_kl=0.02), [violation], case, monkeypatch)
    assert accept(Trial(kl, improvement, np.array([cost_change]))) is accepted


@pytest.mark.parametrize(
    ("case", "cost_change", "accepted"),
    [
        # Violations 0.5 and 0.1: lost, the sum of their squares is to fall.
        (Case.LOST, [-0.1, 0.1], True),
        (Case.LOST, [0.1, -0.1], False),
        (Case.LOST, [0.0, 0.0], True),
        (Case.LOST, [np.nan, -0.1], False),
        # What can be kept within the region may not rise.
        (Case.RECOVERABLE, [-0.1, 0.1], False),
        (Case.RECOVERABLE, [-0.1, -0.1], True),
    ],
)
def test_line_search_test_of_two_costs(
    case: Case, cost_change: list[float], accepted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make(lambda: CostPoint(cost_keys=KEYS), cost_keys=KEYS)
    accept = acceptance(model, [0.5, 0.1], case, monkeypatch)
    assert accept(Trial(0.01, 0.0, np.array(cost_change))) is accepted


@pytest.mark.parametrize(
    ("limit", "margin", "cases"),
    [(3.0, 0.0, {Case.LOST, Case.RECOVERABLE}), (10.0, 1.0, {Case.INACTIVE, Case.BINDING})],
)
def test_the_step_solves_the_linearised_problem(limit: float, margin: float, cases: Any) -> None:
    """Within limit and margin where the region reaches them, else 98 % of the way to them."""
    near = {"hazard": (-1.0, 0.0)}
    model = make(lambda: CostPoint(**near), cost_limit=limit, cg_max_steps=60, margin_lr=0.0)
    model.margin.value += margin
    seen = []
    plan = model.plan

    def spy(region: Any) -> Any:
        x, accept = plan(region)
        reach = float(region.product(x) @ x) / (2 * region.delta)
        case = Case(model.logger.name_to_value["train/cpo_case"])
        c = float(model.costs.episode_cost[0] - limit + margin) / model.costs.horizon
        b = region.cost_gradients[0]
        most = float(2 * region.delta * (b @ region.solve(b))) ** 0.5
        seen.append((case, c, most, float(b @ x), reach))
        return x, accept

    model.plan = spy  # type: ignore[method-assign]
    model.learn(1200)
    assert len(seen) == 3
    assert {case for case, *_ in seen} == cases
    for case, c, most, change, reach in seen:
        assert reach <= 1.01
        if case is Case.LOST:
            assert c > most and change == pytest.approx(-0.98 * most, rel=1e-4)
        else:
            assert c + change <= 1e-6


def test_violation_is_in_units_of_the_cost_surrogate() -> None:
    """(J_C - d) / T, from the episodes that ended in this rollout and no others."""
    model = make(lambda: CostPoint(episode_length=40), n_steps=100, cost_limit=0.7)
    episodes: list[list[float]] = []

    def record(local: dict, _: dict) -> bool:
        for i, info in enumerate(local["infos"]):
            while len(episodes) <= i:
                episodes.append([])
            episodes[i].append(info["cost"])
        return True

    estimates = []
    train = model.train

    def spy() -> None:
        estimates.append(copy.copy(model.costs))
        train()

    model.train = spy  # type: ignore[method-assign]
    model.learn(800, callback=record)
    costs = np.array(episodes)  # [n_envs, 200]
    first = costs[:, :80].reshape(4, 2, 40).sum(axis=2)
    second = costs[:, 80:200].reshape(4, 3, 40).sum(axis=2)
    for estimate, ended in zip(estimates, (first, second), strict=True):
        assert estimate.horizon == 40
        assert estimate.episode_cost[0] == pytest.approx(ended.mean(), rel=1e-6)
        assert estimate.violation[0] == pytest.approx((ended.mean() - 0.7) / 40, rel=1e-6)
    assert model.total_cost == pytest.approx(costs.sum(), rel=1e-6)
    np.testing.assert_allclose(model.costs.episodes.totals[:, 0], 0.0, atol=1e-12)


@pytest.mark.parametrize("costs", [(5.0, 45.0), (45.0, 5.0)], ids=str)
@pytest.mark.parametrize(("n_envs", "n_steps"), [(1, 100), (8, 10)])
def test_every_episode_counts_once_whatever_its_length(
    costs: tuple[float, float], n_envs: int, n_steps: int
) -> None:
    """Episodes of 5 and 45 steps, in longer and shorter rollouts; their cost comes at the end."""
    model = make(n_envs=n_envs, n_steps=n_steps)
    model._setup_learn(1)
    rng, total = np.random.default_rng(0), 200 * n_steps
    done, cost = np.zeros((total, n_envs), bool), np.zeros((total, n_envs))
    for i in range(n_envs):
        kinds = rng.integers(0, 2, total // 5)
        ends = np.array([5, 45])[kinds].cumsum()
        within = ends <= total
        done[ends[within] - 1, i] = True
        cost[ends[within] - 1, i] = np.array(costs)[kinds[within]]
    sums, episodes = 0.0, 0
    for step, (each, over) in enumerate(zip(cost, done, strict=True), 1):
        Constrained._update_info_buffer(model, [{"cost": one} for one in each], over)
        if step % n_steps == 0:
            ended = done[step - n_steps : step].sum()
            model._estimate_costs(np.zeros(1))
            sums += ended * model.costs.episode_cost[0]
            episodes += ended
    assert episodes == done.sum()
    assert sums == pytest.approx(cost.sum())


@pytest.mark.parametrize("subprocess", [False, True])
def test_before_any_episode_ends_the_mean_of_stated_lengths_counts(subprocess: bool) -> None:
    """Of an environment registered by a function, whose spec can't leave its process, as well."""
    spec = gym.envs.registration.EnvSpec("CostPoint-v0", lambda: CostPoint(10**6, hazard=(-1, 0)))
    makers = [lambda n=n: gym.make(spec, max_episode_steps=n) for n in (400, 600)]
    env = SubprocVecEnv(makers, start_method="fork") if subprocess else DummyVecEnv(makers)
    model = CPO("MlpPolicy", env, n_steps=200, cost_limit=0.5, n_critic_updates=1, seed=0)
    rates = []
    train = model.train
    model.train = lambda: rates.append(model.rollout_buffer.costs.mean()) or train()
    model.learn(400)
    assert model.costs is not None and model.costs.horizon == 500 and rates[0] > 0.0
    assert model.costs.violation[0] == pytest.approx(rates[0] - 0.5 / 500, rel=1e-5)
    assert model.costs.episode_cost[0] == pytest.approx(500 * rates[0], rel=1e-5)
    env.close()


def test_without_a_stated_length_the_longest_episode_counts() -> None:
    env = make_vec_env(lambda: CostPoint(episode_length=10**6), 1)
    model = CPO("MlpPolicy", env, n_steps=20, n_critic_updates=1, seed=0).learn(60)
    assert model.costs.horizon == 60


def test_the_horizon_outlives_a_rollout_in_which_nothing_ends() -> None:
    model = make(lambda: CostPoint(episode_length=30), n_envs=1, n_steps=25)
    horizons = []
    train = model.train
    model.train = lambda: horizons.append(model.costs.horizon) or train()
    model.learn(125)
    assert horizons == [25, 30, 30, 30, 30], "the fifth rollout sees steps 101 to 125: none ends"


@pytest.mark.parametrize(("cost_scale", "limit"), [(0.0, 0.0), (0.0, 5.0), (1.0, 0.0)])
def test_finite_wherever_nothing_is_at_stake(cost_scale: float, limit: float) -> None:
    """d = 0, no cost , c = 0 and b = 0: parameters and logs stay finite, learning continues."""
    model = make(lambda: CostPoint(cost_scale=cost_scale), cost_limit=limit)
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(800)
    for old, new in zip(before, model.policy.parameters(), strict=True):
        assert th.isfinite(new).all() and not th.equal(old, new)
    logged = model.logger.name_to_value
    numbers = [value for value in logged.values() if isinstance(value, int | float)]
    assert np.isfinite(numbers).all(), logged


def test_several_costs_have_their_own_logs_and_limits() -> None:
    model = make(lambda: CostPoint(cost_keys=KEYS), cost_keys=KEYS, cost_limit=[1.0, 100.0])
    model.learn(400)
    logged = model.logger.name_to_value
    for name in ("train/nu", "train/constraint_violation", "train/cost_surrogate"):
        assert {f"{name}/{key}" for key in KEYS} <= set(logged)
    assert model.costs is not None
    np.testing.assert_allclose(model.costs.episode_cost[1], 2 * model.costs.episode_cost[0])
    violations = [logged[f"train/constraint_violation/{key}"] for key in KEYS]
    np.testing.assert_allclose(
        violations, model.costs.episode_cost - np.array([1.0, 100.0]), rtol=1e-6
    )
    assert model.cost_critic.predict(th.zeros(3, 4)).shape == (3, 2)
    model.logger.dump = lambda step=0: None  # type: ignore[method-assign]
    model.dump_logs()
    means = [logged[f"rollout/ep_cost_mean/{key}"] for key in KEYS]
    assert means[1] == pytest.approx(2 * means[0])
    assert logged["rollout/cost_rate/cost"] == pytest.approx(model.costs.total[0] / 400)


def test_cost_advantages_are_centred_and_not_scaled() -> None:
    """They share the limit's units, so only their mean may go; the reward's are standardised."""
    model = make(lambda: CostPoint(cost_scale=100.0, hazard=(-1.0, 0.0)))
    raw, batches = [], []
    surrogate, train = model.surrogate, model.train
    model.surrogate = lambda batch, ratio: batches.append(batch) or surrogate(batch, ratio)
    model.train = lambda: raw.append(model.rollout_buffer.cost_advantages.copy()) or train()
    model.learn(400)
    advantages, expected = batches[0].cost_advantages.numpy().ravel(), raw[0].ravel()
    assert abs(expected.mean()) > 1.0
    np.testing.assert_allclose(
        np.sort(advantages), np.sort(expected - expected.mean()), rtol=1e-3, atol=1e-3
    )
    assert batches[0].advantages.mean().item() == pytest.approx(0.0, abs=1e-5)
    assert batches[0].advantages.std().item() == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize("limit", [2.0, 0.0])
def test_the_margin_follows_what_was_missed(limit: float) -> None:
    env = make_vec_env(lambda: CostPoint(), 2, seed=0)
    model = CPO("MlpPolicy", env, n_steps=40, cost_limit=limit, margin_lr=0.5, n_critic_updates=1)
    model.set_logger(Logger(None, []))
    for cost, margin in ((3.0, 0.5), (2.5, 0.75), (9.0, 2.0), (1.0, 1.5), (0.0, 0.5)):
        told(model, [cost], 10.0)
        model.fit(None)  # type: ignore[arg-type]
        expected = margin if limit else 0.0  # at most the limit
        assert model.margin.value == pytest.approx(expected)
        violation = model.margin.violation(model.costs)
        assert violation * 10.0 == pytest.approx(cost - limit + expected)

"""A certificate is seldom false, is given to safe agents, and says what it is about."""

import json
import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from scipy import stats
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_guard import CPO, SCPO, DeliveryCallback
from sb3_guard.common.certificate import (
    ERROR,
    LOOKS,
    MOST,
    UPPER,
    Certificate,
    certify,
    mean_bounds,
)
from sb3_guard.common.vec_budgets import EarlyTermination


class Lottery(gym.Env):
    """Episodes of one step, whose cost is drawn from an exponential distribution."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, mean: float = 1.0, keys: tuple[str, ...] = ("cost",)) -> None:
        self.mean, self.keys = mean, keys

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        costs = {
            key: (i + 1) * self.np_random.exponential(self.mean) for i, key in enumerate(self.keys)
        }
        return np.zeros(1, np.float32), 2.0, True, False, costs


class Idle:
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.zeros((len(observation), 1), np.float32), None


def false_certificates(costs: np.ndarray, *looks: float) -> float:
    """The share of agents, of true mean 1, whose mean is said to be below 0.9999 at any look."""
    bounds = [mean_bounds(costs[:, : round(share * MOST)], UPPER * ERROR)[1] for share in looks]
    return float(np.mean(np.min(bounds, axis=0) <= 0.9999))


def exponential(rng, shape):
    return rng.exponential(1.0, shape)


def rare(rng, shape):
    return np.where(rng.random(shape) < 0.1, 10.0, 0.0)


@pytest.mark.parametrize("draw", [exponential, rare], ids=["exponential", "90 % zeros"])
def test_few_certificates_are_false_and_only_if_one_look_certifies(draw):
    costs = draw(np.random.default_rng(0), (10_000, MOST))
    noise = 3 * math.sqrt(ERROR * (1 - ERROR) / len(costs))
    assert false_certificates(costs, 1.0) <= ERROR + noise
    assert false_certificates(costs, *LOOKS) > ERROR + noise


def test_students_bounds_would_be_too_low():
    costs = rare(np.random.default_rng(0), (10_000, 100))
    student = costs.mean(axis=1) + stats.t.ppf(0.95, 99) * costs.std(axis=1, ddof=1) / 10
    assert np.mean(student < 1.0) > 0.06
    assert np.mean(mean_bounds(costs, 0.05)[1] < 1.0) < 0.05


def test_without_skewness_the_bounds_are_students():
    values = np.array([-1.0, 1.0] * 50)
    half = stats.t.ppf(0.99, 99) * values.std(ddof=1) / 10
    np.testing.assert_allclose(mean_bounds(values, 0.01), (-half, half), rtol=2e-3)
    # One that is turned around has its bounds turned around.
    values = np.random.default_rng(0).exponential(1.0, 50)
    np.testing.assert_allclose(
        mean_bounds(-values, 0.05), np.negative(mean_bounds(values, 0.05))[::-1]
    )
    np.testing.assert_allclose(mean_bounds(np.full(30, 7.0), 0.05), (7.0, 7.0))
    assert np.isfinite(mean_bounds(values, 1e-20)).all()  # 1 - 1e-20 is 1


@pytest.mark.parametrize(
    ("limit", "verdict", "episodes"),
    [(3.0, "certified", MOST), (0.4, "exceeded", 100), (1.02, "undecided", MOST)],
)
def test_only_all_of_the_episodes_certify(limit, verdict, episodes):
    certificate = certify(Idle(), Lottery(), limit, seed=np.int64(1))
    assert (certificate.verdict, certificate.episodes) == (verdict, episodes)
    cost = certificate.costs["cost"]
    assert cost.lower < cost.mean < cost.upper and certificate.mean_return == 2.0
    assert str(certificate).startswith(f"{verdict}: mean cost ") and "\n" not in str(certificate)
    if verdict == "undecided":  # bounds come closer as 1/√n
        shrunk = (cost.upper - cost.mean) / (cost.limit - cost.mean)
        assert certificate.to_decide == pytest.approx(MOST * shrunk**2, rel=0.2)
    else:
        assert certificate.to_decide is None
    assert certificate.agent == ""  # there are no weights
    text = certificate.to_json()
    assert json.loads(text)["verdict"] == verdict
    assert Certificate.from_json(text) == certificate


def test_the_episodes_depend_on_the_seed_alone():
    results = [certify(Idle(), Lottery(), 3.0, seed=seed).costs["cost"].mean for seed in (1, 1, 2)]
    assert results[0] == results[1] != results[2]
    several = certify(Idle(), DummyVecEnv([Lottery] * 7), 3.0, seed=1)
    assert several.episodes == MOST and several.verdict == "certified"


@pytest.mark.parametrize("tries", [1, 3])
def test_bounds_looks_costs_and_tries_share_the_error(tries, monkeypatch):
    """Whatever the shares are: those of all bounds of all tries add up to the error."""
    shares = []

    def spied(values, error):
        shares.append(error)
        return mean_bounds(values, error)

    monkeypatch.setattr("sb3_guard.common.certificate.mean_bounds", spied)
    keys = ("cost", "other")
    certify(Idle(), Lottery(keys=keys), (3.0, 6.0), cost_keys=keys, seed=1, tries=tries)
    # Of each cost a lower bound at three looks, and the upper bound of the last one.
    looks = np.reshape(shares, (3, 2, 2))
    assert tries * (looks[:, :, 0].sum() + looks[-1, :, 1].sum()) == pytest.approx(ERROR)


def test_tries_and_costs_share_the_error():
    bounds = [certify(Idle(), Lottery(), 3.0, seed=1, tries=n).nearest.upper for n in (1, 3)]
    assert bounds[0] < bounds[1]
    # Where there are others to try, a mean above the limit is not looked at again.
    episodes = [certify(Idle(), Lottery(), 0.98, seed=1, tries=n).episodes for n in (1, 3)]
    assert episodes[0] == MOST > episodes[1]
    both = certify(
        Idle(), Lottery(keys=("cost", "other")), (3.0, 6.0), cost_keys=("cost", "other"), seed=1
    )
    assert both.verdict == "certified" and [*both.costs] == ["cost", "other"]
    lines = ("certified: return", "  mean cost ", "  mean other ")
    assert all(map(str.startswith, str(both).splitlines(), lines))
    assert both.costs["cost"].limit == 3.0 and both.costs["other"].limit == 6.0
    assert (
        certify(
            Idle(), Lottery(keys=("cost", "other")), (3.0, 0.1), cost_keys=("cost", "other"), seed=1
        ).verdict
        == "exceeded"
    )


def test_the_hash_knows_weights_and_normaliser():
    env = VecNormalize(DummyVecEnv([Lottery]), norm_reward=False)
    env.reset()
    hashes = []
    for seed in (0, 0, 1):
        model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=seed)
        hashes.append(certify(model, env, 3.0, n_episodes=100, seed=1).agent)
    env.obs_rms.mean += 1.0
    hashes.append(certify(model, env, 3.0, n_episodes=100, seed=1).agent)
    assert hashes[0] == hashes[1] and len({*hashes}) == 3


@pytest.mark.parametrize("limit", [math.nan, math.inf, None, "1", (1.0, 2.0)])
def test_a_limit_is_a_finite_number(limit):
    with pytest.raises(ValueError, match="cost_limit"):
        certify(Idle(), Lottery(), limit)


@pytest.mark.parametrize("wrong", [{"error": 0.95}, {"error": 5}, {"error": 0.0}, {"tries": 0}])
def test_an_error_is_a_small_probability(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        certify(Idle(), Lottery(), 3.0, **wrong)


def test_fewer_than_a_hundred_episodes_are_refused():
    with pytest.raises(ValueError, match=r"n_episodes.*100"):
        certify(Idle(), Lottery(), 1.0, n_episodes=99)


def test_absent_costs_are_refused():
    with pytest.raises(ValueError, match="cost"):
        certify(Idle(), Lottery(keys=("price",)), 1.0)
    with pytest.raises(ValueError, match="no step reported a cost as othr"):
        certify(Idle(), Lottery(keys=("cost", "other")), 9.0, cost_keys=("cost", "othr"))


def test_costs_that_may_be_absent_are_0_of_a_safe_agent():
    model = CPO("MlpPolicy", Lottery(), cost_limit=0.0, missing_cost="zero", n_steps=8)
    bound = certify(model, Lottery(keys=("price",)), seed=1).costs["cost"]
    assert (bound.upper, bound.share_above) == (0.0, 0.0)


def test_a_limit_on_the_worst_step_says_so():
    model = SCPO("MlpPolicy", Lottery(), cost_limit=3.0, n_steps=8)
    assert str(certify(model, Lottery(), seed=1)).startswith("certified: mean worst step of cost ")


class Breaks(Lottery):
    """Every third episode ends in a physics error."""

    episodes = 0

    def step(self, action):
        *step, info = super().step(action)
        self.episodes += 1
        return *step, {**info, "physics_error": self.episodes % 3 == 0}


def test_an_agent_that_breaks_the_simulation_is_not_certified():
    certificate = certify(Idle(), Breaks(), 3.0, n_episodes=120, seed=1)
    assert certificate.verdict == "undecided" and certificate.to_decide is None
    assert (certificate.episodes, certificate.physics_errors) == (80, 40)
    assert certificate.costs["cost"].upper < 3.0 and "40 more" in str(certificate)
    assert certify(Idle(), Breaks(), 0.3, n_episodes=120, seed=1).verdict == "exceeded"


class Endless(Lottery):
    def step(self, action):
        observation, reward, _, _, info = super().step(action)
        return observation, reward, False, False, info


def test_episodes_without_an_end_are_refused(monkeypatch):
    monkeypatch.setattr("sb3_guard.common.evaluation.LONGEST", 50)
    with pytest.raises(ValueError, match=r"25 of 25 episodes did not end.*max_episode_steps"):
        certify(Idle(), Endless(), 1.0, n_episodes=100)


def test_an_absent_normaliser_is_refused():
    env = VecNormalize(DummyVecEnv([Lottery]), norm_reward=False)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8)
    for other in DummyVecEnv([Lottery]), VecNormalize(DummyVecEnv([Lottery])):  # of no observation
        with pytest.raises(ValueError, match="VecNormalize"):
            certify(model, other, 1.0)


def test_a_wrapper_for_training_only_is_refused():
    """Episodes that end when a budget is spent can't exceed it."""
    env = VecMonitor(DummyVecEnv([lambda: EarlyTermination(Lottery(), budget=1.0)]))
    with pytest.raises(ValueError, match="training only"):
        certify(Idle(), env, 1.0)
    model = CPO("MlpPolicy", Lottery(), n_steps=8)
    with pytest.raises(ValueError, match="training only"):
        DeliveryCallback(env).init_callback(model)

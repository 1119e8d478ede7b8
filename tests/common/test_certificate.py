"""A certificate is seldom false, is given to safe agents, and says what it is about."""

import json
import math
from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

from sb3_guard import CPO, SCPO, DeliveryCallback, make_vec_env
from sb3_guard.common.certificate import Certificate, certify
from sb3_guard.common.vec_budgets import EarlyTermination
from sb3_guard.judging import EPISODES


class Lottery(gym.Env):
    """Episodes of one step, whose cost is drawn from an exponential distribution."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, mean: float = 1.0, keys: tuple[str, ...] = ("cost",)) -> None:
        self.mean, self.keys = mean, keys

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.random(1, np.float32), {}

    def step(self, action):
        costs = {
            key: (i + 1) * self.np_random.exponential(self.mean) for i, key in enumerate(self.keys)
        }
        return np.zeros(1, np.float32), 2.0, True, False, costs


class Idle:
    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.zeros((len(observation), 1), np.float32), None


@pytest.mark.parametrize(
    ("limit", "verdict", "episodes"),
    [(3.0, "certified", EPISODES), (0.4, "exceeded", 100), (1.05, "undecided", EPISODES)],
)
def test_only_all_of_the_episodes_certify(limit, verdict, episodes):
    certificate = certify(Idle(), Lottery(), limit, seed=np.int64(1))
    assert (certificate.verdict, certificate.episodes) == (verdict, episodes)
    cost = certificate.costs["cost"]
    assert cost.lower < cost.mean < cost.upper and certificate.mean_return == 2.0
    assert str(certificate).startswith(f"{verdict}: mean cost ") and "\n" not in str(certificate)
    assert (certificate.to_decide is None) == (verdict != "undecided")
    assert certificate.agent == ""  # there are no weights
    text = certificate.to_json()
    assert json.loads(text)["verdict"] == verdict
    assert Certificate.from_json(text) == certificate


def test_the_episodes_depend_on_the_seed_alone():
    results = [certify(Idle(), Lottery(), 3.0, seed=seed).costs["cost"].mean for seed in (1, 1, 2)]
    assert results[0] == results[1] != results[2]
    several = certify(Idle(), DummyVecEnv([Lottery] * 7), 3.0, seed=1)
    assert several.episodes == EPISODES and several.verdict == "certified"


def test_tries_share_the_error_and_every_cost_has_its_line():
    bounds = [certify(Idle(), Lottery(), 3.0, seed=1, tries=n).nearest.upper for n in (1, 3)]
    assert bounds[0] < bounds[1]
    keys = ("cost", "other")
    both = certify(Idle(), Lottery(keys=keys), (3.0, 6.0), cost_keys=keys, seed=1)
    assert both.verdict == "certified" and [*both.costs] == [*keys]
    lines = ("certified: return", "  mean cost ", "  mean other ")
    assert all(map(str.startswith, str(both).splitlines(), lines))
    assert both.costs["cost"].limit == 3.0 and both.costs["other"].limit == 6.0


class Bounded(Lottery):
    """An episode costs nothing or 4."""

    def step(self, action):
        *rest, _ = super().step(action)
        return *rest, {"cost": 4.0 * (self.np_random.random() < 0.1)}


def test_environments_in_processes_are_certified():
    with closing(SubprocVecEnv([Lottery] * 2, start_method="fork")) as env:
        assert certify(Idle(), env, 3.0, n_episodes=100, seed=1).verdict == "certified"


def test_an_exact_certificate():
    certificate = certify(Idle(), Bounded(), 1.0, seed=1, most=4.0)
    assert certificate.verdict == "certified" and certificate.most == 4.0
    assert certificate.episodes in (100, 200) and str(certificate).endswith("confidence 95%")
    assert Certificate.from_json(certificate.to_json()) == certificate
    with pytest.raises(ValueError, match="an episode cost 4, which is not within 0 and most=3"):
        certify(Idle(), Bounded(), 1.0, seed=1, most=3.0)


def test_no_cost_at_all_says_what_would_not_have_been_seen():
    certificate = certify(Idle(), Lottery(mean=0.0), 1.0, seed=1)
    assert str(certificate).startswith(
        "certified: mean cost 0, limit 1; no cost in 600 fresh episodes, an event in up to 1 of "
        "200 would not have been seen; return 2"
    )


class Copies(Lottery):
    """Rows with generators of their own, which no seed reaches."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=1)


@pytest.mark.parametrize("n_envs", [1, 4])
def test_copies_of_one_episode_are_refused(n_envs):
    with pytest.raises(ValueError, match="copies of one episode"):
        certify(Idle(), DummyVecEnv([Copies] * n_envs), 3.0)


class OwnWorlds(Lottery):
    """Each row draws its worlds from a generator of its own, which is seeded alike in all rows."""

    def __init__(self) -> None:
        super().__init__()
        self.worlds = np.random.default_rng(0)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.worlds.random(1, np.float32), {}


def test_copies_of_one_world_are_refused_though_the_episodes_in_it_differ():
    with pytest.raises(ValueError, match="copies of one episode"):
        certify(Idle(), DummyVecEnv([OwnWorlds] * 20), 3.0)
    assert certify(Idle(), DummyVecEnv([OwnWorlds]), 3.0).verdict == "certified"


def test_an_environment_without_an_id_is_no_ones():
    env = DummyVecEnv([Lottery])
    model = agent(env)
    certificate = certify(model, env, 3.0, n_episodes=100, seed=1)
    assert certificate.foreign(model, env, True) == "another environment"
    assert certificate.foreign(Idle(), env, True) == "another agent"
    assert certify(Idle(), env, 3.0).foreign(Idle(), env, True) == "another agent"


def agent(env, **kwargs):
    return PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu", **kwargs)


def world(**kwargs):
    env = make_vec_env("Goal_Point_8Hazards", env_kwargs={"max_episode_steps": 2, **kwargs})
    return VecNormalize(env, norm_reward=False)


def test_a_certificate_is_of_an_agent_in_a_world():
    """Its identity: the environment and its arguments, networks, normaliser, kind of actions."""
    env = world()
    env.reset()
    model = agent(env)
    certificate = certify(model, env, 3.0, n_episodes=100, seed=1)
    assert certificate.foreign(model, env, True) == ""
    assert certificate.foreign(model, env, False) == "most likely actions"
    with th.no_grad():  # what acts, not what judges
        model.policy.value_net.weight += 1.0
    assert certificate.foreign(model, env, True) == ""
    for other in world(hazards={"size": 1.0}), world(max_episode_steps=3):
        other.obs_rms = env.obs_rms
        assert certificate.foreign(model, other, True) == "another environment"
    relu = agent(env, policy_kwargs={"activation_fn": th.nn.ReLU})
    relu.policy.load_state_dict(model.policy.state_dict())
    assert certificate.foreign(relu, env, True) == "another agent"
    for name, value in (("clip_obs", 5.0), ("epsilon", 1.0), ("obs_rms", None)):
        other = world()
        other.obs_rms = (
            RunningMeanStd(shape=env.obs_rms.mean.shape) if value is None else env.obs_rms
        )
        if value is not None:
            setattr(other, name, value)
        assert certificate.foreign(model, other, True) == "another agent"
    with th.no_grad():
        model.policy.action_net.bias += 1.0
    assert certificate.foreign(model, env, True) == "another agent"


def test_a_certificate_that_contradicts_itself_is_refused():
    content = json.loads(certify(Idle(), Lottery(), 3.0, seed=1).to_json())
    content["costs"]["cost"]["limit"] = 0.5
    with pytest.raises(ValueError, match="contradicts"):
        Certificate.from_json(json.dumps(content))


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
    assert (certificate.episodes, certificate.physics_errors) == (14, 6)
    assert certificate.costs["cost"].upper < 3.0 and "6 more" in str(certificate)
    assert certify(Idle(), Breaks(), 0.3, n_episodes=120, seed=1).verdict == "exceeded"


class Endless(Lottery):
    def step(self, action):
        observation, reward, _, _, info = super().step(action)
        return observation, reward, False, False, info


def test_episodes_without_an_end_are_refused(monkeypatch):
    monkeypatch.setattr("sb3_guard.common.evaluation.LONGEST", 50)
    with pytest.raises(ValueError, match=r"17 of 17 episodes did not end.*max_episode_steps"):
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

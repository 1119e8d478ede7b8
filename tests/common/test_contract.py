"""Environments that break their contract, lose costs or never end, and agents that can't act."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from cost_envs import CostPoint
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.atari_wrappers import MaxAndSkipEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_guard import CPO, CostEvalCallback, evaluate_policy, make_vec_env
from sb3_guard.common import evaluation
from sb3_guard.common.adapters import CostFromFunction

SMALL: dict[str, Any] = {"n_steps": 20, "n_critic_updates": 1, "cost_limit": 5.0, "seed": 0}


class Late(gym.Env):
    """Every step costs 1; from the seventh on, what it returns is wrong.

    :param fault: entries of a step that replace the right ones, by their number
    """

    def __init__(self, fault: dict[int, Any] | None = None, length: int | None = 40) -> None:
        self.observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.fault, self.length, self.steps = fault or {}, length, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.steps += 1
        over = self.steps == self.length
        values = [np.zeros(3, np.float32), 1.0, False, over, {"cost": 1.0}]
        if self.steps >= 7:
            for i, value in self.fault.items():
                values[i] = value
        return tuple(values)


class Still:
    """A policy that does nothing."""

    missing_cost = "zero"

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.zeros((len(observation), 1), np.float32), state


def test_a_cost_that_is_missing_later_than_at_the_first_step_is_a_line():
    with pytest.raises(ValueError, match="no cost key 'cost'") as caught:
        CPO("MlpPolicy", Late({4: {}}), **SMALL).learn(40)
    assert "step 7 of" in str(caught.value) and "\n" not in str(caught.value)


# Repeated steps


class Twice(gym.Wrapper):
    """A user's own, whose costs add up as its rewards do."""

    def step(self, action):
        _, earned, _, _, before = self.env.step(action)
        obs, reward, *ends, info = self.env.step(action)
        return obs, reward + earned, *ends, {**info, "cost": info["cost"] + before["cost"]}


def cost_of(observation, action, next_observation, info):
    return 2.0


@pytest.mark.parametrize(
    ("env", "cost"),
    [
        (Twice(Late()), 40.0),
        (CostFromFunction(MaxAndSkipEnv(Late(), 4), cost_of), 20.0),  # it is told outside
    ],
)
def test_what_tells_its_costs_itself_is_right(env, cost):
    model = CPO("MlpPolicy", env, **SMALL).learn(20)
    seen = evaluate_policy(model, env, 2)
    assert seen.costs.tolist() == [cost, cost] and len(seen) == 2


# Episodes without an end


def endless(*lengths: int | None) -> DummyVecEnv:
    return DummyVecEnv([lambda length=length: Late(length=length) for length in lengths])


def test_an_episode_without_an_end_is_given_up_unless_the_environment_says_so(monkeypatch):
    monkeypatch.setattr(evaluation, "LONGEST", 60)
    with pytest.warns(UserWarning, match="5 of 6 episodes .* 60 steps; .*max_episode_steps"):
        seen = evaluate_policy(Still(), endless(5, None), 6)
    assert seen.lengths.tolist() == [5]
    assert seen.unfinished.tolist() == [[60.0, 60.0, 60.0]]
    env = TimeLimit(Late(length=None), 70)
    assert evaluate_policy(Still(), env, 1).lengths.tolist() == [70]


def test_the_best_model_is_chosen_by_the_episodes_that_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "LONGEST", 60)
    model = CPO("MlpPolicy", Late(), **{**SMALL, "cost_limit": 50.0})
    watcher = CostEvalCallback(
        endless(5, None), eval_freq=20, n_eval_episodes=2, deterministic=True, log_path=tmp_path,
        verbose=0,
    )  # fmt: skip
    with pytest.warns(UserWarning, match="1 of 2 episodes are left out"):
        model.learn(20, callback=watcher)
    assert watcher.best_score == (True, 5.0)
    np.testing.assert_array_equal(np.load(tmp_path / "evaluations.npz")["results"], [[5, np.nan]])


@pytest.mark.parametrize(
    "env", [Late(), TimeLimit(Late(), 5), endless(5), gym.make_vec("CartPole-v1", 2)]
)
def test_an_environment_that_is_made_already(env):
    with pytest.raises(TypeError, match="is made already"):
        make_vec_env(env, 4)


# What an agent needs beside the observation


def test_recurrent_agents_remember_within_an_episode():
    env = make_vec_env(Late, 2, env_kwargs={"length": 6})
    model = RecurrentPPO("MlpLstmPolicy", env, n_steps=8, batch_size=8, seed=0).learn(32)
    seen: list[np.ndarray] = []
    predict = model.predict

    def listened(*args, **kwargs):
        actions, state = predict(*args, **kwargs)
        seen.append(actions.ravel())
        return actions, state

    model.predict = listened  # type: ignore[method-assign]
    evaluate_policy(model, env, 4)
    state, starts = None, np.ones(2, bool)
    for k, actions in enumerate(seen):
        starts[:] = k % 6 == 0
        expected, state = predict(np.zeros((2, 3), np.float32), state, starts, True)
        np.testing.assert_array_equal(actions, expected.ravel())
    assert len({float(actions[0]) for actions in seen[:6]}) == 6  # each step is another memory


# Agents that can't act


def test_weights_that_are_not_finite_are_named(tmp_path):
    model = PPO("MlpPolicy", CostPoint(5), n_steps=10, batch_size=10)
    model.policy.register_buffer("mask", th.tensor([0.0, -th.inf]))  # no weight
    evaluate_policy(model, CostPoint(5), 1)
    del model.policy.mask
    with th.no_grad():
        model.policy.action_net.bias[0] = np.nan
    model.save(tmp_path / "agent.zip")
    for agent in (model, PPO.load(tmp_path / "agent.zip"), model.policy):
        with pytest.raises(ValueError, match=r"weights 'action_net\.bias' are not finite"):
            evaluate_policy(agent, CostPoint(5), 1)


def spoil(normalizer: Any, **values: Any) -> None:
    for name, value in values.items():
        of = normalizer if hasattr(normalizer, name) else normalizer.obs_rms
        setattr(of, name, value)


UNFIT = {
    "another shape": {"mean": np.zeros(3)},
    "nan": {"mean": np.array([0, 0, np.nan, 0])},
    "broadcast": {"mean": np.zeros(1)},
    "one variance": {"var": np.ones(())},
    "negative": {"var": -np.ones(4)},
    "constant": {"var": np.array([1.0, 1.0, 0.0, 1.0])},
    "words": {"mean": np.array(["a"] * 4)},
    "none": {"obs_rms": None},
    "clip": {"clip_obs": np.nan},
}


def test_a_normalizer_of_some_entries_of_a_dictionary():
    suite = {"env_kwargs": {"flatten": False}, "max_episode_steps": 5}
    env = VecNormalize(make_vec_env("Goal_Point_8Hazards", **suite), norm_obs_keys=["velocimeter"])
    model = PPO("MultiInputPolicy", env, n_steps=10, batch_size=10)
    assert len(evaluate_policy(model, env, 1)) == 1
    env.obs_rms["velocimeter"].var[0] = -1.0
    with pytest.raises(ValueError, match="of 'velocimeter'"):
        evaluate_policy(model, env, 1)
    env.obs_rms = {}
    with pytest.raises(ValueError, match="observation statistics"):
        evaluate_policy(model, env, 1)


@pytest.mark.parametrize("name", UNFIT)
def test_a_normalizer_that_does_not_fit_is_refused(name):
    env = VecNormalize(make_vec_env(CostPoint, 2, env_kwargs={"episode_length": 5}))
    model = CPO("MlpPolicy", env, **SMALL)
    assert len(evaluate_policy(model, env, 2)) == 2
    spoil(env, **UNFIT[name])
    with pytest.raises(ValueError, match="observation statistics"):
        evaluate_policy(model, env, 2)

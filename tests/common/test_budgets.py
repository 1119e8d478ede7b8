"""Budget wrappers, compared with what is counted by hand."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_guard import CPO, TRPO, make_vec_env
from sb3_guard.common.vec_budgets import EarlyTermination, VecMaxCost, VecRemainingBudget

SUITE = "Goal_Point_8Hazards"
COSTS = (0.0, 1.0, 0.5, 0.5, 1.0, 0.0)
SHAPES = {
    "flat": spaces.Box(-1.0, 2.0, (3,), np.float32),
    "double": spaces.Box(-1.0, 2.0, (3,), np.float64),
    "whole": spaces.Box(0, 9, (3,), np.int64),
    "image": spaces.Box(0, 255, (36, 36, 3), np.uint8),
    "number": spaces.Discrete(5),
    "dictionary": spaces.Dict({"a": spaces.Box(-1.0, 1.0, (2,), np.float32)}),
}


class Scripted(gym.Env):
    """Reward 1, and costs as written down; the second is three times the first."""

    def __init__(self, space: spaces.Space = SHAPES["flat"]) -> None:
        self.observation_space = space
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        cost = COSTS[self.steps]
        self.steps += 1
        over = self.steps == len(COSTS)
        return self.observation_space.sample(), 1.0, False, over, {"cost": cost, "fee": 3 * cost}


def scripted(n: int = 2, space: spaces.Space = SHAPES["flat"]) -> DummyVecEnv:
    return DummyVecEnv([lambda: Scripted(space)] * n)


def play(env: Any, steps: int) -> list[Any]:
    return [env.step(np.zeros((env.num_envs, 2), np.float32)) for _ in range(steps)]


@pytest.mark.parametrize("discount", [1.0, 0.5])
def test_what_is_left_of_the_budget_is_observed(discount):
    env = VecRemainingBudget(scripted(), budget=2.0, discount=discount, unsafe_reward=-3.0)
    for _ in range(2):
        assert (env.reset()[:, -1] == 1.0).all()
        z = 1.0
        for cost, (obs, rewards, dones, infos) in zip(COSTS, play(env, 6), strict=True):
            z = (z - cost / 2.0) / discount
            last = [info["terminal_observation"][-1] if dones[0] else None for info in infos]
            seen = last if dones[0] else obs[:, -1]
            assert seen == pytest.approx([z, z]) and rewards.tolist() == [-3.0 if z < 0 else 1] * 2
        assert (obs[:, -1] == 1.0).all()  # of the next episode


@pytest.mark.parametrize("shape", SHAPES)
def test_the_budget_joins_every_kind_of_observation(shape):
    env = VecRemainingBudget(scripted(1, SHAPES[shape]), budget=2.0)
    policy = "MlpPolicy" if isinstance(env.observation_space, spaces.Box) else "MultiInputPolicy"
    TRPO(policy, env, n_steps=32, policy_kwargs={"net_arch": [8]}).learn(32)
    env.reset()
    obs = play(env, 3)[-1][0]
    left = obs["budget"] if isinstance(obs, dict) else obs[:, -1:]
    assert left.tolist() == [[0.25]]
    with pytest.raises(ValueError, match="wrapped twice"):
        VecRemainingBudget(VecRemainingBudget(scripted(1, SHAPES["dictionary"]), 1.0), 1.0)


@pytest.mark.parametrize(("budget", "end"), [(0, 2), (1.0, 3), (1.9, 4), (2.5, 5), (3.0, 6)])
def test_overspending_ends_the_episode(budget, end):
    """A budget that is spent exactly is kept."""
    env = EarlyTermination(Scripted(), budget, final_reward=-2.0)
    for _ in range(2):  # the second episode begins again
        env.reset()
        steps = [env.step(None) for _ in range(end)]
        over = end < len(COSTS)
        assert [terminated for _, _, terminated, _, _ in steps] == [False] * (end - 1) + [over]
        assert steps[-1][1] == (-1.0 if over else 1.0)


@pytest.mark.parametrize("flatten", [True, False])
def test_the_highest_cost_is_observed_and_its_increases_add_up(flatten):
    space = SHAPES["flat"] if flatten else SHAPES["dictionary"]
    env = VecMaxCost(scripted(2, space), ("cost", "fee"))
    env.reset()
    increases = np.zeros(2)
    for t, (obs, _, _, infos) in enumerate(play(env, 5), 1):
        highest = max(COSTS[:t])
        seen = obs[:, -2:] if flatten else obs["max_cost"]
        assert seen.tolist() == [[highest, 3 * highest]] * 2
        increases += [infos[1]["cost_increase"], infos[1]["fee_increase"]]
    assert increases.tolist() == [1.0, 3.0]


def test_algorithms_learn_behind_them():
    env = VecMaxCost(VecRemainingBudget(make_vec_env(SUITE, 2, seed=0), 5.0))
    model = CPO("MlpPolicy", env, n_steps=20, n_critic_updates=1, cost_keys=("cost_increase",))
    model.learn(80)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda env: VecRemainingBudget(env, 0.0), r"budget ?= ?0\.0"),
        (lambda env: VecRemainingBudget(env, 1.0, unsafe_reward="low"), "unsafe_reward ?= ?'low'"),
        (lambda env: EarlyTermination(env.envs[0], -1.0), r"budget ?= ?-1\.0"),
        (lambda env: play(VecMaxCost(env, ("fees",)), 1), "nearest: 'fee'"),
    ],
)
def test_bad_values_are_named(make, message):
    env = scripted()
    env.reset()
    with pytest.raises(ValueError, match=message):
        make(env)

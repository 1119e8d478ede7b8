"""Budget wrappers of a ``VecEnv``, compared with what is counted by hand."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from cost_envs import CostPoint
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env as sb3_make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_guard import CPO, TRPO, evaluate_policy, make_vec_env
from sb3_guard.common.vec_budgets import VecEarlyTermination, VecMaxCost, VecRemainingBudget

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
    env = VecEarlyTermination(scripted(), budget, final_reward=-2.0)
    env.reset()
    for _ in range(2):  # the second episode begins again
        steps = play(env, end)
        assert [dones.all() for _, _, dones, _ in steps] == [False] * (end - 1) + [True]
        over = end < len(COSTS)
        assert steps[-1][1].tolist() == [-1.0 if over else 1.0] * 2
        info = steps[-1][3][0]
        assert ("budget_exceeded" in info) == over == (not info["TimeLimit.truncated"])


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


@pytest.mark.parametrize(("inside", "outside_first"), [(True, False), (False, True)])
def test_our_batch_and_others_end_and_begin_in_the_same_rows(inside, outside_first):
    """With the monitor inside or outside, episodes and statistics are the same."""

    def wrapped(vec_env):
        wide = {"hazards": {"num": 8, "size": 0.6, "keepout": 0.2}}
        how: dict[str, Any] = {"vec_env": vec_env, "max_episode_steps": 40, "env_kwargs": wide}
        env: Any = make_vec_env(SUITE, 3, seed=5, **how)
        env = env if inside else env.venv
        wraps = [lambda e: VecEarlyTermination(e, 0.02), lambda e: VecRemainingBudget(e, 0.2)]
        for wrap in reversed(wraps) if outside_first else wraps:
            env = wrap(env)
        return env

    native, dummy = wrapped("native"), wrapped("dummy")
    np.testing.assert_array_equal(native.reset(), dummy.reset())
    rng, over = np.random.default_rng(0), 0
    for _ in range(90):
        actions = rng.uniform(-1.0, 1.0, (3, 2)).astype(np.float32)
        ours, theirs = native.step(actions), dummy.step(actions)
        for a, b in zip(ours[:3], theirs[:3], strict=True):
            np.testing.assert_array_equal(a, b)
        for a, b in zip(ours[3], theirs[3], strict=True):
            assert ("budget_exceeded" in a) == ("budget_exceeded" in b)
            over += "budget_exceeded" in a
            if "terminal_observation" in a:
                np.testing.assert_array_equal(a["terminal_observation"], b["terminal_observation"])
                assert not inside or a["episode"]["l"] == b["episode"]["l"] <= 40
    assert over > 0


def test_episodes_that_are_ended_around_monitors_count():
    def plain():
        return sb3_make_vec_env(Scripted, 2, seed=0)

    for env in (
        VecEarlyTermination(plain(), 1.0),
        VecEarlyTermination(make_vec_env(Scripted), 1.0),
    ):
        model = TRPO("MlpPolicy", env, n_steps=32)
        played = evaluate_policy(model, env, 4)
        assert played.lengths.tolist() == [3] * 4 and played.costs.tolist() == [1.5] * 4


def test_it_belongs_inside_what_keeps_statistics_of_episodes():
    costly = sb3_make_vec_env(lambda: CostPoint(20, hazard=(-1.0, 0.0)), 2, seed=0)
    env = VecEarlyTermination(VecNormalize(costly), 0.0)
    env.reset()
    with pytest.raises(ValueError, match=r"VecEarlyTermination.*VecNormalize: it belongs inside"):
        env.step(np.zeros((2, 2), np.float32))


def test_algorithms_learn_behind_them():
    env = VecMaxCost(VecRemainingBudget(make_vec_env(SUITE, 2, seed=0), 5.0))
    model = CPO("MlpPolicy", env, n_steps=20, n_critic_updates=1, cost_keys=("cost_increase",))
    model.learn(80)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda env: VecRemainingBudget(env, 0.0), r"budget ?= ?0\.0"),
        (lambda env: VecRemainingBudget(env, 1.0, unsafe_reward="low"), "unsafe_reward ?= ?'low'"),
        (lambda env: VecEarlyTermination(env, -1.0), r"budget ?= ?-1\.0"),
        (lambda env: play(VecEarlyTermination(env, 1.0, cost_key="fees"), 1), "nearest: 'fee'"),
    ],
)
def test_bad_values_are_named(make, message):
    env = scripted()
    env.reset()
    with pytest.raises(ValueError, match=message):
        make(env)

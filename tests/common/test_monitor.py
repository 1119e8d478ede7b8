"""Episode statistics: sums by hand, the csv, and going on after a stop."""

import os
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_guard.common.monitor import CostMonitor, total_cost


class Scripted(gym.Env):
    """Episodes of a given length; step k pays reward k and costs 0.1 k (and 0.01 k as heat)."""

    def __init__(self, length: int, with_cost: bool = True) -> None:
        self.observation_space = spaces.Box(-1, 1, (1,), np.float32)
        self.action_space = spaces.Discrete(2)
        self.length, self.with_cost, self.k = length, with_cost, 0
        self.shared: dict[str, float] = {}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.k = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.k += 1
        self.shared = {"heat": 0.01 * self.k}
        if self.with_cost:
            self.shared["cost"] = 0.1 * self.k
        over = self.k == self.length
        return np.zeros(1, np.float32), float(self.k), over, False, self.shared


def make(*lengths: int, **kwargs) -> CostMonitor:
    envs = [lambda length=length: Scripted(length) for length in lengths]
    return CostMonitor(DummyVecEnv(envs), **kwargs)


def play(env, steps: int) -> list[dict]:
    """Episodes that end within some steps, in order."""
    ended = []
    for _ in range(steps):
        infos = env.step(np.zeros(env.num_envs, int))[3]
        ended += [info["episode"] for info in infos if "episode" in info]
    return ended


def test_sums_by_hand():
    env = make(2, 3)
    env.reset()
    episodes = play(env, 6)
    # Row 0 ends at steps 2, 4, 6 with 1 + 2; row 1 at 3, 6 with 1 + 2 + 3.
    assert [(one["r"], one["l"]) for one in episodes] == [(3, 2), (6, 3), (3, 2), (3, 2), (6, 3)]
    assert [one["c"] for one in episodes] == pytest.approx([0.3, 0.6, 0.3, 0.3, 0.6])
    assert env.total_cost == pytest.approx(3 * 0.3 + 2 * 0.6)
    assert env.total_steps == 12
    assert env.episode_count == 5


def test_csv_is_read_by_sb3(tmp_path):
    env = make(2, 3, filename=str(tmp_path / "0.monitor.csv"))
    env.reset()
    play(env, 6)
    env.close()
    frame = load_results(str(tmp_path))
    assert frame["c"].tolist() == pytest.approx([0.3, 0.6, 0.3, 0.3, 0.6])
    assert frame["l"].tolist() == [2, 3, 2, 2, 3]


def test_several_costs(tmp_path):
    env = make(3, cost_keys=("cost", "heat"), filename=str(tmp_path / "0.monitor.csv"))
    env.reset()
    (episode,) = play(env, 3)
    assert episode["c"] == episode["c_cost"] == pytest.approx(0.6)
    assert episode["c_heat"] == pytest.approx(0.06)
    env.close()
    assert load_results(str(tmp_path))["c_heat"].tolist() == pytest.approx([0.06])


def test_a_name_alone_is_no_sequence_of_costs():
    with pytest.raises(ValueError, match=r"cost_keys='heat': must be a sequence"):
        make(3, cost_keys="heat")


@pytest.mark.parametrize(
    ("info", "keys", "expected"),
    [
        ({"cost": 2}, ("cost",), 2.0),
        ({"cost": np.array([2.0])}, ("cost",), 2.0),
        ({"cost": np.float32(0.5)}, ("cost",), 0.5),
        ({"cost": True}, ("cost",), 1.0),
        ({}, ("cost",), 0.0),
        ({"a": 1.0, "b": 2.0}, ("a", "b"), 3.0),
        ({"heat": 5.0}, ("cost", "heat"), 0.0),  # a step without one of them
        # The environment's own total wins: costs may overlap.
        ({"cost": 2.5, "a": 1.0, "b": 2.0}, ("a", "b"), 2.5),
    ],
)
def test_total_cost(info, keys, expected):
    assert total_cost(info, keys) == expected


def test_infos_of_the_environment_are_left_alone():
    env = make(1)
    env.reset()
    assert play(env, 1)
    assert "episode" not in env.unwrapped.envs[0].shared


def test_reset_forgets_episodes_under_way_but_not_the_totals():
    env = make(3)
    env.reset()
    play(env, 2)
    env.reset()
    (episode,) = play(env, 3)
    assert episode["c"] == pytest.approx(0.6)
    assert env.total_cost == pytest.approx(0.3 + 0.6)


def test_normalisation_outside_does_not_show():
    env = VecNormalize(make(2))
    env.reset()
    assert [(one["r"], one["c"]) for one in play(env, 2)] == [(3, pytest.approx(0.3))]


def test_continues_from_its_state(tmp_path):
    path = tmp_path / "0.monitor.csv"
    straight = make(4, 7, cost_keys=("cost", "heat"))
    straight.reset()
    expected = play(straight, 20)

    first = make(4, 7, cost_keys=("cost", "heat"), filename=str(path))
    first.reset()
    before = play(first, 9)
    state, length = pickle.loads(pickle.dumps(first.state())), path.stat().st_size
    envs = [pickle.loads(pickle.dumps(env)) for env in first.unwrapped.envs]
    play(first, 5)  # these rows come to nothing
    first.close()

    second = CostMonitor(
        DummyVecEnv([lambda: envs[0], lambda: envs[1]]), cost_keys=("cost", "heat")
    )
    os.truncate(path, length)
    second.log_to(path, append=True)
    second.restore(state)
    after = play(second, 11)
    second.close()

    def numbers(episodes):
        return [{key: value for key, value in one.items() if key != "t"} for one in episodes]

    assert numbers(before + after) == numbers(expected)
    assert load_results(str(tmp_path))["c"].tolist() == [one["c"] for one in expected]
    assert (second.total_cost, second.total_steps) == (straight.total_cost, straight.total_steps)

"""The highest cost of a step and of an episode, as environments state it."""

import math
from dataclasses import dataclass

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from worlds import own_parts, put_point, world

import sb3_guard
from sb3_guard.common.adapters import CostFromFunction
from sb3_guard.common.monitor import highest_costs
from sb3_guard.common.native import GuardVecEnv
from sb3_guard.envs import GuardEnv, GuardVectorEnv, Scenario, env_ids, register_constraint
from sb3_guard.envs.constraints import Hazards
from sb3_guard.envs.part import BOUNDS, Part
from sb3_guard.envs.registry import CONSTRAINTS, ROBOTS, TASKS
from sb3_guard.vector import GymnasiumVecEnv

ALWAYS = {"speed": {"limit": 0.0}}  # a robot that moves pays in each step


def step_bound(robot="Point", task="Goal", cost="sum", **constraints):
    scenario = Scenario(robot=robot, task=task, cost=cost, constraints=constraints)
    return GuardVectorEnv(1, scenario).most_costs["cost"]


@pytest.mark.parametrize("env_id", env_ids())
def test_no_random_step_of_an_id_costs_more_than_it_states(env_id):
    env = GuardVectorEnv(4, env_id, num_threads=1)
    env.reset(seed=0)
    env.action_space.seed(0)
    assert all(math.isfinite(most) for most in env.most_costs.values())
    for _ in range(200):
        info = env.step(env.action_space.sample())[-1]
        reported = {key for key in info if key.startswith("cost")}
        assert reported == env.most_costs.keys()
        assert all((info[key] <= most + 1e-9).all() for key, most in env.most_costs.items())


@pytest.mark.parametrize(
    ("most", "scenario"),
    [
        (0.0, {}),
        (0.3, {"hazards": {"num": 8}}),  # keep-outs of 0.4 m: in one at a time
        (1.6, {"hazards": {"num": 8, "size": 0.5, "keepout": 0.3}}),  # 8 (0.5 - 0.3)
        (1.0, {"hazards": {"num": 2, "size": 0.5, "keepout": 0.3, "locations": [[1, 1], [1, 1]]}}),
        (0.0, {"hazards": {"num": 0}}),
        (1.0, {"hazards": {"num": 8, "size": {"low": 0.1, "high": 0.5}, "weight": 2.0}}),
        (1.0, {"hazards": {"indicator": True}}),
        (1.2, {"ghosts": {"num": 2, "weight": 2.0}}),  # which may meet
        (3.0, {"ghosts": {"num": 3, "solid": True}}),
        (4.5, {"pillars": {"num": 4, "size": 0.1}, "boundary": {"x": 2.0, "y": 0.0},
               "hazards": {"num": 1, "size": 0.5, "weight": -0.0}, "jointspeed": {"weight": 0.0},
               "posts": {"type": "pillars", "num": 1, "weight": -0.5 + 0.0 + 0.0 + 0.0}}),
    ],
)  # fmt: skip
def test_bounds_follow_from_num_size_weight_and_indicator(most, scenario):
    assert step_bound(**scenario) == pytest.approx(most, abs=1e-12)

"""The highest cost of a step and of an episode, as environments state it."""

import math
import re
from dataclasses import dataclass

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from worlds import put_point

from sb3_guard.common.adapters import CostFromFunction
from sb3_guard.common.monitor import highest_costs
from sb3_guard.common.native import GuardVecEnv
from sb3_guard.envs import GuardEnv, GuardVectorEnv, Scenario, env_ids
from sb3_guard.envs.constraints import Buttons, Hazards
from sb3_guard.envs.engine import Engine
from sb3_guard.envs.part import Constraint
from sb3_guard.envs.registry import CONSTRAINTS
from sb3_guard.envs.robots.guard import Arm3, Point
from sb3_guard.envs.tasks.button import Button
from sb3_guard.vector import GymnasiumVecEnv

MOVING = Scenario(constraints={"speed": {"limit": 0.0}})  # a robot that moves pays in each step
EVERY = [  # ids; those of some robots in every test
    pytest.param(i, marks=() if re.search("Point|Arm3|Velocity-v1", i) else pytest.mark.slow)
    for i in env_ids()
]
CROWD = {"num": 8, "size": 0.5, "keepout": 0.3}


def most_costs(constraints, **scenario):
    return GuardVectorEnv(1, Scenario(constraints=constraints, **scenario)).most_costs


@pytest.mark.parametrize("env_id", EVERY)
def test_no_step_of_random_actions_costs_more_than_its_id_states(env_id):
    env = GuardVectorEnv(4, env_id, num_threads=1)
    env.reset(seed=0)
    env.action_space.seed(0)
    most = env.most_costs
    assert all(math.isfinite(cost) for cost in most.values())
    highest = dict.fromkeys(most, 0.0)
    for _ in range(200):
        info = env.step(env.action_space.sample())[-1]
        assert {key for key in info if key.startswith("cost")} == {*most}
        highest = {key: max(cost, *info[key].tolist()) for key, cost in highest.items()}
    assert all(highest[key] <= most[key] + 1e-9 for key in most)


@pytest.mark.parametrize(
    ("most", "constraints"),
    [
        (0.0, {}),
        (0.3, {"hazards": {}}),  # centres are 0.8 m apart: the robot is in one zone at a time
        (1.6, {"hazards": CROWD}),  # 8 (0.5 - 0.3)
        (4.0, {"hazards": {**CROWD, "locations": [[1.0, 1.0], [1.0, 1.0]]}}),
        (0.0, {"hazards": {"num": 0}}),
        (1.0, {"hazards": {"size": {"low": 0.1, "high": 0.5}, "keepout": 0.5, "weight": 2.0}}),
        (1.0, {"hazards": {"indicator": True}}),
        (1.2, {"ghosts": {"num": 2, "weight": 2.0}}),  # which may meet
        (3.0, {"ghosts": {"num": 3, "solid": True, "size": 0.1}}),
        (1.5, {"buttons": {"num": 3, "weight": 0.5}}),
        (math.inf, {"vases": {"num": 2}}),
        (2.0, {"vases": {"num": 2, "velocity_weight": 0.0}}),
        (1.0, {"vases": {"num": 2, "indicator": True}}),
        (6.5, {"pillars": {"num": 2}, "boundary": {}, "baseheight": {"weight": 3.5}}),
    ],
)  # fmt: skip
def test_bounds_follow_from_num_size_weight_and_indicator(most, constraints):
    assert most_costs(constraints)["cost"] == pytest.approx(most, abs=1e-12)


def test_of_any_cost_the_highest_is_one():
    vases = {"num": 2, "separate": True}
    stated = most_costs({"vases": vases, "pillars": {"weight": 0.0}, "hazards": {}}, cost="any")
    names = ("vases_contact", "vases_velocity", "hazards")
    assert stated == {"cost": 1.0, "cost_pillars": 0.0} | {f"cost_{name}": 1.0 for name in names}
    assert most_costs({"pillars": {"weight": 0.0}}, cost="any")["cost"] == 0.0


def test_wrong_buttons_of_the_task_count():
    buttons = {"num": 0, "weight": 2.0}
    assert most_costs({"buttons": buttons}, task="Button")["cost"] == 6.0  # three of four are wrong
    assert most_costs({"buttons": {**buttons, "indicator": True}}, task="Button")["cost"] == 1.0


@pytest.mark.parametrize(("indicator", "most"), [(False, 0.3), (True, 1.0)])
def test_a_robot_that_stays_in_the_middle_of_a_hazard_has_the_highest_cost(indicator, most):
    hazards = {"num": 1, "locations": [[1.0, 1.0]], "indicator": indicator}
    env = GuardVecEnv(Scenario(constraints={"hazards": hazards}), 1, max_episode_steps=20)
    env.reset()
    put_point(env.envs.engine, 1.0, 1.0)
    total, dones = 0.0, [False]
    while not dones[0]:
        _, _, dones, infos = env.step(np.zeros((1, 2)))
        total += infos[0]["cost"]
    assert total == pytest.approx(20 * most) and highest_costs(env)["cost"] == 20 * most


def test_robots_in_many_zones_stay_within_the_bound():
    """Zones as near to each other as keep-outs allow, in a row; the robot in the middle."""
    for size in np.linspace(0.05, 0.6, 12):
        hazards = {"num": 2, "size": size, "keepout": 0.3}
        env = GuardVectorEnv(1, Scenario(constraints={"hazards": hazards}))
        env.reset(seed=0)
        costs = []
        for x in np.linspace(-0.3, 0.3, 25):  # from one centre to the other
            put_point(env.engine, x, 0.0)
            env.engine.places("hazards")[0, :, :2] = [[-0.3, 0.0], [0.3, 0.0]]
            costs.append(env.engine.constraints[0].cost()[0])
        assert max(costs) == pytest.approx(env.most_costs["cost"])


def test_an_arm_is_as_deep_in_a_zone_as_its_thickest_link():
    env = GuardVectorEnv(1, "Goal_Arm3_1Hazards")
    env.reset(seed=0)
    env.engine.places("hazards")[0] = env.engine.robot.position[0]
    assert 0.3 < env.engine.constraints[0].cost()[0] <= env.most_costs["cost"] == 0.5


@pytest.mark.parametrize("kind", ["batch", "vector", "dummy"])
def test_an_episode_reaches_the_highest_cost_and_never_exceeds_it(kind):
    make = {
        "batch": lambda: GuardVecEnv(MOVING, 2, max_episode_steps=30),
        "vector": lambda: GymnasiumVecEnv(GuardVectorEnv(2, MOVING, max_episode_steps=30)),
        "dummy": lambda: DummyVecEnv([lambda: TimeLimit(GuardEnv(MOVING), 30)] * 2),
    }
    env = VecNormalize(make[kind]())
    env.reset()
    env.action_space.seed(0)
    costs, done = np.zeros(2), False
    while not done:
        _, _, dones, infos = env.step(np.array([env.action_space.sample() for _ in range(2)]))
        costs, done = costs + [info["cost"] for info in infos], dones.any()
    assert highest_costs(env) == {"cost": 30.0, "cost_speed": 30.0}
    assert costs.tolist() == [30.0, 30.0]


def test_ids_limit_the_steps_and_without_a_limit_there_is_no_highest_cost():
    made = DummyVecEnv([lambda: gymnasium.make("SafetyPointCircle1-v0")])
    assert highest_costs(made) == highest_costs(GuardVecEnv("SafetyPointCircle1-v0"))
    assert highest_costs(made)["cost"] == 500.0
    endless = DummyVecEnv([lambda: gymnasium.make("SafetyPointCircle1-v0").unwrapped])
    assert highest_costs(endless)["cost"] == math.inf
    longer = DummyVecEnv([lambda: GuardEnv(MOVING), lambda: TimeLimit(GuardEnv(MOVING), 7)])
    assert highest_costs(longer)["cost"] == math.inf
    assert highest_costs(DummyVecEnv([lambda: GuardEnv(Scenario())])) == {"cost": 0.0}
    assert highest_costs(DummyVecEnv([lambda: gymnasium.make("CartPole-v1")])) == {}


def test_nobody_knows_the_highest_cost_of_a_function():
    def cost(*_):
        return 1e6

    wrapped = DummyVecEnv([lambda: TimeLimit(CostFromFunction(GuardEnv(MOVING), cost), 30)])
    batch = GymnasiumVecEnv(GuardVectorEnv(2, MOVING), cost=lambda *_: np.full(2, 1e6))
    assert highest_costs(wrapped) == highest_costs(batch) == {}


def of(constraint, robot=Point, task=Button):
    engine = Engine(robot(), task(), [constraint])
    return engine.constraints[0].most_cost


def test_a_class_with_a_cost_of_its_own_states_its_bound_or_has_none():
    @dataclass
    class Costly(Constraint):
        name = "costly"

        def cost(self):
            return np.ones(self.sim.num_envs)

    class Stated(Costly):
        most_cost = 1.0

    class Deep(Hazards):
        def amounts(self):
            return 10 * super().amounts()

    class Mixin:
        def cost(self):
            return 10 * super().cost()

    class Mixed(Mixin, Hazards):
        pass

    class Wide(Point):
        def clearance(self, points, planar):
            return super().clearance(points, planar) - 1.0

    class Strict(Button):
        def mistakes(self):
            return 10 * super().mistakes()

    assert [of(cls()) for cls in (Costly, Stated, Deep, Mixed)] == [
        math.inf,
        1.0,
        math.inf,
        math.inf,
    ]
    assert of(Hazards(), robot=Wide) == of(Buttons(num=1), task=Strict) == math.inf
    assert of(Hazards(), robot=Arm3) == 4.0 and of(Buttons(num=1)) == 4.0
    assert of(Hazards(weight=0.0), robot=Wide) == 0.0


def test_every_constraint_but_vases_has_a_highest_cost_by_default():
    stated = {
        name: most_costs({name.lower(): {}}, robot="Ant")["cost"]
        for name in CONSTRAINTS
        if CONSTRAINTS[name].__module__.startswith("sb3_guard.")
    }
    assert {name for name, most in stated.items() if most == math.inf} == {"Vases"}

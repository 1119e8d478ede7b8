"""Robots that state their physics, bring a world of their own, or end an episode."""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pytest
from gymnasium.envs import mujoco as their_robots
from worlds import gymnasium_robot, own_parts, world

from sb3_guard.common.native import GuardVecEnv
from sb3_guard.envs import GuardVectorEnv, Scenario, make, register_constraint, register_robot
from sb3_guard.envs.layout import LayoutError
from sb3_guard.envs.part import Constraint, Task
from sb3_guard.envs.registry import TASKS
from sb3_guard.envs.robots.robot import MJCFRobot

ASSETS = Path(their_robots.__file__).parent / "assets"


@dataclass
class Hopper4(MJCFRobot):
    """Gymnasium's Hopper in its own world, stepped as mj_step leaves it."""

    asset = str(ASSETS / "hopper.xml")
    complete = True
    scaled = False
    frame_skip = 4
    stage = mujoco.mjtStage.mjSTAGE_NONE
    root = center = "torso"
    lidar_bodies = ("torso",)

    def terminated(self):
        return self.position[:, 2] < 0.7


@dataclass
class Nothing(Task):
    """A task without a goal."""

    name = "nothing"

    def reward(self, before, now):
        return np.zeros(len(now))


@pytest.fixture
def hopper():
    with own_parts():
        register_robot("Hopper4", Hopper4)
        TASKS["Nothing"] = Nothing
        yield Scenario(robot="Hopper4", task="Nothing", observe={"qpos": True})


def test_a_robot_in_its_own_world_steps_as_in_gymnasium(hopper):
    ours, theirs = hopper.build(3), gymnasium_robot("Hopper-v4")
    theirs.reset(seed=0)
    theirs.set_state(theirs.init_qpos, theirs.init_qvel)
    ours.reset(np.arange(3))
    assert ours.control_step == pytest.approx(theirs.dt)
    space = theirs.action_space
    np.testing.assert_array_equal(ours.robot.action_range, [space.low, space.high])
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1, 1, 3)
        ours.step(np.tile(action, (3, 1)))
        theirs.step(action)
        np.testing.assert_array_equal(ours.batch.qpos[1], theirs.data.qpos)
        np.testing.assert_array_equal(ours.batch.qvel[1], theirs.data.qvel)
        np.testing.assert_array_equal(ours.robot.position[1], theirs.data.body("torso").xpos)


def test_a_robot_that_falls_ends_its_episode(hopper):
    lone, many = make(hopper), GuardVectorEnv(2, hopper)
    stable = GuardVecEnv(hopper, 2)
    for env in (lone, many, stable):
        env.reset()
    many.engine.batch.qpos[1, 1] = stable.envs.engine.batch.qpos[1, 1] = -0.8
    lone.unwrapped.engine.batch.qpos[0, 1] = -0.8
    *_, terminated, truncated, info = lone.step(np.zeros(3))
    assert (terminated, truncated, info["terminated_by"]) == (True, False, "robot")
    *_, terminated, truncated, infos = many.step(np.zeros((2, 3)))
    assert (terminated.tolist(), truncated.any()) == ([False, True], False)
    assert infos["terminated_by"].tolist() == [None, "robot"]
    assert infos["final_info"]["terminated_by"][1] == "robot"
    *_, dones, infos = stable.step(np.zeros((2, 3)))
    assert dones.tolist() == [False, True]
    assert infos[1]["terminated_by"] == "robot" and not infos[1]["TimeLimit.truncated"]
    assert "terminated_by" not in infos[0]
    *_, dones, _ = stable.step(np.zeros((2, 3)))
    assert not dones.any()


def test_a_constraint_may_end_an_episode_but_not_its_start():
    @dataclass
    class Fuse(Constraint):
        """Burns for a few steps."""

        steps: int = 3
        name = "fuse"

        def cost(self):
            return np.zeros(self.sim.num_envs)

        def terminated(self):
            return self.sim.steps >= self.steps

    with own_parts():
        register_constraint("Fuse", Fuse)
        env = make("Goal_Point_1Fuse")
        env.reset()
        ends = [env.step(np.zeros(2))[2] for _ in range(3)]
        assert ends == [False, False, True]
        with pytest.raises(LayoutError, match="fuse: it ends the episode immediately"):
            make("Goal_Point_1Fuse", fuse={"steps": 0}).reset()


def test_a_scenario_may_state_the_physics():
    arena = {"timestep": 0.001, "frame_skip": 5, "integrator": "RK4"}
    engine = world("Goal_Point_8Hazards", arena=arena)
    assert engine.model.opt.timestep == 0.001
    assert engine.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert engine.control_step == pytest.approx(0.005)
    engine.step(np.zeros((1, 2)))
    assert engine.batch.time[0] == pytest.approx(0.005)


@pytest.mark.parametrize("robot", ["Ant", "Arm3", "Drone"])
def test_velocity_is_the_change_of_position(robot):
    engine = world(f"Goal_{robot}_0Hazards", 2, arena={"timestep": 1e-5, "frame_skip": 2})
    rng = np.random.default_rng(0)
    engine.batch.bind("qvel")[:] = rng.normal(size=engine.batch.qvel.shape)
    actions = rng.uniform(-1, 1, (2, engine.robot.action_size))
    engine.step(actions)
    before = engine.robot.position.copy()
    engine.step(actions)
    moved = (engine.robot.position - before) / engine.control_step
    assert np.abs(moved).max() > 0.1
    np.testing.assert_allclose(engine.robot.velocity, moved, atol=0.02 * np.abs(moved).max())

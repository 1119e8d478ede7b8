"""Files that nobody here wrote are robots as they are: from wheels on PyPI, by their own names."""

import runpy
import subprocess
import warnings
from pathlib import Path

import numpy as np
import pytest
from worlds import own_parts

from sb3_guard.envs import Scenario, register_robot
from sb3_guard.envs.check_part import unsteady
from sb3_guard.envs.registry import ROBOTS

SCRIPT = runpy.run_path(str(Path(__file__).parents[2] / "scripts" / "robot_files.py"))
SOURCES = SCRIPT["SOURCES"]
# number of actions, and some of the robot's observations with their sizes
EXPECTED = {
    "Go1": (12, {"joint_pos": 12, "joint_vel": 12, "imu_ang_vel": 3, "last_action": 12}),
    "G1": (29, {"joint_pos": 29, "joint_vel": 29, "imu_upvector": 3, "last_action": 29}),
    "Yam": (8, {"joint_pos": 8, "joint_vel": 8, "last_action": 8}),
    "Quadruped": (12, {"joint_pos": 16, "gravity": 3, "velocimeter": 3, "rf_00": 1}),
    "Jaco": (6, {"joint_pos": 2, "joint_turn": 8, "joint_vel": 6}),
    "ShadowHand": (20, {"joint_vel": 24, "robot0:Sjp_WRJ1": 2}),
    "GymAnt": (8, {"joint_pos": 8, "gravity": 3, "base_linvel": 3, "base_angvel": 3}),
    "GymHalfCheetah": (6, {"joint_pos": 6, "gravity": 3}),
    "GymHopper": (3, {"joint_pos": 3, "gravity": 3}),
    "GymWalker2d": (6, {"joint_pos": 6, "gravity": 3}),
    "GymSwimmer": (2, {"joint_pos": 2, "base_linvel": 3}),
    "GymHumanoid": (17, {"joint_pos": 17, "gravity": 3}),
}


def file(name):
    try:
        return SCRIPT["path"](SOURCES[name])
    except subprocess.CalledProcessError:
        pytest.skip("no package index")


@pytest.mark.parametrize(
    "name",
    [
        name if name in ("GymAnt", "GymHumanoid") else pytest.param(name, marks=pytest.mark.slow)
        for name in SOURCES
    ],
)
def test_a_file_is_a_robot_as_it_is(name):
    path, before = file(name), file(name).read_bytes()
    with own_parts(), warnings.catch_warnings():
        warnings.simplefilter("error")
        register_robot(name, xml=SCRIPT["robot"](SOURCES[name]), **SOURCES[name].needed)
        engine = Scenario.parse(f"Goal_{name}_8Hazards").build(3)
        robot = ROBOTS[name]
        for task in SOURCES[name].tasks.partition(" with ")[0].strip(",").split(", "):
            Scenario(robot=name, task=task).build().reset(np.zeros(1, dtype=int))
    assert path.read_bytes() == before
    actions, observed = EXPECTED[name]
    assert engine.robot.action_size == actions
    sizes = {key: channel.size for key, channel in engine.channels.items()}
    assert sizes | observed == sizes
    engine.reset(np.arange(3))
    model, qpos = engine.model, engine.batch.bind("qpos")
    for joint in np.flatnonzero(model.jnt_limited):
        low, high = model.jnt_range[joint]
        assert low - 1e-9 <= qpos[0, model.jnt_qposadr[joint]] <= high + 1e-9
    assert model.nlight == 1 and model.light(0).name == ""
    rewards = []
    rng = np.random.default_rng(0)
    for _ in range(60):
        outcome = engine.step(rng.uniform(*engine.robot.action_range, (3, actions)))
        rewards.append(outcome.reward)
        assert np.isfinite(outcome.obs).all() and not outcome.physics_error.any()
    assert (np.abs(np.sum(rewards, axis=0)) > 0).all()  # its position moves
    assert unsteady(engine) is None
    assert not any("light" in words for words in robot.model_file().left_out)


@pytest.mark.slow
def test_a_world_with_two_robots_asks_which():
    with pytest.raises(ValueError, match=r"'torso', 'ball': say which is the robot, root='torso'"):
        register_robot("Quadruped", xml=file("Quadruped"))

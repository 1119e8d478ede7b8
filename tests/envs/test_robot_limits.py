"""Limits of the robot itself cost what a computation on MjData says, row by row."""

import mujoco
import numpy as np
import pytest
from worlds import assert_rows_are_lone_environments, world

from sb3_guard.envs import Scenario
from sb3_guard.envs.layout import LayoutError
from sb3_guard.envs.registry import CONSTRAINTS

LIMITS = [name for name, cls in CONSTRAINTS.items() if cls.family == "robot"]


def limited(robot, n, **limits):
    """A robot and nothing but its limits."""
    return world(f"Goal_{robot}_0Hazards", n, hazards=None, **limits)


def test_a_step_of_a_cost_is_told_in_words_and_units():
    limits = {"jointtorque": {"limit": 0.5}, "baseheight": {"low": 0.05, "weight": 3.0}}
    engine = world("Goal_Ant_8Hazards", 1, **limits, hazards={"indicator": True})
    step = "in each step at whose end"
    assert {part.name: part.per_step() for part in engine.constraints} == {
        "hazards": "Cost 1 in a step with any.",
        "jointtorque": f"Cost 1.0 {step} actuators exert over 0.5 N m on a joint.",
        "baseheight": f"Cost 3.0 {step} its position is below 0.05 or above high m.",
    }


def hinges(model):
    """The robot's hinges but those of its outermost body."""
    root = model.body("robot/robot").id
    kinds, bodies = model.jnt_type, model.jnt_bodyid
    return [j for j in range(model.njnt) if kinds[j] == 3 and bodies[j] != root]


def amount(data, model, name):
    """The greatest of what is limited of the joints, one by one."""
    most = 0.0
    for joint in hinges(model):
        dof = model.jnt_dofadr[joint]
        if name == "jointspeed":
            most = max(most, abs(data.qvel[dof]))
        elif name == "jointtorque":
            most = max(most, abs(data.qfrc_actuator[dof]))
        elif model.jnt_limited[joint]:
            low, high = model.jnt_range[joint]
            place = data.qpos[model.jnt_qposadr[joint]]
            most = max(most, abs(place - (low + high) / 2) / ((high - low) / 2))
    return most


@pytest.mark.parametrize("robot", ["Ant", "Arm3"])
@pytest.mark.parametrize("name", ["jointlimits", "jointspeed", "jointtorque"])
def test_a_joint_beyond_the_limit_costs(robot, name):
    if (robot, name) == ("Arm3", "jointlimits"):
        return  # its hinges have no ranges
    free = 1.0 if name == "jointlimits" else 1e9
    engine = limited(robot, 6, **{name: {"limit": free}})
    rng = np.random.default_rng(3)
    for _ in range(25):
        engine.step(rng.uniform(-1, 1, (6, engine.robot.action_size)))
    expected = [amount(engine.batch.get_data(row), engine.model, name) for row in range(6)]
    (limit,) = engine.constraints
    np.testing.assert_allclose(limit.amount(), expected)
    limit.limit = float(np.median(expected))
    np.testing.assert_array_equal(limit.cost(), expected > np.median(expected))
    assert 0 < limit.cost().sum() < 6


def test_chosen_joints_alone_count():
    engine = limited("Ant", 2, jointspeed={"joints": ["hip_*"], "limit": 1.0})
    (limit,) = engine.constraints
    speeds = engine.batch.bind("qvel")
    speeds[:] = 0.0
    model = engine.model
    speeds[0, model.joint("robot/ankle_1").dofadr] = 5.0
    speeds[1, model.joint("robot/hip_3").dofadr] = -5.0
    np.testing.assert_array_equal(limit.cost(), [0, 1])
    point = limited("Point", 1, jointspeed={"joints": ["z"]})
    assert point.constraints[0].amounts().shape == (1, 1)


def test_weights_multiply_the_cost():
    engine = limited("Ant", 1, jointspeed={"weight": 2.5, "limit": 1.0})
    engine.batch.bind("qvel")[:, -1] = 3.0
    assert engine.constraints[0].cost().tolist() == [2.5]


@pytest.mark.parametrize("robot", ["Ant", "Drone"])
def test_tilt_is_the_angle_from_how_it_stands(robot):
    engine = limited(robot, 4, basetilt={"limit": 0.5})
    (tilt,) = engine.constraints
    np.testing.assert_allclose(tilt.amount(), 0.0, atol=1e-6)
    first = int(engine.model.jnt_qposadr[engine.model.body("robot/robot").jntadr[0]])
    qpos = engine.batch.bind("qpos")
    angles = [0.3, 0.6, -0.6, 3.0]
    for row, angle in enumerate(angles):  # around some horizontal axis, after any turn of the body
        axis = [np.cos(row), np.sin(row), 0]
        lean, turn = np.zeros(4), qpos[row, first + 3 : first + 7].copy()
        mujoco.mju_axisAngle2Quat(lean, axis, angle)
        mujoco.mju_mulQuat(qpos[row, first + 3 : first + 7], lean, turn)
    engine.batch.forward()
    np.testing.assert_allclose(tilt.amount(), np.abs(angles), atol=1e-6)
    np.testing.assert_array_equal(tilt.cost(), [0, 1, 1, 1])


def test_height_has_two_ends():
    engine = limited("Ant", 3, baseheight={"low": 0.1, "high": 0.5})
    qpos = engine.batch.bind("qpos")
    qpos[:, 2] = [0.05, 0.3, 0.6]
    engine.batch.forward()
    np.testing.assert_array_equal(engine.constraints[0].cost(), [1, 0, 1])
    usual = limited("Ant", 2, baseheight={})
    start = usual.robot.position[0, 2]
    usual.batch.bind("qpos")[:, 2] = [0.49 * start, 0.51 * start]
    usual.batch.forward()
    np.testing.assert_array_equal(usual.constraints[0].cost(), [1, 0])


def forces(engine, row):
    """The data of a row with the forces of its contacts."""
    data = engine.batch.get_data(row)
    mujoco.mj_forward(engine.model, data)
    return data


def summed(data, model, body):
    """The net force of the floor on a body, N."""
    total = np.zeros(3)
    for i, contact in enumerate(data.contact):
        if {int(model.geom_bodyid[geom]) for geom in contact.geom} == {0, body}:
            force = np.zeros(6)
            mujoco.mj_contactForce(model, data, i, force)
            total += contact.frame.reshape(3, 3).T @ force[:3]
    return np.linalg.norm(total)


def test_floor_contact_is_the_net_force_on_a_body():
    engine = limited("Ant", 2, floorcontact={"bodies": ["*"], "limit": 1e9})
    (limit,) = engine.constraints
    for _ in range(5):
        engine.step(np.zeros((2, 8)))
    engine.batch.bind("qpos")[1, 2] = 1.0
    engine.batch.forward()
    data, model = forces(engine, 0), engine.model
    expected = [summed(data, model, body) for body in engine.robot.bodies(model)]
    assert max(expected) > 0.01
    np.testing.assert_allclose(limit.amount(), [max(expected), 0.0], rtol=1e-6)
    limit.limit = 0.01
    np.testing.assert_array_equal(limit.cost(), [1, 0])
    outermost = limited("Ant", 2, floorcontact={"limit": 0.0})  # stands on its feet alone
    assert not outermost.constraints[0].amount().any()
    with pytest.raises(LayoutError, match="floorcontact: a cost at the start"):
        limited("Ant", 1, floorcontact={"bodies": ["*"], "limit": 0.0})


def test_self_collision_is_the_largest_force_between_its_bodies():
    engine = limited("Ant", 8, selfcollision={"limit": 0.0})
    model, qpos = engine.model, engine.batch.bind("qpos")
    rng = np.random.default_rng(0)
    for joint in hinges(model):  # far out of their ranges, so that legs meet
        qpos[:, model.jnt_qposadr[joint]] = rng.uniform(-3, 3, 8)
    qpos[:, 2] = 5.0
    engine.batch.forward()
    (limit,) = engine.constraints
    expected = np.zeros(8)
    for row in range(8):
        data = forces(engine, row)
        for i in range(data.ncon):
            force = np.zeros(6)
            mujoco.mj_contactForce(model, data, i, force)
            expected[row] = max(expected[row], np.linalg.norm(force[:3]))
    np.testing.assert_allclose(limit.amount(), expected, rtol=1e-6)
    limit.limit = float(np.median(expected))
    np.testing.assert_array_equal(limit.cost(), expected > np.median(expected))
    assert 0 < limit.cost().sum() < 8


@pytest.mark.parametrize("name", LIMITS)
def test_rows_are_lone_environments(name):
    assert_rows_are_lone_environments(f"Goal_Ant_1{name}")


@pytest.mark.parametrize(
    ("robot", "limits", "message"),
    [
        ("Point", {"jointspeed": {}}, r"no hinges except those .* allowed: x, y, z"),
        ("Point", {"jointlimits": {}}, r"no hinges with a range .* allowed: none"),
        ("Ant", {"jointspeed": {"joints": ["hop_1"]}}, r"'hop_1': did you mean 'hip_1'"),
        ("Ant", {"floorcontact": {"bodies": ["foot"]}}, "floorcontact.bodies matches no name 'foo"),
        ("Ant", {"baseheight": {"low": 2, "high": 1}}, r"low = 2 must be less than high = 1, m"),
    ],
)
def test_limits_that_a_robot_cannot_have_are_answered_in_a_line(robot, limits, message):
    with pytest.raises(ValueError, match=message) as caught:
        Scenario(robot=robot).override(**limits).build()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["baseheight", "basetilt"])
def test_an_episode_may_end_beyond_the_limit(name):
    engine = limited("Ant", 2, **{name: {"ends": True}})
    assert not engine.step(np.zeros((2, 8))).terminated.any()
    engine.batch.bind("qpos")[1, :7] = [0, 0, 0.04, 0, 1, 0, 0]  # on its back, in the floor
    outcome = engine.step(np.zeros((2, 8)))
    assert outcome.terminated.tolist() == [False, True]
    assert outcome.ended_by[name].tolist() == [False, True]
    assert outcome.costs[f"cost_{name}"].tolist() == [0.0, 1.0]


def test_a_picture_says_how_near_the_limit_is():
    engine = limited("Ant", 1, **{name.lower(): {} for name in LIMITS})
    words = {k: v for part in engine.constraints for k, v in part.words(0).items()}
    assert len(words) == len(LIMITS)
    assert words["basetilt"] == "0.00 rad, limit 0.5"

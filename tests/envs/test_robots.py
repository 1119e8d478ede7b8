"""Every robot has the sizes of the paper, stands still when left alone, and moves when driven."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pytest

from sb3_guard.envs.engine import Engine
from sb3_guard.envs.scenario import Scenario
from sb3_guard.envs.types import FLOOR


class Facts(NamedTuple):
    actions: int
    observation: int  # on Goal_<robot>_8Hazards
    mass: float  # kg
    timestep: float  # s


FACTS = {
    "Point": Facts(2, 30, 0.00519, 0.002),
    "Car": Facts(2, 42, 0.0304, 0.004),
    "Doggo": Facts(12, 74, 0.0397, 0.01),
    "Swimmer": Facts(2, 40, 0.666, 0.02),
    "Ant": Facts(8, 62, 0.01364, 0.02),
    "Walker": Facts(10, 62, 1.557, 0.005),
    "Humanoid": Facts(6, 50, 42.1, 0.003),
    "Hopper": Facts(5, 46, 12.27, 0.005),
    "Arm3": Facts(3, 259, 2.4e-3, 0.002),
    "Arm6": Facts(6, 355, 2.6e-3, 0.002),
    "Drone": Facts(4, 83, 0.01052, 0.008),
}
ARMS = ("Arm3", "Arm6")
WALKERS = ("Doggo", "Swimmer", "Ant", "Walker", "Humanoid", "Hopper")
STANDING = (*WALKERS, "Car")  # robots that begin on the floor
MARGIN = {"Swimmer": 0.01, "Ant": 0.01, "Humanoid": 0.001, "Hopper": 0.001}  # m, of contacts


def world(robot: str, num_envs: int = 1, **robot_params: Any) -> Engine:
    """A robot at the origin that faces along x, begun, with nothing to avoid."""
    scenario = Scenario(
        robot=robot,
        robot_params={"heading": 0.0, "locations": [[0.0, 0.0]], **robot_params},
        task_params={"locations": [[1.2, 1.2]]},
    )
    engine = scenario.build(num_envs, num_threads=1)
    for row in range(num_envs):
        engine.seed(row, np.random.default_rng(row))
    engine.reset(np.arange(num_envs))
    return engine


def drive(engine: Engine, action: Any, steps: int) -> np.ndarray:
    """Apply one action for a while; the last observation of row 0."""
    actions = np.broadcast_to(
        np.asarray(action, float), (engine.num_envs, engine.robot.action_size)
    )
    for _ in range(steps):
        out = engine.step(actions)
        assert not out.physics_error.any()
    return out.obs[0]


def look(engine: Engine, obs: np.ndarray, name: str) -> np.ndarray:
    """One named component of an observation."""
    return obs[engine.observation_layout[name]]


def floor_gap(engine: Engine) -> float:
    """Smallest distance of a geom that may touch the floor from the floor, m."""
    model, data = engine.model, engine.batch.get_data(0)
    floor = model.geom("floor").id
    return min(
        mujoco.mj_geomDistance(model, data, floor, g, 1.0, None)
        for g in range(model.ngeom)
        if g != floor and model.geom_conaffinity[g] & FLOOR
    )


def deepest(engine: Engine) -> float:
    """The deepest contact of row 0, m, negative inside."""
    return min((c.dist for c in engine.batch.get_data(0).contact), default=0.0)


@pytest.mark.parametrize("robot", FACTS)
def test_sizes_mass_and_time_step(robot: str) -> None:
    engine = Scenario.parse(f"Goal_{robot}_8Hazards").build()
    facts = FACTS[robot]
    assert engine.robot.action_size == facts.actions
    assert engine.observer.size == facts.observation
    assert engine.model.opt.timestep == facts.timestep
    assert list(engine.model.opt.gravity) == [0, 0, -9.81]
    body = engine.model.body("robot/robot").id
    assert engine.model.body_subtreemass[body] == pytest.approx(facts.mass, rel=0.02)


@pytest.mark.parametrize(
    "robot, slices",
    [
        (
            "Swimmer",
            "accelerometer 0:3, goal_compass 3:5, gyro 5:8, hazards_lidar 8:24, "
            "jointpos_motor1_rot 24:26, jointpos_motor2_rot 26:28, jointvel_motor1_rot 28:29, "
            "magnetometer 30:33, touch_point1 33:34, touch_point4 36:37, velocimeter 37:40",
        ),
        (
            "Arm3",
            "accelerometer_link_1 0:3, accelerometer_link_5 12:15, goal_compass 15:24, "
            "gyro_link_1 24:27, hazards_lidar 39:219, jointpos_joint_1 219:221, "
            "jointvel_joint_3 227:228, magnetometer_link_1 228:231, touch_end_effector 243:244, "
            "velocimeter_link_5 256:259",
        ),
    ],
)
def test_places_in_the_observation(robot: str, slices: str) -> None:
    layout = Scenario.parse(f"Goal_{robot}_8Hazards").build().observation_layout
    for item in slices.split(", "):
        name, where = item.split()
        start, stop = map(int, where.split(":"))
        assert layout[name] == slice(start, stop), name


@pytest.mark.parametrize("robot", FACTS)
def test_starts_on_the_floor_within_its_limits(robot: str) -> None:
    engine = world(robot)
    model, data = engine.model, engine.batch.get_data(0)
    if robot in STANDING:  # feet just touch
        assert -1e-6 < floor_gap(engine) < MARGIN.get(robot, 0.0) + 2e-4
    elif robot != "Point":  # a Point hovers forever, whatever its box's distance
        assert floor_gap(engine) > 0.05
    assert deepest(engine) > -1e-6  # nor do its parts overlap
    for j in range(model.njnt):
        if model.jnt_limited[j]:
            low, high = model.jnt_range[j]
            assert low <= data.qpos[model.jnt_qposadr[j]] <= high, model.joint(j).name


@pytest.mark.parametrize("robot", FACTS)
def test_rests_where_it_is(robot: str) -> None:
    engine = world(robot)
    start = engine.robot.position[0].copy()
    drive(engine, 0.0, 300)
    # an ant's ankles are damped, not sprung: it sinks slowly, upright and on the spot
    sink = 0.04 if robot == "Ant" else 3e-3
    assert np.abs(engine.robot.position[0] - start)[:2].max() < 3e-3
    assert abs(engine.robot.position[0, 2] - start[2]) < sink
    assert np.abs(engine.batch.get_data(0).qvel).max() < 5e-3
    assert deepest(engine) > -1e-3


@pytest.mark.parametrize("robot", FACTS)
def test_survives_random_actions(robot: str) -> None:
    num = 4
    engine = Scenario.parse(f"Goal_{robot}_8Hazards").build(num, num_threads=1)
    for row in range(num):
        engine.seed(row, np.random.default_rng(row))
    engine.reset(np.arange(num))
    rng = np.random.default_rng(0)
    for t in range(200):
        if t < 100:
            actions = rng.uniform(-1, 1, (num, engine.robot.action_size))
        elif t % 50 == 0:  # held at full strength, into the joints' limits and the floor
            actions = np.sign(rng.normal(size=(num, engine.robot.action_size)))
        out = engine.step(actions)
        assert np.isfinite(out.obs).all() and np.isfinite(out.reward).all()
        assert not out.physics_error.any()
    assert deepest(engine) > -0.1


class Gait(NamedTuple):
    """Control-step t applies offset + amplitude · sin(2π (t / period + phase))."""

    distance: float  # m to cover
    steps: int
    period: float  # control steps
    amplitude: list[float]
    phase: list[float] | float = 0.0
    offset: list[float] | float = 0.0


GAITS = {
    # a wave from head to tail
    "Swimmer": Gait(2.0, 500, 6, [0.7, 0.7], [0.0, -0.25]),
    # trot: diagonal legs together; hip and ankle of each leg in turn
    "Ant": Gait(1.0, 200, 8, [-1, 1, 1, 1, 1, -1, -1, -1], [0, 0.75] * 4),
    # steps: one leg swings while the other pushes
    "Walker": Gait(1.0, 200, 16, [0, 0, 1, -1, 1, 0, 0, -1, 1, -1], 0.25),
    "Humanoid": Gait(1.0, 200, 20, [0, -1, -1, 0, 1, 1], [0, 0.25, 0.25, 0, 0.25, 0.25]),
    "Hopper": Gait(1.0, 200, 20, [0, 0, 1, -1, -1], [0, 0, 0, 0, 0.25], [0, 0, 0, 0.5, 0]),
    # bound: front legs together, rear legs half a period later
    "Doggo": Gait(1.0, 500, 3, [0] * 4 + [1, -1, -1, 1, -1, 1, 1, -1]),
}


@pytest.mark.parametrize("robot", GAITS)
def test_gait_covers_ground(robot: str) -> None:
    engine, gait = world(robot), GAITS[robot]
    felt = np.zeros(engine.observer.size)
    for t in range(gait.steps):
        turn = 2 * math.pi * (t / gait.period + np.asarray(gait.phase, float))
        action = np.asarray(gait.offset) + np.asarray(gait.amplitude) * np.sin(turn)
        out = engine.step(action[None])
        assert not out.physics_error.any()
        felt = np.maximum(felt, out.obs[0])
    assert np.hypot(*engine.robot.position[0, :2]) >= gait.distance
    for name in engine.observation_layout:  # a Doggo's knees (a) stay off the floor
        if name.startswith("touch") and not (robot == "Doggo" and name.endswith("a")):
            assert look(engine, felt, name) > 0, name


def test_point_thrusts_along_its_nose_and_turns_on_the_spot() -> None:
    """F = 0.015 N against a drag of 0.01 N·s/m: x(t) = v (t − τ (1 − e^(−t/τ))), v = 1.5 m/s."""
    engine = world("Point")
    drive(engine, [1, 0], 75)
    t, tau = 75 * 10 * FACTS["Point"].timestep, FACTS["Point"].mass / 0.01
    reached = 1.5 * (t - tau * (1 - math.exp(-t / tau)))
    assert reached > 1.0
    x, y, _ = engine.robot.position[0]
    assert x == pytest.approx(reached, rel=0.01) and abs(y) < 1e-6
    engine = world("Point")
    gyro = look(engine, drive(engine, [0, 1], 150), "gyro")  # to the left
    np.testing.assert_allclose(gyro, [0, 0, 3.0], atol=0.03)  # 0.015 N·m over 0.005 N·m·s
    assert np.abs(engine.robot.position[0, :2]).max() < 0.03  # its middle is beside its mass
    gyro = look(engine, drive(engine, [0, -1], 150), "gyro")
    np.testing.assert_allclose(gyro, [0, 0, -3.0], atol=0.03)
    gyro = look(engine, drive(engine, 0.0, 10), "gyro")
    assert abs(gyro[2]) < 0.5  # the servo brakes; under Euler it chatters at 0.48 rad/s, as GUARD's
    nose, start = engine.robot.frames[1][0, 0, :2, 0].copy(), engine.robot.position[0, :2].copy()
    drive(engine, [1, 0], 75)
    moved = engine.robot.position[0, :2] - start
    assert np.hypot(*moved) > 1.0 and moved @ nose > 0.999 * np.hypot(*moved)


def test_car_drives_along_its_nose_and_turns_on_the_spot() -> None:
    engine = world("Car")
    drive(engine, [1, 1], 50)
    x, y, _ = engine.robot.position[0]
    assert y > 1.0 and abs(x) < 0.05  # the nose points along y
    engine = world("Car")
    drive(engine, [1, -1], 50)
    rotation = engine.robot.frames[1][0, 0]
    assert rotation[2, 2] > 0.99
    engine = world("Car")
    turned = look(engine, drive(engine, [1, -1], 5), "gyro")
    assert turned[2] < -0.5  # the left wheel ahead turns it to the right
    ball = look(engine, drive(engine, [1, 1], 20), "ballquat_rear").reshape(3, 3)
    np.testing.assert_allclose(ball @ ball.T, np.eye(3), atol=1e-5)
    assert not np.allclose(ball, np.eye(3), atol=0.1)  # the ball rolls along


def test_start_attitude_turns_with_the_heading() -> None:
    # Doggo stands with its head a little up: the turn about the vertical must come on top of it
    ahead, aside = world("Doggo"), world("Doggo", heading=math.pi / 2)
    a, b = ahead.robot.frames[1][0, 0], aside.robot.frames[1][0, 0]
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert a[2, 0] > 0.01
    np.testing.assert_allclose(b, turn @ a, atol=1e-9)


def angles(engine: Engine) -> np.ndarray:
    return engine.batch.bind("qpos")[0].copy()


def tip(robot: str, q: np.ndarray) -> np.ndarray:
    """Place of an arm's end effector by its own chain of rotations, m."""

    def turn(axis: int, angle: float) -> np.ndarray:
        c, s = math.cos(angle), math.sin(angle)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        r = np.eye(3)
        r[i, i] = r[j, j] = c
        r[j, i], r[i, j] = s, -s
        return r

    x, y, z = 0, 1, 2
    upper = turn(z, q[0]) @ turn(x, q[1])
    lower = upper @ turn(x, q[2])
    elbow = np.array([0, 0, 0.3]) + upper @ [0, 0, 1.5]
    if robot == "Arm3":
        return elbow + lower @ [0, 1, 0]
    wrist = lower @ turn(y, q[3])
    return elbow + wrist @ [0, 1, 0] + wrist @ turn(x, q[4]) @ [0, 0.5, 0]


@pytest.mark.parametrize("robot, speed", [("Arm3", 0.6), ("Arm6", 0.4)])
def test_arm_turns_at_the_commanded_speed_and_reaches(robot: str, speed: float) -> None:
    engine = world(robot)
    np.testing.assert_allclose(engine.robot.position[0], tip(robot, angles(engine)), atol=1e-12)
    sign = np.array([1, -1, 1, -1, 1, -1])[: engine.robot.action_size]
    obs = drive(engine, sign, 1)
    for k, s in enumerate(sign, start=1):
        assert look(engine, obs, f"jointvel_joint_{k}")[0] == pytest.approx(s * speed, rel=2e-3)
    drive(engine, 0.5 * sign, 99)
    turned = speed * 0.02 * (1 + 0.5 * 99)
    np.testing.assert_allclose(angles(engine), sign * turned, atol=2e-3)
    np.testing.assert_allclose(engine.robot.position[0], tip(robot, angles(engine)), atol=1e-9)
    # a commanded pose: joint angles turned one by one, at full speed
    goal = np.array([0.5, -0.6, -0.4, 0.3, 0.7, -0.2])[: engine.robot.action_size]
    for _ in range(400):
        engine.step(np.clip((goal - angles(engine)) / (speed * 0.02), -1, 1)[None])
    np.testing.assert_allclose(engine.robot.position[0], tip(robot, goal), atol=1e-3)


@pytest.mark.parametrize("robot", ARMS)
def test_resting_arm_reads_gravity(robot: str) -> None:
    engine = world(robot)
    obs = drive(engine, 0.0, 20)
    assert np.abs(angles(engine)).max() < 1e-12  # its weight would turn the shoulder by 1e-6
    for link in engine.robot.links:
        reading = look(engine, obs, f"accelerometer_{link}")
        np.testing.assert_allclose(reading, [0, 0, 9.81], atol=1e-3)


@pytest.mark.parametrize("robot", ARMS)
def test_floor_stops_an_arm_and_is_felt(robot: str) -> None:
    engine = world(robot)
    # tip over forwards, elbow straight: the end effector meets the floor
    lean = np.zeros(engine.robot.action_size)
    lean[1], lean[2] = -1.0, -0.5
    felt = 0.0
    for _ in range(400):
        obs = engine.step(lean[None]).obs[0]
        felt = max(felt, float(look(engine, obs, "touch_end_effector")[0]))
    assert engine.batch.get_data(0).ncon > 0
    assert deepest(engine) > -0.03
    assert felt > 0


@pytest.mark.parametrize("robot", ARMS)
@pytest.mark.parametrize("planar", [False, True])
def test_arm_clearance_is_the_distance_of_its_surface(robot: str, planar: bool) -> None:
    engine = world(robot, 3)
    rng = np.random.default_rng(0)
    for _ in range(60):
        engine.step(rng.uniform(-1, 1, (3, engine.robot.action_size)))
    points = rng.uniform([-2, -2, 0], [2, 2, 2.5], (3, 7, 3))
    found = engine.robot.clearance(points, planar)
    model = engine.model
    flat = np.array([1, 1, 0]) if planar else np.ones(3)
    for row in range(3):
        data = engine.batch.get_data(row)
        for k, point in enumerate(points[row]):
            nearest = math.inf
            for link in engine.robot.links:
                geom = model.geom(f"robot/{link}").id
                radius, half = model.geom_size[geom, 0], model.geom_size[geom, 1]
                if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
                    half = 0.0
                axis = data.geom_xmat[geom].reshape(3, 3)[:, 2]
                ends = [(data.geom_xpos[geom] + s * half * axis) * flat for s in (-1, 1)]
                samples = np.linspace(*ends, 2001)
                gap = np.linalg.norm(samples - point * flat, axis=1).min() - radius
                nearest = min(nearest, gap)
            assert found[row, k] == pytest.approx(nearest, abs=2e-3)


def test_drone_hovers_climbs_and_translates() -> None:
    engine = world("Drone")
    start = engine.robot.position[0].copy()
    np.testing.assert_allclose(start, [0, 0, 1])
    for _ in range(1000):
        engine.step(np.zeros((1, 4)))
        assert np.linalg.norm(engine.robot.position[0] - start) < 0.05
    drive(engine, 1.0, 50)
    assert engine.robot.position[0, 2] > 4
    speed = look(engine, drive(engine, 1.0, 100), "velocimeter")
    np.testing.assert_allclose(speed, [0, 0, 2.0], atol=0.02)  # 0.4 N against a drag of 0.2 N·s/m
    high = engine.robot.position[0].copy()
    drive(engine, 0.0, 1)
    drive(engine, [-1, 0, 1, 0], 10)  # less lift ahead: the nose sinks
    drive(engine, 0.3, 200)
    moved = engine.robot.position[0] - high
    assert moved[0] > 1.0 and abs(moved[1]) < 0.05

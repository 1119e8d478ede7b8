"""An MJCF file is a robot as its maker wrote it: pose, servos, observations, place."""

import mujoco
import numpy as np
import pytest
from robot_models import ARM, DOG
from worlds import assert_rows_are_lone_environments, own_parts

from sb3_guard.envs import Scenario, register_robot
from sb3_guard.envs.components import components
from sb3_guard.envs.registry import ROBOTS

ROW = np.zeros(1, dtype=int)
GAINS = {"kp": 40.0, "kd": 2.0}
# qpos of the ball and of the dog, whose file lists them in this order
KEY = '<key name="{name}" qpos="2 0 1 1 0 0 0  3 1 {z} 1 0 0 0  {thigh} -1 0.2 0"/>'


@pytest.fixture
def dog(tmp_path):
    def write(change=lambda text: text, keys="", **attributes):
        path = tmp_path / "dog.xml"
        path.write_text(change(DOG.format(keys=keys)))
        attributes = {"root": "trunk", "actuators": GAINS} | attributes
        register_robot("Dog", xml=path, **attributes)
        heading = {} if attributes.get("complete") else {"heading": 0.0}
        engine = Scenario.parse("Goal_Dog_2Hazards").override(robot=heading).build(2)
        for row in range(2):
            engine.seed(row, np.random.default_rng(row))
        engine.reset(np.arange(2))
        return engine

    with own_parts():
        yield write


def qpos(engine, joint):
    return engine.batch.bind("qpos")[0, engine.model.joint(f"robot/{joint}").qposadr[0]]


def test_a_joint_starts_at_0_or_in_the_middle_of_its_range_and_feet_on_the_floor(dog):
    engine = dog()
    assert qpos(engine, "front_thigh") == 0.0
    assert qpos(engine, "front_calf") == pytest.approx(np.deg2rad(-90))
    data = engine.batch.get_data(0)
    # the thigh hangs down, the calf is level behind it: the knee is lowest
    assert data.body("robot/front_calf").xpos[2] == pytest.approx(0.03, abs=1e-3)
    assert engine.robot.altitude == pytest.approx(0.23, abs=1e-3)


def test_a_pose_sets_joints_by_patterns_and_the_height_follows(dog):
    engine = dog(pose={"*_thigh": 0.5, "back_thigh": 0.0, "front_calf": -0.6})
    values = [qpos(engine, name) for name in ("front_thigh", "back_thigh", "front_calf")]
    assert values == [0.5, 0.0, -0.6]
    data = engine.batch.get_data(0)
    # by hand: the ends of the two legs' capsules
    foot = data.body("robot/front_calf").xpos[2] - 0.2 * np.cos(0.1) - 0.02
    knee = data.body("robot/back").xpos[2] - 0.2 - 0.03
    assert min(foot, knee) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("names", "stated", "start"),
    [
        (["crouch"], {}, "crouch"),
        (["crouch", "home"], {}, "home"),
        (["home", "crouch", "start"], {}, "start"),
        (["home", "crouch"], {"keyframe": "crouch"}, "crouch"),
        (["a", "b"], {}, None),
    ],
)
def test_a_keyframe_is_where_it_starts(dog, names, stated, start):
    thighs = {name: 0.1 + 0.1 * i for i, name in enumerate(names)}
    keys = "".join(KEY.format(name=n, z=0.7, thigh=thigh) for n, thigh in thighs.items())
    engine = dog(keys=keys, **stated)
    assert qpos(engine, "front_thigh") == pytest.approx(thighs.get(start, 0.0))
    assert qpos(engine, "back_thigh") == pytest.approx(0.2 if start else 0.0)
    height = engine.robot.position[0, 2]
    assert (height == pytest.approx(0.7)) == (start is not None)


@pytest.mark.parametrize(("z", "bottom"), [(0.7, None), (-3.0, 0.0)])
def test_a_keyframe_never_puts_a_robot_into_the_floor(dog, z, bottom):
    engine = dog(keys=KEY.format(name="home", z=z, thigh=0.0))
    data = engine.batch.get_data(0)
    # of the legs' capsules the hind one is lower: its thigh leans by 0.2 rad
    low = min(
        data.body("robot/back").xpos[2] - 0.2 * np.cos(0.2) - 0.03,
        data.body("robot/front_calf").xpos[2] - 0.03,
        data.body("robot/front_calf").xpos[2] - 0.2 * np.cos(1.0) - 0.02,
    )
    height = engine.robot.position[0, 2]
    assert (low if bottom == 0.0 else height - 0.7) == pytest.approx(0.0, abs=1e-3)


def test_a_pose_changes_joints_of_a_keyframe(dog):
    engine = dog(keys=KEY.format(name="home", z=0.7, thigh=0.3), pose={"front_thigh": 0.4})
    assert (qpos(engine, "front_thigh"), qpos(engine, "back_thigh")) == (0.4, 0.2)


def test_the_only_keyframe_needs_no_name(dog):
    engine = dog(keys=KEY.format(name="", z=0.7, thigh=0.3))
    assert qpos(engine, "front_thigh") == 0.3


def test_keyframes_that_are_not_taken_are_left_out(dog):
    dog(keys="".join(KEY.format(name=name, z=0.7, thigh=0.3) for name in ("a", "b")))
    assert ROBOTS["Dog"].file.left_out[:2] == ("keyframe a", "keyframe b")


def test_what_refers_to_the_world_is_left_out(dog):
    referring = """<site name="mark"/></worldbody>
      <contact><pair geom1="ground" geom2="front_foot"/></contact>
      <equality><connect name="leash" site1="mark" site2="imu"/></equality>
      <sensor><distance name="gap" geom1="ground" geom2="front_foot" cutoff="1"/></sensor>"""
    engine = dog(lambda text: text.replace("</worldbody>", referring))
    assert "gap" not in engine.observation_layout
    assert (engine.model.neq, engine.model.npair) == (0, 0)
    left_out = {"geom ground", "site mark", "sensor gap", "equality leash"}
    assert left_out <= {*ROBOTS["Dog"].file.left_out}


def test_tendons_and_actuators_to_places_of_the_world_are_left_out(dog):
    referring = """<site name="mark"/></worldbody>
      <tendon>
        <spatial name="leash" limited="true" range="0 9">
          <site site="mark"/><site site="imu"/>
        </spatial>
        <fixed name="thighs"><joint joint="front_thigh" coef="1"/></fixed>
      </tendon>
      <equality><tendon name="taut" tendon1="leash"/></equality>
      <actuator>
        <motor name="winch" tendon="leash" ctrlrange="0 1"/>
        <motor name="crane" site="imu" refsite="mark" ctrlrange="0 1"/>
        <motor name="thrust" site="imu" ctrlrange="0 1"/>
        <motor name="both" tendon="thighs" ctrlrange="0 1"/>
      </actuator>
      <sensor>
        <tendonpos name="length" tendon="leash"/><actuatorfrc name="pull" actuator="winch"/>
      </sensor>"""
    engine = dog(lambda text: text.replace("</worldbody>", referring), actuators=None)
    model = engine.model
    actuators = [model.actuator(i).name.removeprefix("robot/") for i in range(model.nu)]
    assert (actuators, model.ntendon, model.neq) == (["thrust", "both"], 1, 0)
    assert not {"length", "pull"} & {*engine.observation_layout}
    left_out = {"tendon leash", "equality taut", "actuator winch", "actuator crane"}
    assert left_out | {"sensor length", "sensor pull"} <= {*ROBOTS["Dog"].file.left_out}


def test_a_keyframe_that_tilts_the_robot_counts_as_tilt(dog):
    tilted = KEY.format(name="home", z=0.7, thigh=0.3).replace("0.7 1 0 0 0", "0.7 0.96 0.28 0 0")
    dog(keys=tilted)
    engine = Scenario(robot="Dog", constraints={"basetilt": {"limit": 1.0}}).build(2)
    engine.reset(np.arange(2))
    (tilt,) = engine.constraints
    np.testing.assert_allclose(tilt.amount(), 2 * np.arctan2(0.28, 0.96))


def test_only_the_robot_is_taken_from_a_world(dog):
    engine = dog()
    model = engine.model
    names = [model.body(i).name for i in range(model.nbody)]
    assert "robot/trunk" in names and not any("ball" in name for name in names)
    planes = np.count_nonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    assert (planes, model.nlight) == (1, 1)  # the arena's
    assert model.opt.timestep == 0.004
    assert "to_ball" not in engine.observation_layout
    left_out = ROBOTS["Dog"].file.left_out
    assert left_out == ("body ball", "geom ground", "sensor to_ball")


def test_gains_make_position_servos_within_range_and_force_limit(dog):
    gains = {"*_thigh": GAINS, "front_calf": GAINS | {"force": 7.0}, "fan": GAINS}
    engine = dog(actuators=gains, pose={"fan": 0.5})
    model = engine.model
    names = [model.actuator(i).name for i in range(model.nu)]
    assert names == [f"robot/{n}" for n in ("front_thigh", "front_calf", "back_thigh", "fan")]
    expected = np.deg2rad([[-45, 90], [-150, -30], [-45, 90], [-180, 180]])
    expected[3] += 0.5  # half a turn either way of the pose
    np.testing.assert_allclose(model.actuator_ctrlrange, expected)
    np.testing.assert_array_equal(model.actuator_forcelimited, [0, 1, 0, 0])
    np.testing.assert_array_equal(model.actuator_forcerange[1], [-7, 7])
    # the file's defaults for actuators are not the servos'
    assert (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE).all()
    data = engine.batch.get_data(0)
    data.qpos[model.joint("robot/front_thigh").qposadr] = 0.3
    data.qvel[model.joint("robot/front_thigh").dofadr] = -0.7
    data.ctrl[0] = 0.2
    mujoco.mj_forward(model, data)
    assert data.actuator_force[0] == pytest.approx(40 * (0.2 - 0.3) - 2 * -0.7)


def test_an_offset_is_added_to_the_pose(dog):
    pose = {"front_thigh": 0.4, "front_calf": -1.0}
    engine = dog(action="offset", action_scale=0.1, pose=pose)
    engine.step(np.array([[0, 1, -0.5, 0.0]] * 2))
    ctrl = engine.batch.bind("ctrl")
    np.testing.assert_allclose(ctrl[0], [0.4, -1.0 + 0.1, -0.05, 0.0])
    np.testing.assert_allclose(engine.observe()[:, engine.observation_layout["last_action"]],
                               [[0, 1, -0.5, 0.0]] * 2)  # fmt: skip
    engine.reset(np.array([1]))
    last = engine.observe()[:, engine.observation_layout["last_action"]]
    assert last[0, 1] == 1.0 and not last[1].any()


def test_servos_keep_the_pose_until_the_first_action(dog):
    engine = dog(pose={"front_thigh": 0.4, "front_calf": np.float32(-1.0)})
    names = [engine.model.actuator(i).name for i in range(engine.model.nu)]
    pose = [0.4, -1.0, 0.0, 0.0]
    assert [qpos(engine, name.removeprefix("robot/")) for name in names] == pose
    np.testing.assert_allclose(engine.batch.bind("ctrl"), [pose] * 2)
    data = engine.batch.get_data(0)
    mujoco.mj_forward(engine.model, data)
    np.testing.assert_allclose(data.actuator_force, 0.0, atol=1e-9)


def test_what_no_sensor_covers_is_observed_as_a_scalar_computation_says(dog):
    pose = {"front_calf": -1.0}
    engine = dog(pose=pose)
    rng = np.random.default_rng(0)
    for _ in range(30):
        engine.step(rng.uniform(-1, 1, (2, 4)))
    obs, layout, model = engine.observe(np.float64)[1], engine.observation_layout, engine.model
    data = engine.batch.get_data(1)
    joints = ["front_thigh", "front_calf", "back_thigh"]
    rest = {"front_calf": -1.0}
    turn = data.body("robot/trunk").xmat.reshape(3, 3)
    expected = {
        "joint_pos": [data.joint(f"robot/{j}").qpos[0] - rest.get(j, 0.0) for j in joints],
        "joint_vel": [data.joint(f"robot/{j}").qvel[0] for j in [*joints, "fan"]],
        "gravity": turn.T @ [0, 0, -1],
        "base_linvel": turn.T @ data.qvel[:3],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(obs[layout[name]], values, atol=1e-9, err_msg=name)
    covered = {"base_angvel", "joint_turn"}  # by the gyro and by the sensor of the fan
    assert not covered & set(layout) and {"imu_gyro", "fan_angle"} <= set(layout)
    np.testing.assert_allclose(obs[layout["imu_gyro"]], data.qvel[3:6], atol=1e-6)
    assert model.nsensor == 2


def test_a_hinge_without_a_range_is_observed_as_a_direction(dog):
    def change(text):
        return text.replace('<jointpos name="fan_angle" joint="fan"/>', "")

    engine = dog(change, pose={"fan": 0.3})
    engine.batch.bind("qpos")[:, engine.model.joint("robot/fan").qposadr[0]] = 0.8
    obs = engine.observe(np.float64)[0, engine.observation_layout["joint_turn"]]
    np.testing.assert_allclose(obs, [np.sin(0.5), np.cos(0.5)])


def test_joints_of_an_observation_are_named_in_their_order(dog):
    engine = dog(pose={"*_thigh": 0.5}, observe=["joint_pos", "joint_turn", "joint_vel"])
    robot = engine.robot
    names = ["front_thigh", "front_calf", "back_thigh"]
    pose = [0.5, pytest.approx(np.deg2rad(-90)), 0.5]
    assert robot.joints_of("joint_pos") == {"joints": names, "first_pose": pose}
    assert robot.joints_of("joint_turn") == {"joints": ["fan"], "first_pose": [0.0]}
    assert robot.joints_of("joint_vel") == {"joints": [*names, "fan"]}
    assert robot.joints_of("gravity") == {}


def test_each_number_of_hinges_and_slides_has_its_unit(dog):
    def change(text):
        slide = '<joint name="back_thigh" type="slide" axis="0 0 1" range="-1 1"'
        return text.replace('<joint name="back_thigh" axis="0 1 0" range="-45 90"', slide)

    sensors = """<sensor>
      <jointpos name="low" joint="back_thigh"/><jointvel name="sinks" joint="back_thigh"/>
      <framezaxis name="up" objtype="site" objname="imu"/>"""
    engine = dog(lambda text: change(text).replace("<sensor>", sensors))
    units = {part.name: part.unit for part in components(engine)}
    assert (units["low"], units["sinks"], units["up"]) == ("m", "m/s", "direction")
    assert (units["joint_pos"], units["joint_vel"]) == ("rad", "rad/s")  # the slide has sensors
    engine = dog(change, observe=["joint_pos", "joint_vel"])
    units = {part.name: part.unit for part in components(engine)}
    assert (units["joint_pos"], units["joint_vel"]) == ("rad, m", "rad/s, m/s")
    robot = engine.robot
    assert robot.joints_of("joint_pos")["unit"] == ["rad", "rad", "m"]
    assert robot.joints_of("joint_vel")["unit"] == ["rad/s", "rad/s", "m/s", "rad/s"]


def test_joints_of_other_bodies_are_not_the_robots(dog):
    sensed = '<jointpos name="fan_angle" joint="fan"/>'
    engine = dog(lambda text: text.replace(sensed, ""), complete=True)
    sizes = {name: channel.size for name, channel in engine.channels.items()}
    assert (sizes["joint_pos"], sizes["joint_turn"], sizes["joint_vel"]) == (3, 2, 4)


def test_observe_chooses(dog):
    engine = dog(observe=("joint_pos", "imu_gyro", "base_angvel"))
    seen = set(engine.observation_layout) - {"goal_compass", "hazards_lidar"}
    assert seen == {"joint_pos", "imu_gyro", "base_angvel"}
    engine.batch.bind("qvel")[:] = np.random.default_rng(0).normal(size=engine.batch.qvel.shape)
    engine.batch.forward()
    obs, layout = engine.observe(np.float64), engine.observation_layout
    np.testing.assert_allclose(obs[:, layout["base_angvel"]], obs[:, layout["imu_gyro"]], atol=1e-9)


def test_keepout_and_arena_follow_the_size(dog):
    engine = dog()
    assert engine.robot.keepout == pytest.approx(0.45, abs=0.05)
    assert engine.arena.size == pytest.approx(5 * engine.robot.keepout, rel=0.1)
    with own_parts():
        stated = Scenario(robot="Dog", arena={"size": 7.0}, robot_params={"keepout": 0.1})
        assert (stated.build().arena.size, stated.build().robot.keepout) == (7.0, 0.1)


@pytest.fixture
def arm(tmp_path):
    def write(suite="Goal_Crane_3Hazards", **attributes):
        (tmp_path / "crane.xml").write_text(ARM)
        attributes = {"actuators": GAINS, "center": "hand"} | attributes
        register_robot("Crane", xml=tmp_path / "crane.xml", **attributes)
        return Scenario.parse(suite)

    with own_parts():
        yield write


def test_the_end_effector_of_an_arm_may_be_a_site(arm):
    engine = arm(pose={"lift": 0.5}).build(2)
    engine.seed(0, np.random.default_rng(0))
    engine.seed(1, np.random.default_rng(1))
    engine.reset(np.arange(2))
    np.testing.assert_allclose(engine.robot.position[0, 2], 0.1 + 0.5 * np.cos(0.5), atol=1e-9)
    np.testing.assert_allclose(np.hypot(*engine.robot.position[1, :2]), 0.5 * np.sin(0.5))
    before = engine.robot.position.copy()
    rewards = [engine.step(np.ones((2, 3))).reward for _ in range(10)]
    assert np.abs(rewards).max() > 0  # the hand moves to or from the goal
    engine.batch.bind("qvel")[:] = [1.0, 0.5, -0.5]
    engine.batch.forward()
    small = 1e-6
    before, speed = engine.robot.position.copy(), engine.robot.velocity.copy()
    engine.batch.bind("qpos")[:] += small * engine.batch.bind("qvel")
    engine.batch.forward()
    np.testing.assert_allclose((engine.robot.position - before) / small, speed, atol=1e-4)


def test_reach_and_goals_follow_an_arms_length(arm):
    scenario = arm()
    engine = scenario.build(20)
    reach = engine.robot.reach
    assert 0.9 * 0.5 < reach < 0.6  # 0.6 m when stretched, of which 90 % counts
    engine.reset(np.arange(20))
    goals = engine.places("goal")[:, 0]
    assert np.linalg.norm(goals, axis=1).max() <= reach
    assert engine.task.size == pytest.approx(reach / 10, rel=0.02)
    assert scenario.override(goal={"size": 0.2}).build().task.size == 0.2
    planar = scenario.override(hazards={"space": "planar"}).build()
    assert planar.constraints[0].planar


def test_clearance_of_an_arm_is_that_of_its_nearest_link(arm):
    engine = arm(pose={"lift": 0.7, "elbow": -1.0}).build()
    engine.reset(ROW)
    data, rng = engine.batch.get_data(0), np.random.default_rng(0)
    points = rng.uniform([-0.5, -0.5, -0.1], [0.5, 0.5, 0.9], (1, 20, 3))
    gaps = engine.robot.clearance(points, False)[0]
    hand = data.site("robot/hand").xpos
    joints = [data.body(f"robot/{b}").xpos for b in ("upper", "lower")] + [hand]
    for point, gap in zip(points[0], gaps, strict=True):
        links = []
        for start, end in ((joints[0], joints[1]), (joints[1], joints[2])):
            share = np.clip((point - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
            links.append(np.linalg.norm(point - start - share * (end - start)) - 0.02)
        base = np.linalg.norm(point - [0, 0, 0.05]) - 0.05  # a cylinder as wide as high
        assert gap == pytest.approx(min(*links, base), abs=1e-9)


@pytest.mark.parametrize("robot", ["dog", "arm"])
def test_rows_are_lone_environments(robot, request):
    request.getfixturevalue(robot)()
    name = {"dog": "Dog", "arm": "Crane"}[robot]
    assert_rows_are_lone_environments(f"Goal_{name}_2Hazards")


def nothing(text):
    return text


def without_joints(text):
    return "<mujoco><worldbody><body name='box'><geom size='1'/></body></worldbody></mujoco>"


def moved_by_weld(text):
    mocap = (
        '<body name="hand" mocap="true"/></worldbody><equality><weld body1="hand" body2="trunk"/>'
    )
    return text.replace("</worldbody>", mocap + "</equality>")


def with_slide(text):
    return text.replace('<joint name="fan"/>', '<joint name="fan" type="slide"/>')


def with_keyframe(text):
    key = KEY.format(name="home", z=0.7, thigh=0.3).replace("-1 0.2 0", "-1 -1 0")
    return text.replace("<keyframe>", f"<keyframe>{key}")


def with_rate(text):
    servo = '<intvelocity name="fan" joint="fan" kp="3" ctrlrange="-1 1" actrange="-1 1"/>'
    return text.replace("<sensor>", f"<actuator>{servo}</actuator><sensor>")


def of_balls(text):
    return """<mujoco><worldbody><body name="trunk" pos="0 0 1"><freejoint/><geom size="0.1"/>
        <body><joint type="ball"/><geom size="0.05"/></body></body></worldbody></mujoco>"""


def with_motor(text):
    return text.replace("<sensor>", '<actuator><motor joint="fan"/></actuator><sensor>')


def with_motor_in_range(text):
    motor = '<actuator><motor name="fan" joint="fan" ctrlrange="-1 1"/></actuator><sensor>'
    return text.replace("<sensor>", motor)


@pytest.mark.parametrize(
    ("change", "stated", "message"),
    [
        (nothing, {"root": None}, "2 outermost bodies .* 'trunk', 'ball': .* root='trunk'"),
        (nothing, {"root": "trunc"}, "no body 'trunc': did you mean 'trunk'"),
        (nothing, {"root": "front"}, r"'front' is not an outermost one: root may be \['ball', 'tr"),
        (nothing, {"root": 3}, "root = 3 must be the name of an outermost body"),
        (without_joints, {"root": None}, "no body with joints: a robot needs joints to move by"),
        (nothing, {"keyframe": "home"}, r"no keyframe 'home': it has none; pose={...} sets joints"),
        (
            with_keyframe,
            {},
            r"keyframe 'home' of .* 'back_thigh' at -1, .* -0.785398 to 1.5708: .*pose={'back_thi",
        ),
        (
            nothing,
            {"pose": {"*_knee": 0.1}},
            r"'\*_knee': did you mean 'front_calf'|allowed: front",
        ),
        (nothing, {"pose": {"front_calf": 0.1}}, "out of the range of joint 'front_calf': allowed"),
        (nothing, {"pose": {"fan": "up"}}, r"pose\['fan'\] = 'up' must be a number, rad or m"),
        (nothing, {"pose": {3: 0.1}}, "pose of dog.xml matches no name '3': allowed: front_thigh"),
        (nothing, {"pose": [0.1]}, r"pose = \[0.1\] must be a mapping of joints to rad or m"),
        (nothing, {"actuators": None}, "dog.xml has no actuators: give its joints position servos"),
        (nothing, {"actuators": {}}, "actuators = {} must be gains such as {'kp': 35, 'kd': 1}"),
        (nothing, {"actuators": 35}, "actuators = 35 must be gains such as"),
        (nothing, {"actuators": {"kp": 35}}, "lacks 'kd': gains are {'kp': 35, 'kd': 1}"),
        (nothing, {"actuators": {**GAINS, "ki": 1}}, "no gain 'ki': allowed: kp, kd"),
        (
            nothing,
            {"actuators": {"kp": -1, "kd": 1}},
            r"\['kp'\] = -1 must be a number greater than",
        ),
        (
            nothing,
            {"actuators": {"tail": GAINS}},
            "actuators of dog.xml matches no name 'tail': .*fan",
        ),
        (
            nothing,
            {"actuators": {"*": GAINS, "fan": 3}},
            r"actuators\['fan'\] = 3 must be gains such as",
        ),
        (with_slide, {}, "slide 'fan' has no range, which a position servo needs"),
        (with_motor, {}, "dog.xml has 1 actuators of its own: leave out actuators="),
        (with_motor, {"actuators": None}, "actuator 'fan' of the robot has no ctrlrange"),
        (with_motor_in_range, {"actuators": None, "action": "offset"}, "actuator 'fan' is none"),
        (with_rate, {"actuators": None, "action": "offset"}, "actuator 'fan' is none: use"),
        (of_balls, {}, "has no hinges or slides, which position servos need"),
        (nothing, {"actuators": {"fan": [3, 1]}}, r"actuators\['fan'\] = \[3, 1\] must be gains"),
        (nothing, {"action": "torque"}, "action = 'torque' must be 'range' or 'offset'"),
        (nothing, {"action_scale": 0}, "action_scale = 0 must be a positive number, of rad or m"),
        (
            nothing,
            {"observe": ["joint_po"]},
            "observe names no .* 'joint_po': did you mean 'joint_pos'",
        ),
        (
            nothing,
            {"observe": "joint_pos"},
            r"must be a list of names, such as \['joint_pos', 'gra",
        ),
        (nothing, {"center": "hed"}, "center names no body or site 'hed' of dog.xml: "),
        (nothing, {"keepout": -1}, "keepout = -1 must be a number of metres, at least 0"),
        (nothing, {"defaults": {"goal": 3}}, r"must be a mapping such as {'goal': {'size': 0.05}}"),
        (
            moved_by_weld,
            {"actuators": None},
            "moves the robot by a weld to mocap body 'hand', which",
        ),
    ],
)
def test_what_is_no_robot_is_answered_in_a_line(dog, change, stated, message):
    stated = {"actuators": GAINS, **stated}
    with pytest.raises(ValueError, match=message) as caught:
        dog(change, **stated)
    assert "\n" not in str(caught.value) and "Dog" not in ROBOTS


@pytest.mark.parametrize("center", [None, "base"])
def test_an_arm_without_an_end_effector_is_answered_in_a_line(arm, center):
    with pytest.raises(
        ValueError, match=r"'base', .*, cannot move: .* center='hand'; others are lo"
    ):
        arm(center=center)


def test_an_arm_below_the_floor_is_answered_in_a_line(tmp_path):
    path = tmp_path / "lamp.xml"
    path.write_text("""
    <mujoco>
      <worldbody>
        <body name="base">
          <body name="lamp" pos="0 0 -1"><joint name="swing"/><geom size="0.1"/></body>
        </body>
      </worldbody>
    </mujoco>
    """)
    with own_parts():
        with pytest.raises(ValueError, match=r"never gets above the floor.* raise body 'base'"):
            register_robot("Lamp", xml=path, actuators=GAINS, center="lamp")
        with pytest.raises(ValueError, match=r"center='lamp'$"):
            register_robot("Lamp", xml=path, actuators=GAINS)

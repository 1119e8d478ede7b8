"""An MJCF file is a robot as its maker wrote it; what it lacks is added to its MjSpec."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from robot_models import ARM, DOG, add_pose, add_servos
from worlds import assert_rows_are_lone_environments, own_parts

from sb3_guard.envs import Scenario, register_robot
from sb3_guard.envs.components import components
from sb3_guard.envs.registry import ROBOTS

ROW = np.zeros(1, dtype=int)
# qpos of the ball and of the dog, whose file lists them in this order
KEY = '<key name="{name}" qpos="2 0 1 1 0 0 0  3 1 {z} 1 0 0 0  {thigh} -1 0.2 0"/>'


@pytest.fixture
def dog(tmp_path):
    def write(change=lambda text: text, keys="", servos=True, pose=None, **attributes):
        path = tmp_path / "dog.xml"
        path.write_text(change(DOG.format(keys=keys)))
        spec = mujoco.MjSpec.from_file(str(path)) if servos or pose else None
        if servos:
            add_servos(spec)
        if pose:
            add_pose(spec, **pose)
        attributes = {"root": "trunk"} | attributes
        register_robot("Dog", xml=path if spec is None else spec, **attributes)
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


LEG = """<body name="{leg}" pos="{place} 0">
  <joint name="{leg}_thigh_joint" axis="0 1 0" range="-45 90"/>
  <geom size="0.02" fromto="0 0 0 0 0 -0.2" type="capsule"/>
  <body pos="0 0 -0.2"><joint name="{leg}_calf_joint" axis="0 1 0" range="-160 -30"/>
    <geom size="0.02" fromto="0 0 0 0 0 -0.2" type="capsule"/></body></body>"""


def test_the_page_adds_servos_a_pose_and_sensors(tmp_path, monkeypatch):
    places = {"FR": "0.2 -0.1", "FL": "0.2 0.1", "RR": "-0.2 -0.1", "RL": "-0.2 0.1"}
    legs = "".join(LEG.format(leg=leg, place=place) for leg, place in places.items())
    (tmp_path / "go1.xml").write_text(f"""<mujoco><worldbody><body name="trunk"><freejoint/>
      <site name="imu"/><geom type="box" size="0.25 0.1 0.05"/>{legs}</body></worldbody>
      <sensor><accelerometer name="imu_lin_acc" site="imu"/></sensor></mujoco>""")
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "robot_files.md").read_text()
    (sample,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    with own_parts():
        exec(sample, {})
        engine = Scenario.parse("Goal_Go1_0Hazards").build()
    engine.reset(ROW)
    assert qpos(engine, "FR_thigh_joint") == 0.9 and qpos(engine, "RL_calf_joint") == -1.8
    for _ in range(25):
        engine.step(np.zeros((1, 8)))  # stands
    assert qpos(engine, "FR_thigh_joint") == pytest.approx(0.9, abs=0.1)
    assert engine.robot.position[0, 2] > 0.2
    assert "trunk_place" in engine.observation_layout
    assert "imu_lin_acc" not in engine.observation_layout
    np.testing.assert_allclose(engine.model.actuator_ctrlrange[0], [0.65, 1.15])


def test_what_refers_to_the_world_is_left_out(dog):
    referring = """<site name="mark"/></worldbody>
      <contact><pair geom1="ball" geom2="front_foot"/></contact>
      <equality><connect name="leash" site1="mark" site2="imu"/></equality>
      <sensor><distance name="gap" geom1="ball" geom2="front_foot" cutoff="1"/></sensor>"""
    engine = dog(lambda text: text.replace("</worldbody>", referring))
    assert "gap" not in engine.observation_layout
    assert (engine.model.neq, engine.model.npair) == (0, 0)
    left_out = {"geom ground", "site mark", "sensor gap", "equality leash"}
    left_out |= {"pair ball front_foot"}
    assert left_out <= {*ROBOTS["Dog"].model_file().left_out}


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
    engine = dog(lambda text: text.replace("</worldbody>", referring), servos=False)
    model = engine.model
    actuators = [model.actuator(i).name.removeprefix("robot/") for i in range(model.nu)]
    assert (actuators, model.ntendon, model.neq) == (["thrust", "both"], 1, 0)
    assert not {"length", "pull"} & {*engine.observation_layout}
    left_out = {"tendon leash", "equality taut", "actuator winch", "actuator crane"}
    assert left_out | {"sensor length", "sensor pull"} <= {*ROBOTS["Dog"].model_file().left_out}


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
    left_out = ROBOTS["Dog"].model_file().left_out
    assert left_out == ("body ball", "geom ground", "sensor to_ball")


def test_servos_keep_the_first_pose_until_the_first_action(dog):
    engine = dog()
    pose = [0.0, np.deg2rad(-90), 0.0, 0.0]
    np.testing.assert_allclose(engine.batch.bind("ctrl"), [pose] * 2, atol=1e-12)
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


def test_joints_of_an_observation_are_named_in_their_order(dog):
    sensed = '<jointpos name="fan_angle" joint="fan"/>'
    pose = {"front_thigh": 0.5, "back_thigh": 0.5, "front_calf": -1.5}
    engine = dog(lambda text: text.replace(sensed, ""), pose=pose)
    robot = engine.robot
    names = ["front_thigh", "front_calf", "back_thigh"]
    pose = [0.5, -1.5, 0.5]
    assert robot.described("joint_pos") == {"joints": names, "first_pose": pose}
    assert robot.described("joint_turn") == {"joints": ["fan"], "first_pose": [0.0]}
    assert robot.described("joint_vel") == {"joints": [*names, "fan"]}
    assert robot.described("gravity") == {"axes": "trunk"}


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
    engine = dog(change)
    units = {part.name: part.unit for part in components(engine)}
    assert (units["joint_pos"], units["joint_vel"]) == ("rad, m", "rad/s, m/s")
    robot = engine.robot
    assert robot.described("joint_pos")["unit"] == ["rad", "rad", "m"]
    assert robot.described("joint_vel")["unit"] == ["rad/s", "rad/s", "m/s", "rad/s"]


def test_keepout_and_arena_follow_the_size(dog):
    engine = dog()
    assert engine.robot.keepout == pytest.approx(0.45, abs=0.05)
    assert engine.arena.size == pytest.approx(5 * engine.robot.keepout, rel=0.1)
    with own_parts():
        stated = Scenario(robot="Dog", arena={"size": 7.0}, robot_params={"keepout": 0.1})
        assert (stated.build().arena.size, stated.build().robot.keepout) == (7.0, 0.1)


@pytest.fixture
def arm(tmp_path):
    def write(suite="Goal_Crane_3Hazards", pose=None, **attributes):
        spec = add_servos(mujoco.MjSpec.from_string(ARM))
        if pose:
            add_pose(spec, **pose)
        register_robot("Crane", xml=spec, **{"center": "hand"} | attributes)
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
    # from its first joint 0.5 m when stretched, of which 90 % counts
    assert reach == pytest.approx(0.45, rel=0.02)
    engine.reset(np.arange(20))
    goals = engine.places("goal")[:, 0]
    assert np.linalg.norm(goals - [0, 0, 0.1], axis=1).max() <= reach
    assert engine.task.size == pytest.approx(reach / 10, rel=0.02)
    assert scenario.override(goal={"size": 0.2}).build().task.size == 0.2
    planar = scenario.override(hazards={"space": "planar"}).build()
    assert planar.constraints[0].planar


# two links of 0.4 m whose shoulder is 5 cm from the joint that turns them
CRANE = """<mujoco><compiler angle="degree"/><worldbody><body name="base" {base}>
  <geom size="0.05"/>
  <body name="turret"><joint name="turn" axis="0 0 1" {turn}/><geom size="0.04"/>
    <site name="imu"/>
    <body name="upper" pos="0 0 0.05"><joint name="lift" axis="0 1 0" {lift}/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.4"/>
      <body name="lower" pos="0 0 0.4"><joint name="elbow" axis="0 1 0" {elbow}/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.4"/>
        <site name="hand" pos="0 0 0.4"/>
  </body></body></body></body></worldbody></mujoco>"""


@pytest.fixture
def crane():
    def write(base, turn="", lift="", elbow="", suite="Goal_Crane_0Hazards", more="", **stated):
        text = CRANE.format(base=base, turn=turn, lift=lift, elbow=elbow)
        spec = mujoco.MjSpec.from_string(text.replace("</mujoco>", f"{more}</mujoco>"))
        register_robot("Crane", xml=add_servos(spec), **{"center": "hand"} | stated)
        return Scenario.parse(suite)

    with own_parts():
        yield write


def goals_of(engine):
    """First and second goals of 100 episodes in 20 rows, [200, 3] m."""
    rows, goals = np.arange(20), []
    for row in rows:
        engine.seed(int(row), np.random.default_rng(row))
    for _ in range(5):
        engine.reset(rows)
        goals.append(engine.places("goal")[:, 0].copy())
        engine.task.advance(rows)
        goals.append(engine.places("goal")[:, 0].copy())
    return np.concatenate(goals)


@pytest.mark.parametrize(
    ("base", "up"),
    [
        ('pos="0 0 0.8"', [0, 0, 1]),
        ('pos="0 0 1.2" euler="180 0 0"', [0, 0, -1]),
        ('pos="0 0 0.9" euler="0 90 0"', [1, 0, 0]),
    ],
    ids=["raised", "hanging", "sideways"],
)
def test_reach_is_measured_from_an_arms_first_joint(crane, base, up):
    engine = crane(base).override(robot={"locations": [[0.3, -0.2]]}).build(20)
    height = float(base.split('"')[1].split()[2])
    np.testing.assert_allclose(engine.robot.reach_center, [0.3, -0.2, height])
    assert engine.robot.reach == pytest.approx(0.76, abs=0.01)  # 90 % of 0.85 m
    goals = goals_of(engine)
    shoulder = np.add([0.3, -0.2, height], np.multiply(0.05, up))
    assert np.linalg.norm(goals - shoulder, axis=1).max() <= 0.8 + engine.task.size
    assert np.ptp(goals[:, 2]) > 0.3 and goals[:, 2].min() > 0


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_goals_lie_where_an_arm_turns_to(crane, heading):
    """Its hand is always ahead: it turns by 45 degrees either way and bends forwards only."""
    scenario = crane(
        'pos="0 0 0.3"', 'range="-45 45"', lift='range="20 60"', elbow='range="0 60"'
    ).override(robot={"locations": [[1.0, 1.0]], "heading": heading})
    goals = goals_of(scenario.build(20)) - [1.0, 1.0, 0.0]
    assert (goals[:, :2] @ [np.cos(heading), np.sin(heading)]).min() > 0


def test_objects_on_the_floor_are_out_of_reach_of_an_arm_on_a_high_table(crane):
    base = crane('pos="0 0 0.9"', suite="Goal_Crane_2Hazards")
    with pytest.raises(
        ValueError, match=r"ball: height is out of .* 0\.90 m from \(0\.0, 0\.0, 0\.9\)"
    ):
        Scenario.parse("Push_Crane_0Hazards").build()
    above = base.override(hazards={"space": "planar"}).build()  # where heights do not count
    above.reset(ROW)
    listed = [[0.3, 0.3], [0.1, -0.4], [0.2, 0.2]]
    engine = base.override(goal={"locations": listed}).build()
    engine.reset(ROW)
    assert engine.places("goal")[0, 0, :2].tolist() in listed
    with pytest.raises(ValueError, match=r"goal: the robot's hand gets to no place in \[\(1"):
        base.override(goal={"placements": [[1, 1, 2, 2]]}).build()


@pytest.mark.slow
@pytest.mark.parametrize("turn", ["", 'range="-100 100"'], ids=["all around", "ahead"])
@pytest.mark.parametrize(
    "base",
    ['pos="0 0 0.8"', 'pos="0 0 1.2" euler="180 0 0"', 'pos="0 0 0.9" euler="0 90 0"'],
    ids=["raised", "hanging", "sideways"],
)
def test_nearly_all_goals_of_an_arm_can_be_reached(crane, base, turn):
    engine = crane(base, turn, 'range="-110 110"', 'range="-140 0"').build(20)
    goals, rng = goals_of(engine), np.random.default_rng(0)
    model, data = ROBOTS["Crane"].model_file().standing()
    gaps = np.full(len(goals), np.inf)
    low, high = np.where(model.jnt_limited, model.jnt_range.T, [[-np.pi], [np.pi]])
    for _ in range(50_000):
        data.qpos[:] = rng.uniform(low, high)
        mujoco.mj_kinematics(model, data)
        gaps = np.minimum(gaps, np.linalg.norm(goals - data.site("hand").xpos, axis=1))
    assert np.mean(gaps <= engine.task.size) >= 0.95


def test_an_arm_that_never_rises_above_the_floor_is_answered_in_a_line(crane):
    with pytest.raises(ValueError, match=r"'imu' is never above the floor, .*: raise .* by pos"):
        crane('pos="0 0 0"', center="imu")


def test_an_arm_of_one_joint_reaches_where_its_hand_is(crane):
    engine = crane('pos="0 0 0.9"', 'range="-0.1 0.1"', elbow='range="-0.1 0.1"').build(20)
    assert engine.robot.reach == pytest.approx(0.8, abs=0.01)
    gaps = np.linalg.norm(goals_of(engine) - [0.0, 0.0, 0.95], axis=1)
    assert abs(gaps - 0.8).max() <= engine.task.size


def test_a_reach_within_which_the_hand_never_is_is_named(crane):
    with pytest.raises(ValueError, match=r"never above the floor, z = 0, within reach=0\.01 m"):
        crane('pos="0 0 0.9"', reach=0.01)


def test_joints_follow_those_that_they_are_tied_to(crane):
    tied = '<equality><joint joint1="elbow" joint2="lift" polycoef="0 -1 0 0 0"/></equality>'
    engine = crane('pos="0 0 0.9"', more=tied).build(20)
    places = engine.robot.hand - [0.0, 0.0, 0.95]
    # the upper link points anywhere, and the lower one up
    np.testing.assert_allclose(np.linalg.norm(places - [0, 0, 0.4], axis=1), 0.4)
    fixed = '<equality><joint joint1="elbow" polycoef="1.5708 0 0 0 0"/></equality>'
    places = crane('pos="0 0 0.9"', more=fixed).build().robot.hand - [0.0, 0.0, 0.95]
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 0.4 * 2**0.5, rtol=1e-4)


def test_an_arm_whose_geoms_meet_nothing_has_links(crane):
    text = CRANE.format(base="", turn="", lift="", elbow="").replace(
        "<worldbody>", '<default><geom contype="0" conaffinity="0"/></default><worldbody>'
    )
    register_robot("Ghostly", xml=add_servos(mujoco.MjSpec.from_string(text)), center="hand")
    engine = Scenario.parse("Goal_Ghostly_0Hazards").build()
    engine.reset(ROW)
    assert engine.robot.clearance(np.array([[[0.0, 0.0, 0.25]]]), False)[0, 0] < 0.0


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


def endless(text):
    return with_motor(text).replace("/></actuator>", ' ctrlrange="-inf inf"/></actuator>')


def with_motor(text):
    return text.replace("<sensor>", '<actuator><motor joint="fan"/></actuator><sensor>')


@pytest.mark.parametrize(
    ("change", "stated", "message"),
    [
        (nothing, {"root": None}, "2 outermost bodies .* 'trunk', 'ball': .* root='trunk'"),
        (nothing, {"root": "trunc"}, "no body 'trunc': did you mean 'trunk'"),
        (nothing, {"root": 3}, "root = 3 must be text or null"),
        (nothing, {"keyframe": "home"}, r"no keyframe 'home': allowed: none"),
        (nothing, {"servos": False}, "dog.xml has no actuators: docs/robot_files.md adds servos"),
        (endless, {"servos": False}, "actuator 'fan' of the robot has no ctrlrange: .* finite"),
        (nothing, {"center": "hed"}, "center names no body or site 'hed' of "),
        (nothing, {"defaults": {"goal": 3}}, "defaults = .* must be a mapping"),
    ],
)
def test_what_is_no_robot_is_answered_in_a_line(dog, change, stated, message):
    with pytest.raises(ValueError, match=message) as caught:
        dog(change, **stated)
    assert "\n" not in str(caught.value) and "Dog" not in ROBOTS


def test_the_end_effector_that_is_advised_has_most_joints_above_it(crane):
    with pytest.raises(ValueError, match=r"cannot move: .* center='hand'"):
        crane('pos="0 0 0"', center=None)


@pytest.mark.parametrize("center", [None, "base"])
def test_an_arm_without_an_end_effector_is_answered_in_a_line(arm, center):
    with pytest.raises(ValueError, match=r"'base', .*, cannot move: .* center='hand'"):
        arm(center=center)

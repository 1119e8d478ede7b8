"""Tasks: rewards against scalar loops, what counts as success, and objects that behave."""

import math

import numpy as np
import pytest
from worlds import actions, assert_rows_are_lone_environments, free_body, put_point, world

from sb3_guard.envs import Scenario
from sb3_guard.envs.registry import TASKS, guard

SLOW = pytest.mark.slow  # further cases of a promise that another case keeps


def gap(a, b, planar):
    return math.dist(a[:2], b[:2]) if planar else math.dist(a, b)


@pytest.mark.parametrize("robot", ["Point", "Drone", "Arm3"])
def test_push_rewards_equal_the_scalar_loop(robot):
    """Every gate: the ball is set down beside the robot, then away from it."""
    engine = world(f"Push_{robot}_2Hazards", 3, push={"reward_approach": 1.5})
    planar = engine.robot.workspace == "planar"
    ball, place = engine.batch.bind("xpos")[:, engine.model.body("ball/0").id], engine.task.place
    pose, _ = free_body(engine, "ball/0")
    gates = set()
    for step, action in enumerate(actions(engine, 60)):
        if step % 20 == 0:
            beside = 0.3 if step == 20 else 1.1
            pose[:, :2] = engine.robot.position[:, :2] + [beside, 0]
            engine.batch.forward()
            engine._before[:] = engine.task.measure()
        old = [
            (gap(engine.robot.position[i], ball[i], planar), gap(ball[i], place[i], True))
            for i in range(3)
        ]
        goals = place.copy()
        outcome = engine.step(action)
        for i in range(3):
            b = gap(engine.robot.position[i], ball[i], planar)
            g = gap(ball[i], goals[i], True)
            gate = old[i][0] > 0.4
            gates.add(gate)
            expected = 1.5 * (old[i][0] - b) * gate + (old[i][1] - g)
            expected = min(max(expected, -10), 10) + (g <= 0.5)
            assert outcome.reward[i] == pytest.approx(expected, abs=1e-12)
            assert outcome.goal_met[i] == (g <= 0.5)
    assert True in gates
    if planar:
        assert False in gates


def test_a_ball_in_the_goal_pays_once_and_the_goal_moves_clear_of_it():
    engine = world("Push_Point_4Ghosts")
    pose, velocity = free_body(engine, "ball/0")
    old = engine.task.place[0].copy()
    pose[:, :2], velocity[:] = old[:2] + np.array([0.45, 0.0]), 0.0
    engine.batch.forward()
    engine._before[:] = engine.task.measure()
    outcome = engine.step(np.zeros((1, 2)))
    assert outcome.goal_met[0] and outcome.reward[0] == pytest.approx(1.0, abs=0.01)
    new = engine.task.place[0]
    assert math.dist(new[:2], pose[0, :2]) >= 0.6
    outcome = engine.step(np.zeros((1, 2)))
    assert not outcome.goal_met[0] and abs(outcome.reward[0]) < 0.01


@pytest.mark.parametrize("robot", ["Point", "Swimmer"])
def test_the_ball_lies_still_rolls_on_when_released_and_comes_to_rest(robot):
    """Small and large time step. Without rolling it would slide to a stop within 3 cm."""
    push = {"object_locations": [[-1.5, -1.5]], "object_rolling": 0.005}
    engine = world(f"Push_{robot}_0Hazards", push=push)
    pose, velocity = free_body(engine, "ball/0")
    still = np.zeros((1, engine.robot.action_size))
    start = pose.copy()
    for _ in range(20):
        engine.step(still)
    np.testing.assert_allclose(pose, start, atol=1e-6)
    assert pose[0, 2] == pytest.approx(0.2, abs=2e-3)
    velocity[0, 0] = 0.5
    seconds = 10 * engine.model.opt.timestep
    for _ in range(round(1 / seconds)):
        engine.step(still)
    assert 0.25 < pose[0, 0] + 1.5 < 0.5 and 0.2 < velocity[0, 0] < 0.4
    spin = np.linalg.norm(velocity[0, 3:])
    assert 0.2 * spin == pytest.approx(np.linalg.norm(velocity[0, :2]), rel=0.05)  # it rolls
    for _ in range(round(20 / seconds)):
        engine.step(still)
    assert abs(velocity[0, 0]) < 0.02 and 1.5 < pose[0, 0] + 1.5 < 3


@pytest.mark.parametrize("kind", ["ball", "box"])
def test_the_robot_pushes_the_object(kind):
    engine = world("Push_Point_0Hazards", push={"object": kind, "object_locations": [[0.0, 0.0]]})
    put_point(engine, -0.8, 0.0)
    pose, _ = free_body(engine, f"{kind}/0")
    start, felt = pose.copy(), False
    assert "box_compass" in engine.channels
    for _ in range(80):
        engine.step(np.array([[1.0, 0.0]]))
        felt |= bool(engine.task.group.touched[0, 0])
    assert felt and pose[0, 0] > start[0, 0] + 0.3


@pytest.mark.parametrize(("kind", "volume"), [("ball", 4 / 3 * math.pi), ("box", 10.0)])
@pytest.mark.parametrize("size", [0.1])
def test_the_objects_mass_follows_its_size(kind, volume, size):
    """GUARD's ball: radius 0.2 m, 3.35e-5 kg. The box and its four posts: (8 + 4 / 2) size³."""
    push = {"object": kind, "object_size": size}
    for density in (1e-3, 0.02):
        engine = Scenario(task="Push", task_params={**push, "object_density": density}).build()
        mass = engine.model.body(f"{kind}/0").mass[0]
        assert mass == pytest.approx(density * volume * size**3)
        if (kind, size, density) == ("ball", 0.2, 1e-3):
            assert mass == pytest.approx(3.35e-5, rel=1e-3)


@pytest.mark.parametrize(("kind", "covers"), [("ball", 0.3), ("box", 0.3 * 1.25 * 2**0.5)])
def test_the_object_keeps_clear_of_what_it_could_bump_into(kind, covers):
    push = {"object": kind, "object_size": 0.3}
    engine = Scenario(task="Push", task_params=push).build()
    body = engine.model.body(f"{kind}/0")
    model, outer = engine.model, 0.0
    for g in np.flatnonzero(model.geom_bodyid == body.id):
        half = model.geom_size[g, :2] if kind == "box" else [model.geom_size[g, 0], 0.0]
        outer = max(outer, math.hypot(*(np.abs(model.geom_pos[g, :2]) + half)))
    assert engine.footprints[kind].keepout == pytest.approx(outer) == pytest.approx(covers)
    push["object_keepout"] = 0.6
    assert Scenario(task="Push", task_params=push).build().footprints[kind].keepout == 0.6
    push["object_keepout"] = 0.1
    with pytest.raises(ValueError, match=r"push.object_keepout = 0.1 .* must be at least 0\.[35]"):
        Scenario(task="Push", task_params=push).build()


@pytest.mark.parametrize(
    ("suite", "params"),
    [
        ("Chase_Point_2Hazards", {}),
        ("Chase_Humanoid_0Hazards", {"chase": {"num": 4, "reward_distance": 2.0}}),
        ("Chase_Drone_2Ghosts", {"chase": {"space": "planar"}}),
        ("Chase_Point_2Ghosts", {"chase": {"solid": True}}),
    ],
    ids=str,
)
def test_chase_rewards_equal_the_scalar_loop_and_begin_with_nothing(suite, params):
    engine = world(suite, 3, **params)
    given = params.get("chase", {})
    planar = given.get("space", engine.robot.workspace) == "planar"

    def nearest(i):
        return min(gap(engine.robot.position[i], p, planar) for p in engine.places("targets")[i])

    for step, action in enumerate(actions(engine, 40)):
        if step == 20:  # an episode begins in row 1 alone
            engine.reset(np.array([1]))
        old = [nearest(i) for i in range(3)]
        reward = engine.step(action).reward
        for i in range(3):
            first = step == 0 or (step == 20 and i == 1)
            expected = 0.0 if first else given.get("reward_distance", 1.0) * (old[i] - nearest(i))
            assert reward[i] == pytest.approx(expected, abs=1e-12)


def test_an_arm_chases_with_its_nearest_link():
    engine = world("Chase_Arm3_0Hazards", 2)
    for action in actions(engine, 15):
        engine.step(action)
        targets, measured = engine.places("targets"), engine.task.measure()
        each = engine.robot.clearance(targets, False)
        for i in range(2):
            assert measured[i, 0] == each[i].min()
            far = min(gap(engine.robot.position[i], p, False) for p in targets[i])
            assert measured[i, 0] <= far


@pytest.mark.parametrize(
    ("suite", "params"),
    [
        ("Defense_Point_2Hazards", {}),
        ("Defense_Point_2Ghosts", {"defense": {"num": 5, "radius": 1.0, "reward_outside": 0.3}}),
        ("Defense_Drone_2Hazards", {"defense": {"origin": [0.2, -0.3, 1.0]}}),
    ],
    ids=str,
)
def test_defense_rewards_equal_the_scalar_loop(suite, params):
    engine = world(suite, 3, **params)
    given = params.get("defense", {})
    origin = given.get("origin", [0.0, 0.0])
    outside = set()
    for action in actions(engine, 30):
        engine.places("targets")[..., :2] *= 1.02  # across the circle's border
        reward = engine.step(action).reward
        for i in range(3):
            expected = 0.0
            for p in engine.places("targets")[i]:
                depth = gap(p, origin, True) / given.get("radius", 1.5) - 1
                expected += depth if depth < 0 else given.get("reward_outside", 0.1)
                outside.add(depth >= 0)
            assert reward[i] == pytest.approx(max(expected, -10), abs=1e-12)
    assert outside == {True, False}


@pytest.mark.parametrize(
    ("robot", "size", "height", "fine"),
    [
        ("Point", 0.5, [0.0, 0.59], True),
        ("Ant", 0.2, [0.1, 0.4], False),
    ],
)
def test_a_goal_in_space_hangs_where_a_robot_on_the_floor_gets_to(robot, size, height, fine):
    goal = {"space": "spatial", "size": size, "height": height}
    scenario = Scenario(robot=robot, task_params=goal)
    if fine:
        scenario.build()
    else:
        with pytest.raises(ValueError, match=r"goal.height .* out of reach: .* above the floor"):
            scenario.build()


@pytest.mark.parametrize(
    ("robot", "goal", "size"),
    [
        ("Point", {}, 2),
        ("Point", {"space": "spatial", "height": [0.4, 0.5]}, 3),
        ("Drone", {"space": "planar"}, 3),
    ],
)
def test_compasses_tell_the_height_of_what_hangs_in_the_air(robot, goal, size):
    engine = world(f"Goal_{robot}_0Hazards", goal=goal)
    compass = engine.observe()[0, engine.observation_layout["goal_compass"]]
    origin, rotation = engine.robot.frames
    offset = rotation[0, 0].T @ (engine.task.place[0] - origin[0, 0])
    expected = offset[:size] / (np.linalg.norm(offset[:size]) + 0.001)
    np.testing.assert_allclose(compass, expected, atol=1e-6)


@pytest.mark.parametrize("robot", ["Drone"])
@pytest.mark.parametrize(
    ("defense", "r1"),
    [
        ({"space": "planar"}, 2.0),
        ({"space": "spatial", "height": [0.3, 1.0]}, 2.5),
        ({"space": "spatial", "height": [0.3, 1.0], "r1": 1.0}, 1.0),
    ],
)
def test_targets_of_defense_see_farther_in_space_whatever_the_robot(robot, defense, r1):
    engine = Scenario(robot=robot, task="Defense", task_params=defense).build()
    assert engine.task.motion.r1 == r1


@pytest.mark.parametrize("task", ["Chase", "Defense"])
def test_solid_targets_stop_the_robot_and_others_do_not(task):
    """Driven at a target that keeps still, a Point ends in front of it or on the far side."""
    ends = {}
    for solid in (True, False):
        engine = world(
            f"{task}_Point_0Hazards",
            **{task.lower(): {"solid": solid, "speed": 0.0, "num": 1, "locations": [[0.0, 0.0]]}},
        )
        put_point(engine, -1.0, 0.0)
        touched = 0
        for _ in range(120):
            engine.step(np.array([[1.0, 0.0]]))
            touched += int(solid and engine.task.group.touched[0, 0])
        ends[solid] = float(engine.robot.position[0, 0])
        assert (touched > 0) == solid
    assert -0.6 < ends[True] < -0.35  # radius 0.3, the Point's nose 0.15
    assert ends[False] > 0.3


def test_solid_targets_do_not_hang_in_an_arm_when_an_episode_begins():
    """Low enough for the upper arm to cross: without a look at the contacts one in ten would."""
    engine = world("Chase_Arm6_0Hazards", 8, chase={"solid": True, "height": [1.5, 1.8]})
    for _ in range(10):
        assert not engine.task.group.touched.any()
        engine.reset(np.arange(8))


def press(engine, button):
    """Set the Point down against a button, for one control step."""
    x, y = engine.places("button")[0, button, :2]
    put_point(engine, x - 0.19, y, math.pi)
    return engine.step(np.zeros((1, 2)))


def test_the_lit_button_pays_and_after_the_delay_another_one_is_lit():
    engine = world("Button_Point_0Hazards", seed=1)
    task = engine.task
    lit = int(task.right[0])
    assert (engine.observe()[0, engine.observation_layout["button_lidar"]] > 0).any()
    for wrong in set(range(4)) - {lit}:
        outcome = press(engine, wrong)
        assert task.group.touched[0, wrong] and not outcome.goal_met[0]
        assert task.mistakes()[0] == 1
    outcome = press(engine, lit)
    assert outcome.goal_met[0] and 0.9 < outcome.reward[0] < 1.1
    assert task.right[0] != lit
    lidar = engine.observation_layout["button_lidar"]
    assert (outcome.obs[0, lidar] == 0).all()
    outcome = press(engine, lit)  # pressing counts for nothing
    assert not outcome.goal_met[0] and task.mistakes()[0] == 0
    assert (outcome.obs[0, lidar] == 0).all()


@pytest.mark.parametrize("delay", [0, 1])
def test_the_delay_is_counted_as_safety_gym_counts_it(delay):
    """Safety Gym's step: charge by the timer, tick it, and set it when the button is pressed."""
    engine = world("Button_Point_0Buttons", button={"delay": delay, "num": 2}, seed=1)
    task, lidar = engine.task, engine.observation_layout["button_lidar"]
    timer, uncounted, dark = 0, 0, 0
    for step in range(4 * delay + 8):
        right = int(task.right[0])
        pressed = right if step % 2 else 1 - right
        outcome = press(engine, pressed)
        counts = timer == 0
        timer = max(timer - 1, 0)
        assert outcome.cost[0] == (counts and pressed != right)
        assert outcome.goal_met[0] == (counts and pressed == right)
        if outcome.goal_met[0]:
            timer = delay
        assert (outcome.obs[0, lidar] > 0).any() == (timer == 0)
        uncounted, dark = uncounted + (not counts), dark + (timer > 0)
    assert uncounted >= 2 * delay and dark >= 2 * delay


def test_button_rewards_equal_the_scalar_loop():
    engine = world("Button_Point_2Hazards", 3, button={"num": 3, "reward_distance": 2.0})
    for action in actions(engine, 40):
        goal = engine.task.goal.copy()
        old = [gap(engine.robot.position[i], goal[i], True) for i in range(3)]
        outcome = engine.step(action)
        for i in range(3):
            new = gap(engine.robot.position[i], goal[i], True)
            expected = 2.0 * (old[i] - new) + outcome.goal_met[i]
            assert outcome.reward[i] == pytest.approx(expected, abs=1e-12)


TAXONOMY = {  # interactive, contact, targets, spaces
    "Goal": (False, False, "one", ("planar", "spatial")),
    "Push": (True, True, "one", ("planar",)),
    "Chase": (True, False, "many", ("planar", "spatial")),
    "Defense": (True, False, "many", ("planar", "spatial")),
    "Button": (False, True, "one", ("planar",)),
}


def test_tasks_state_the_papers_taxonomy():
    stated = {n: (t.interactive, t.contact, t.targets, t.spaces) for n, t in guard(TASKS).items()}
    assert stated == TAXONOMY


@pytest.mark.parametrize(
    ("task", "params", "words"),
    [
        ("push", {"object": "cube"}, r"push.object = 'cube'.*ball"),
        ("chase", {"speed_law": "units"}, r"did you mean 'unit'\?"),
    ],
)
def test_bad_parameters_are_named(task, params, words):
    with pytest.raises(ValueError, match=words):
        Scenario(task=task.capitalize(), task_params=params)


@pytest.mark.parametrize(
    ("suite", "params"),
    [
        ("Push_Point_3Pillars", {"push": {"object": "box"}}),
        ("Button_Point_3Gremlins", {"button": {"delay": 2}}),
        pytest.param("Button_Point_3Buttons", {}, marks=SLOW),
        pytest.param("Chase_Point_3Ghosts", {"chase": {"solid": True}}, marks=SLOW),
        pytest.param(
            "Defense_Drone_3Ghosts",
            {"defense": {"solid": True, "speed_law": "proportional"}},
            marks=SLOW,
        ),
    ],
    ids=str,
)
def test_rows_of_a_batch_are_lone_environments_bit_for_bit(suite, params):
    assert_rows_are_lone_environments(suite, **params)

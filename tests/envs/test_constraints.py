"""Constraints: costs against scalar loops and MuJoCo's own contacts, and bodies that behave."""

import math

import mujoco
import numpy as np
import pytest
from worlds import (
    actions,
    assert_rows_are_lone_environments,
    contacts,
    free_body,
    put_point,
    touching,
    world,
)

from sb3_guard.envs import Scenario
from sb3_guard.envs.registry import CONSTRAINTS, guard

FORWARD = np.array([[1.0, 0.0]])
SLOW = pytest.mark.slow  # further cases of a promise that another case keeps
OTHERS = ("Point", "Swimmer", "Doggo", "Arm3", "Drone")


@pytest.mark.parametrize(
    ("suite", "params", "indicator"),
    [
        ("Goal_Point_6Hazards", {"weight": 2.0}, False),
        ("Goal_Point_6Ghosts", {"size": 0.5, "weight": 0.5}, True),
        ("Goal_Drone_6Ghosts", {"height": [0.9, 1.1]}, False),
        ("Goal_Drone_6Hazards", {"space": "planar"}, False),
        ("Goal_Ant_6Hazards", {"space": "spatial", "height": [0.1, 0.3]}, True),
    ],
    ids=str,
)
def test_zone_costs_equal_the_scalar_loop(suite, params, indicator):
    """Zones are set down around the robot, so that some reach it and some do not."""
    name = suite.split("6")[1].lower()
    engine = world(suite, 4, **{name: {**params, "indicator": indicator}})
    zones, size = engine.places(name), params.get("size", 0.3)
    planar = params.get("space", engine.robot.workspace) == "planar"
    rng, kinds = np.random.default_rng(0), set()
    for action in actions(engine, 25):
        zones[..., :2] = engine.robot.position[:, None, :2] + rng.uniform(-0.8, 0.8, (4, 6, 2))
        outcome = engine.step(action)
        for i in range(4):
            expected = 0.0
            for zone in zones[i]:
                d = 2 if planar else 3
                depth = size - math.dist(engine.robot.position[i][:d], zone[:d])
                expected += params.get("weight", 1.0) * depth if depth > 0 else 0.0
            kinds.add(expected > 0)
            expected = float(expected > 0) if indicator else expected
            assert outcome.cost[i] == pytest.approx(expected, abs=1e-12)
            assert outcome.costs[f"cost_{name}"][i] == outcome.cost[i]
    assert kinds == {True, False}


SOLID = {
    "pillars": {},
    "buttons": {},
    "gremlins": {"travel": 0.0},
    "ghosts": {"solid": True, "speed": 0.0, "size": 0.2},
    "vases": {"velocity_weight": 0.0},
}


@pytest.mark.parametrize("name", SOLID)
def test_what_is_driven_into_is_felt_and_costs_once(name):
    """No cost on the way, then 1 a step, whatever the number of contact points."""
    engine = world(
        f"Goal_Point_0{name.capitalize()}",
        **{name: {**SOLID[name], "num": 2, "locations": [[0.0, 0.0], [1.0, 1.0]]}},
    )
    put_point(engine, -0.7, 0.0)
    costs, points = [], 0
    for _ in range(60):
        cost = engine.step(FORWARD).cost[0]
        assert cost == float(f"{name}/0" in contacts(engine, 0))
        costs.append(cost)
        points = max(points, engine.batch.get_data(0).ncon)
    assert set(costs) == {0.0, 1.0}
    assert not any(costs[: costs.index(1.0)]) and costs.index(1.0) > 5
    if name != "vases":  # the others do not give way
        assert all(costs[-10:]) and engine.robot.position[0, 0] < 0


def test_only_the_robot_is_felt():
    """A ball that lies against a pillar, and vases that touch each other, cost nothing."""
    engine = world(
        "Push_Point_1Pillars",
        push={"object_locations": [[-1.0, 0.0]]},
        pillars={"locations": [[0.0, 0.0]]},
        vases={"num": 1, "locations": [[1.0, 0.0]]},
    )
    put_point(engine, 1.5, 1.5)
    pose, _ = free_body(engine, "ball/0")
    pose[0, :2] = [-0.3999, 0.0]
    vase, _ = free_body(engine, "vases/0")
    vase[0, :2] = [0.299, 0.0]
    engine.batch.forward()
    data, model = engine.batch.get_data(0), engine.model
    pairs = [{model.body(int(model.geom_bodyid[g])).name for g in c} for c in data.contact.geom]
    assert {"ball/0", "pillars/0"} in pairs and {"vases/0", "pillars/0"} in pairs
    assert engine.constraints[0].cost()[0] == 0 and touching(engine, 0) == set()


@pytest.mark.parametrize("robot", ["Ant", *(pytest.param(r, marks=SLOW) for r in OTHERS)])
def test_sensors_agree_with_the_contacts_of_every_part_of_the_robot(robot):
    """A crowd of everything solid, sensors against MuJoCo's list of contacts."""
    props = {
        "pillars": {"num": 3, "size": 0.1, "keepout": 0.1},
        "buttons": {"num": 3, "keepout": 0.1},
        "gremlins": {"num": 3, "keepout": 0.2, "travel": 0.05},
        "vases": {"num": 3, "keepout": 0.15},
    }
    engine = world(
        f"Goal_{robot}_3Ghosts",
        3,
        robot={"keepout": 0.3},
        ghosts={"solid": True, "r1": 0.0, "speed": 0.01, "space": "planar", "size": 0.2,
                "keepout": 0.2},
        layout={"placements": [[-1.2, -1.2, 1.2, 1.2]]},
        goal={"keepout": 0.1},
        **props,
    )  # fmt: skip
    felt = 0
    for action in actions(engine, 120):
        if robot == "Point":
            action[:, 0] = 1.0
        elif robot == "Drone":
            action[:] = -1.0  # it falls among them
        outcome = engine.step(action)
        for i in range(3):
            bodies = contacts(engine, i)
            assert touching(engine, i) == bodies
            felt += len(bodies)
            for name in ("pillars", "buttons", "gremlins", "ghosts"):
                expected = sum(b.startswith(name) for b in bodies)
                assert outcome.costs[f"cost_{name}"][i] == expected
    assert felt > 10


@pytest.mark.parametrize("robot", ["Point", "Swimmer"])
def test_vases_stand_still_until_they_are_pushed(robot):
    """Small and large time step: no speed of their own that would cost."""
    engine = world(f"Goal_{robot}_8Vases", 2)
    vases = engine.constraints[0].group
    before = vases.centers.copy()
    for _ in range(50):
        assert engine.step(np.zeros((2, engine.robot.action_size))).cost.sum() == 0
    np.testing.assert_allclose(vases.centers, before, atol=1e-6)
    assert np.abs(vases.velocities).max() < 1e-6


def test_vase_costs_equal_the_scalar_loop():
    engine = world(
        "Goal_Point_2Vases",
        vases={
            "locations": [[0.0, 0.0], [1.5, 1.5]],
            "weight": 3.0,
            "displacement_weight": 5.0,
            "velocity_weight": 7.0,
        },
    )
    put_point(engine, -0.6, 0.0)
    poses = [free_body(engine, f"vases/{i}") for i in range(2)]
    kinds = set()
    for _ in range(80):
        cost = engine.step(FORWARD).cost[0]
        expected = 0.0
        for i, (pose, velocity) in enumerate(poses):
            touch = f"vases/{i}" in contacts(engine, 0)
            moved = math.dist(pose[0, :2], engine.places("vases")[0, i, :2])
            speed = math.hypot(*velocity[0, :3])
            kinds |= {("touch", touch), ("moved", moved > 1e-3), ("speed", speed >= 1e-4)}
            expected += 3.0 * touch + 5.0 * moved * (moved > 1e-3) + 7.0 * speed * (speed >= 1e-4)
        assert cost == pytest.approx(expected, abs=1e-9)
    assert len(kinds) == 6
    assert poses[0][0][0, 0] > 0.1  # it was pushed


def test_gremlins_circle_by_the_simulated_clock():
    """§5: travel · (sin t, cos t) around their places; a step shows the time it began at."""
    engine = world("Goal_Swimmer_3Gremlins", 2, gremlins={"travel": 0.25, "rate": 1.5})
    places, bodies = engine.places("gremlins"), engine.constraints[0].group
    control_step = 10 * engine.model.opt.timestep
    np.testing.assert_allclose(bodies.centers - places, [[[0, 0.25, 0]] * 3] * 2, atol=1e-12)
    for step in range(30):
        if step == 11:
            engine.reset(np.array([1]))
        engine.step(np.zeros((2, 2)))
        for i, k in enumerate((step, step - 11 if step >= 11 else step)):
            t = 1.5 * k * control_step
            circle = [0.25 * math.sin(t), 0.25 * math.cos(t), 0.0]
            np.testing.assert_allclose(bodies.centers[i] - places[i], [circle] * 3, atol=1e-9)


@pytest.mark.parametrize("solid", [False, True])
def test_solid_ghosts_push_a_passive_robot_and_others_pass_through_it(solid):
    engine = world(
        "Goal_Point_1Ghosts",
        goal={"locations": [[-1.5, 1.5]]},
        ghosts={"solid": solid, "speed": 0.01, "r1": 0.0, "locations": [[0.6, 0.0]]},
    )
    put_point(engine, -0.4, 0.0)
    felt = 0
    for _ in range(150):
        outcome = engine.step(np.zeros((1, 2)))
        felt += outcome.cost[0] > 0
    assert felt > 5
    moved = math.dist(engine.robot.position[0, :2], (-0.4, 0.0))
    if solid:
        assert moved > 0.1
        assert outcome.costs["cost_ghosts"][0] in (0.0, 1.0)
    else:
        assert moved < 1e-6 and outcome.cost[0] == pytest.approx(0.3, abs=0.02)
        assert engine.model.nbody == 3  # no bodies but world, spawn and robot


def test_any_mixture_and_several_of_one_type():
    scenario = Scenario(
        constraints={
            "hazards": {"num": 2, "weight": 2.0},
            "pits": {"type": "hazards", "num": 3, "size": 0.2},
            "ghosts": {"num": 2},
            "guards": {"type": "ghosts", "num": 2, "solid": True, "keepout": 0.3},
            "pillars": {"num": 2},
            "posts": {"type": "pillars", "num": 1, "size": 0.05, "keepout": 0.1},
            "vases": {"num": 2},
            "buttons": {"num": 1},
            "gremlins": {"num": 1},
        }
    )
    engine = scenario.build(2)
    engine.reset(np.arange(2))
    names = set(scenario.constraints)
    assert {f"{n}_lidar" for n in names} <= set(engine.channels)
    assert engine.observer.size == 14 + 16 * len(names)
    for action in actions(engine, 50):
        outcome = engine.step(action)
        assert set(outcome.costs) == {f"cost_{n}" for n in names}
        np.testing.assert_allclose(outcome.cost, sum(outcome.costs.values()), atol=1e-12)


def test_names_of_bodies_are_not_given_twice():
    with pytest.raises(ValueError, match="two parts have bodies called 'ball'"):
        Scenario(task="Push", constraints={"ball": {"type": "pillars"}}).build()


COVER = {  # parameters, and the radius that an object of that size takes up, m
    "pillars": ({"size": 0.5}, 0.5),
    "buttons": ({"size": 0.4}, 0.4),
    "vases": ({"size": 0.2}, 0.2 * math.sqrt(2)),
    "gremlins": ({"size": 0.2, "travel": 0.4}, 0.4 + 0.2 * math.sqrt(2)),
    "ghosts": ({"size": 0.6, "solid": True}, 0.6),
}


@pytest.mark.parametrize("name", COVER)
def test_solid_objects_never_begin_inside_each_other(name):
    params, cover = COVER[name]
    few = {"num": 3, **params}
    engine = Scenario(constraints={name: few}).build()
    assert engine.footprints[name].keepout == pytest.approx(cover)
    with pytest.raises(ValueError, match=rf"{name}.keepout = .* at least 0\.\d"):
        Scenario(constraints={name: {**few, "keepout": cover - 0.001}}).build()
    allowed = Scenario(constraints={name: {**few, "keepout": 0.0}}, layout={"overlap": True})
    assert allowed.build().footprints[name].keepout == 0.0
    engine.reset(np.zeros(1, dtype=int))
    model, data = engine.model, engine.batch.get_data(0)
    geoms = [model.body(f"{name}/{i}").geomadr[0] for i in range(3)]
    for i in range(3):
        for j in range(i):
            assert mujoco.mj_geomDistance(model, data, geoms[i], geoms[j], 1.0, None) > 0


def test_zones_may_overlap_and_usual_sizes_keep_their_usual_distance():
    zones = {"hazards": {"size": 1.0, "keepout": 0.0}, "ghosts": {"keepout": 0.1}}
    Scenario(constraints=zones).build()
    usual = {"hazards": 0.4, "ghosts": 0.5, "vases": 0.15, "pillars": 0.3, "buttons": 0.3,
             "gremlins": 0.5}  # fmt: skip
    engine = Scenario(constraints={name: {"num": 1} for name in usual}).build()
    assert {name: engine.footprints[name].keepout for name in usual} == usual


def test_what_hangs_in_the_air_can_be_met():
    """Zones that a robot on the floor would never enter are refused."""

    def build(robot, **params):
        Scenario(robot=robot, constraints={"ghosts": params}).build()

    for kind in ("hazards", "ghosts"):
        zones = {kind: {"space": "spatial", "height": [0.4, 1.0]}}
        with pytest.raises(ValueError, match=rf"{kind}.height .* between 0.00 and 0.40 m count"):
            Scenario(constraints=zones).build()
        zones[kind]["height"] = [0.39, 1.0]
        Scenario(constraints=zones).build()
    build("Humanoid", space="spatial", height=[1.0, 2.0])
    build("Point", space="spatial", solid=True)
    build("Drone", height=[0.1, 1.0])


def test_parts_of_one_name_are_refused():
    from sb3_guard.envs.constraints import Hazards, Pillars
    from sb3_guard.envs.engine import Engine
    from sb3_guard.envs.robots.guard import Point
    from sb3_guard.envs.tasks import Goal

    with pytest.raises(ValueError, match="two parts are called 'pillars'"):
        Engine(Point(), Goal(), [Pillars(num=1), Pillars(num=1)])
    scenario = Scenario(task="Chase", constraints={"targets": {"type": "hazards"}})
    with pytest.raises(ValueError, match="targets and chase both place 'targets'"):
        scenario.build(1)
    assert Engine(Point(), Goal(), [Hazards(), Pillars(num=1)]).num_envs == 1


def test_wrong_buttons_of_a_button_task_cost():
    engine = world("Button_Point_0Buttons", buttons={"weight": 2.0})
    task = engine.task
    right = int(task.right[0])
    wrong = [b for b in range(4) if b != right]
    # pressing the right one starts the delay, in which nothing is wrong
    for button, expected in [*((b, 2.0) for b in wrong), (right, 0.0), *((b, 0.0) for b in wrong)]:
        x, y = engine.places("button")[0, button, :2]
        put_point(engine, x - 0.19, y, math.pi)
        assert engine.step(np.zeros((1, 2))).cost[0] == expected
        assert task.group.touched[0].tolist() == [b == button for b in range(4)]


def test_indicator_counts_any_touch_once():
    close = {"num": 2, "locations": [[0.0, 0.18], [0.0, -0.18]], "size": 0.17, "keepout": 0.17}
    engines = [
        world("Goal_Point_0Pillars", pillars={**close, "indicator": i}) for i in (False, True)
    ]
    sums = []
    for engine in engines:
        put_point(engine, -0.7, 0.0)
        sums.append([engine.step(FORWARD).cost[0] for _ in range(60)])
    assert max(sums[0]) == 2.0 and max(sums[1]) == 1.0
    np.testing.assert_array_equal(np.array(sums[0]) > 0, np.array(sums[1]) == 1)


TAXONOMY = {  # trespassable, movable, spaces
    "Hazards": (True, "no", ("planar", "spatial")),
    "Ghosts": (True, "active", ("planar", "spatial")),
    "Vases": (False, "passive", ("planar",)),
    "Pillars": (False, "no", ("planar",)),
    "Buttons": (False, "no", ("planar",)),
    "Gremlins": (False, "active", ("planar",)),
}


def test_constraints_state_the_papers_taxonomy():
    stated = {n: (c.trespassable, c.movable, c.spaces) for n, c in guard(CONSTRAINTS).items()}
    assert stated == TAXONOMY
    assert all(c.trespassable == (not c.solid) for c in guard(CONSTRAINTS).values())


@pytest.mark.parametrize(
    ("name", "params", "words"),
    [
        ("ghosts", {"size": "big"}, r"ghosts.size = 'big' must be a number"),
        ("ghosts", {"sped": 1.0}, r"no parameter 'sped': did you mean 'speed'\?"),
        ("hazards", {"height": [-2, -1]}, r"hazards.height = \(-2, -1\) must be at least 0"),
        ("a b/", {"type": "hazards"}, r"constraint 'a b/': .* letters, digits"),
        ("goal", {"type": "hazards"}, r"constraint 'goal': .* mean other parts"),
        ("hazards", 8, r"constraint 'hazards' = 8 must be a mapping"),
        ("pillars", {"height": [0, 1]}, r"no parameter 'height': did you mean"),
        ("walls", {}, r"unknown constraint 'walls'"),
    ],
)
def test_bad_parameters_are_named(name, params, words):
    with pytest.raises(ValueError, match=words):
        Scenario(constraints={name: params})


@pytest.mark.parametrize(
    ("suite", "params"),
    [
        ("Goal_Point_3Vases", {"gremlins": {"num": 2}, "ghosts": {"solid": True, "num": 3}}),
        pytest.param("Goal_Ant_3Pillars", {"buttons": {"num": 2}}, marks=SLOW),
        pytest.param("Goal_Drone_3Ghosts", {"ghosts": {"solid": True, "speed": 0.01}}, marks=SLOW),
        pytest.param(
            "Chase_Arm3_2Ghosts",
            {"hazards": {"num": 2}, "pits": {"type": "hazards", "num": 1}},
            marks=SLOW,
        ),
    ],
    ids=str,
)
def test_rows_of_a_batch_are_lone_environments_bit_for_bit(suite, params):
    assert_rows_are_lone_environments(suite, **params)


def test_what_moves_continues_from_a_saved_state():
    params = {"ghosts": {"solid": True}, "gremlins": {"num": 2}, "vases": {"num": 2}}
    engine = world("Button_Point_2Ghosts", 3, **params)
    for action in actions(engine, 20):
        engine.step(action)
    state = engine.state()
    twin = world("Button_Point_2Ghosts", 3, seed=50, num_threads=2, **params)
    twin.restore(state)
    for action in actions(engine, 30, seed=1):
        a, b = engine.step(action), twin.step(action)
        np.testing.assert_array_equal(a.obs, b.obs)
        np.testing.assert_array_equal(a.cost, b.cost)

"""Ghosts and targets move by the law, written out here as a scalar loop, and by nothing else."""

import math

import numpy as np
import pytest

from sb3_guard.envs import Scenario, motion

KINDS = {
    "ghosts": {"far": 0.0012},
    "chase": {"near": -0.011},
    "defense": {"near": -0.011, "settle": 0.0007},
}


def advance(points, robot, law, planar):
    motion.MoverGroup([motion.Moving(points, law, planar)]).advance(robot)


def unit(v):
    length = math.sqrt(sum(x * x for x in v))
    return [x / length if length else 0.0 for x in v]


def scalar_law(kind, points, robot, planar, unit_law, v0, v1, v2, apart, gap, r0, r1, origin):
    """One control step of one row: new positions, one mover and one coordinate at a time."""
    size, out = 2 if planar else 3, []
    for p in points:
        d_r = [robot[j] - p[j] for j in range(size)]
        d_o = [origin[j] - p[j] for j in range(2 if planar or unit_law else 3)]
        v = [0.0] * 3
        if unit_law:
            for q in points:
                away = [p[j] - q[j] for j in range(size)]
                if 0 < math.hypot(*away) < gap:
                    for j, e in enumerate(unit(away)):
                        v[j] += apart * e
        near = math.hypot(*d_r) <= r1
        if math.hypot(*d_o) > r0:
            pulls = [(v0, d_o)]
        elif kind == "ghosts":
            pulls = [] if near else [(v1, d_r)]
        elif kind == "chase":
            pulls = [(-v1, d_r)] if near else []
        else:
            pulls = [(-v1, d_r)] if near else [(v2, d_o)]
        for speed, d in pulls:
            for j, e in enumerate(unit(d) if unit_law else d):
                v[j] += speed * e
        out.append([p[j] + v[j] for j in range(3)])
    return out


@pytest.mark.parametrize("unit_law", [True, False])
@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_the_law_equals_the_scalar_loop(kind, planar, unit_law):
    rng = np.random.default_rng(0)
    n, k, r0, r1, origin = 40, 5, 1.2, 1.0, (0.2, -0.1, 0.5)
    points = rng.uniform([-1.5, -1.5, 0.5], [1.5, 1.5, 1.5], (n, k, 3))
    robot = rng.uniform(-1, 1, (n, 3))
    speeds = {"near": 0.0, "far": 0.0, "settle": 0.0, **KINDS[kind]}
    law = motion.Law(
        **speeds, home=0.002, apart=0.003, gap=0.6, r0=r0, r1=r1, origin=origin, unit=unit_law
    )
    v1 = abs(speeds["near"] + speeds["far"])
    for _ in range(3):
        settle = speeds["settle"]
        rule = (planar, unit_law, 0.002, v1, settle, 0.003, 0.6, r0, r1, origin)
        expected = [
            scalar_law(kind, p, r, *rule)
            for p, r in zip(points.tolist(), robot.tolist(), strict=True)
        ]
        advance(points, robot, law, planar)
        np.testing.assert_allclose(points, expected, rtol=0, atol=1e-14)


def test_a_mover_on_the_spot_stays_and_movers_on_one_spot_do_not_part():
    """The unit vector of a zero offset is zero."""
    points = np.zeros((1, 2, 3))
    law = motion.Law(far=1e-3, near=-1e-3, settle=1e-3, apart=1e-3, gap=0.6, r1=1.0)
    advance(points, np.zeros((1, 3)), law, planar=False)
    np.testing.assert_array_equal(points, 0.0)


@pytest.mark.parametrize("planar", [True, False])
def test_at_r0_and_r1_movers_are_within_and_at_the_gap_apart(planar):
    law = motion.Law(near=1 / 8, far=1 / 4, home=1 / 2, apart=1, gap=1 / 4, r0=1.0, r1=1 / 2)
    where = {  # x -> where from there
        0.5: 0.625,  # at r1 of a robot at 1: near
        0.25: 0.5,  # beyond: far
        1.0: 1.0,  # at r0: not home
        1.25: 0.75,  # beyond: home
    }
    for x, expected in where.items():
        points = np.array([[[x, 0.0, 0.0]]])
        advance(points, np.array([[1.0, 0.0, 0.0]]), law, planar)
        assert points[0, 0, 0] == expected, x
    still = motion.Law(apart=1 / 8, gap=1 / 4)
    for gap, moved in ((1 / 4, 0.0), (1 / 8, 1 / 8)):
        points = np.array([[[0.0, 0.0, 0.0], [gap, 0.0, 0.0]]])
        advance(points, np.zeros((1, 3)), still, planar)
        np.testing.assert_array_equal(points[0, :, 0], [-moved, gap + moved])


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("k", [1, 8])
def test_rows_do_not_depend_on_each_other(k, planar):
    rng = np.random.default_rng(1)
    points, robot = rng.uniform(-1, 1, (5, k, 3)), rng.uniform(-1, 1, (5, 3))
    law = motion.Law(near=-0.01, far=0.01, settle=0.02, home=0.01, apart=0.01, gap=0.9, r0=1, r1=1)
    lone = points.copy()
    for _ in range(20):
        advance(points, robot, law, planar)
        for i in range(5):
            advance(lone[i : i + 1], robot[i : i + 1], law, planar)
    np.testing.assert_array_equal(points, lone)


@pytest.mark.parametrize("planar", [True, False])
def test_groups_that_move_together_move_as_each_alone(planar):
    rng = np.random.default_rng(2)
    laws = [
        motion.Law(near=-0.03, home=0.01, apart=0.01, gap=0.9, r0=1, r1=1, origin=(0.1, 0.2, 0.3)),
        motion.Law(far=0.02, home=0.02, r0=0.8, r1=0.5),  # nothing keeps these apart
        motion.Law(settle=0.02, home=0.01, apart=0.02, gap=0.5, r0=1.5, r1=0.5),
    ]
    groups = [motion.Moving(rng.uniform(-1, 1, (4, 3, 3)), law, planar) for law in laws]
    alone = [motion.Moving(g.points.copy(), g.law, planar) for g in groups]
    nobody = motion.Moving(np.zeros((4, 0, 3)), laws[0], planar)
    (together,) = motion.grouped([*groups, nobody])
    for _ in range(30):
        robot = rng.uniform(-1, 1, (4, 3))
        together.advance(robot)
        for group, own in zip(groups, alone, strict=True):
            motion.MoverGroup([own]).advance(robot)
            np.testing.assert_array_equal(group.points, own.points)


def test_movers_by_other_laws_of_speed_are_groups_of_their_own():
    points = np.zeros((1, 1, 3))
    kinds = [(p, u) for p in (True, False) for u in (True, False)]
    moving = [motion.Moving(points, motion.Law(unit=u), p) for p, u in kinds for _ in range(2)]
    assert len(motion.grouped(moving)) == 4


# task or constraint -> defaults of v0, v1, v2, apart, gap, r0, r1 in the plane and in space
DEFAULTS = {
    "ghosts": {"v0": 1e-3, "v1": 1e-3, "v2": 0, "r0": 2.5, "r1": (1.5, 1.5)},
    "chase": {"v0": 1e-3, "v1": 1e-2, "v2": 0, "r0": 2.0, "r1": (3.0, 3.0)},
    "defense": {"v0": 1e-3, "v1": 1e-2, "v2": 1e-3, "r0": 2.0, "r1": (2.0, 2.5)},
}
ORIGIN = (0.3, 0.0, 0.9)


def movers(suite, **params):
    """Three rows of a suite, and the part and the places of its movers."""
    engine = Scenario.parse(suite).override(**params).build(3, num_threads=1)
    for i in range(3):
        engine.seed(i, np.random.default_rng(i))
    engine.reset(np.arange(3))
    kind = "ghosts" if "ghosts" in engine.footprints else engine.task.name
    part = engine.task if kind != "ghosts" else engine.constraints[0]
    return engine, kind, part, engine.places("ghosts" if kind == "ghosts" else "targets")


@pytest.mark.parametrize(
    ("suite", "params"),
    [
        ("Goal_Point_6Ghosts", {"ghosts": {"speed_law": "proportional", "origin": ORIGIN}}),
        ("Goal_Point_6Ghosts", {"ghosts": {"solid": True, "speed": 0.004}}),
        ("Goal_Drone_6Ghosts", {"ghosts": {"speed_law": "proportional", "v1": 0.02, "r0": 1.5}}),
        ("Goal_Drone_6Ghosts", {"ghosts": {"space": "planar"}}),
        ("Chase_Drone_0Hazards", {"chase": {"num": 5, "speed_law": "proportional"}}),
        ("Chase_Point_0Hazards", {"chase": {"num": 1, "v1": 0.03, "solid": True}}),
        ("Defense_Drone_0Hazards", {"defense": {"v2": 0.03, "speed_law": "proportional"}}),
        ("Defense_Point_0Hazards", {"defense": {"r1": 0.5, "v2": 0.01, "origin": ORIGIN}}),
    ],
    ids=str,
)
def test_movers_of_an_environment_follow_the_law_from_what_was_last_observed(suite, params):
    engine, kind, part, places = movers(suite, **params)
    given = next(iter(params.values()), {})
    d = DEFAULTS[kind]
    factor = given.get("speed", 1e-3) / 1e-3
    spatial = engine.robot.workspace == "spatial"
    planar = given.get("space", engine.robot.workspace) == "planar"
    law = {
        **{v: given.get(v, factor * d[v]) for v in ("v0", "v1", "v2")},
        "r0": given.get("r0", d["r0"]),
        "r1": given.get("r1", d["r1"][spatial]),
        "origin": given.get("origin", (0, 0, 0)),
    }
    unit_law = given.get("speed_law", "unit") == "unit"
    rng = np.random.default_rng(0)
    for step in range(40):
        if step == 20:  # far out, close by and in a heap: every branch of the law
            places[:, 0, :2] = [1.9, 1.9]
            places[:, -1, :2] = engine.robot.position[:, :2] + 0.1
            if places.shape[1] > 2:
                places[:, 1, :2] = places[:, 2, :2] + 0.05
        before, robot = places.copy(), engine.robot.position.copy()
        engine.step(rng.uniform(-1, 1, (3, engine.robot.action_size)))
        for i in range(3):
            new = np.array(
                scalar_law(
                    kind, before[i].tolist(), robot[i].tolist(), planar, unit_law,
                    apart=1e-3 * factor, gap=0.6, **law,
                )
            )  # fmt: skip
            if not planar:
                new[:, 2] = new[:, 2].clip(0.5, 1.5)
            np.testing.assert_allclose(places[i], new, rtol=0, atol=1e-14)
        if part.solid:
            first, k = engine.model.body(f"{part.group.name}/0").id, places.shape[1]
            bodies = engine.batch.bind("xpos")[:, first : first + k]
            np.testing.assert_array_equal(bodies, places)


def test_in_space_z_stays_within_its_range():
    engine, _, _, places = movers("Goal_Drone_4Ghosts", ghosts={"speed": 0.05, "r1": 0.0})
    up = np.ones((3, 4))
    heights = []
    for _ in range(100):
        engine.step(up)
        heights.append(places[..., 2].copy())
    assert np.min(heights) >= 0.5 and np.max(heights) == 1.5
    assert engine.robot.position[:, 2].min() > 2


def test_default_ghosts_wait_outside_a_passive_robot():
    """They stop at r1 = 1.5 m: a robot that does not move pays nothing."""
    engine, _, part, _ = movers("Goal_Point_8Ghosts")
    for _ in range(400):
        assert engine.step(np.zeros((3, 2))).cost.sum() == 0
    assert part.movable == "active"

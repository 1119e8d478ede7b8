"""Layouts: the rule, the distribution, fixed places, heights, reach and errors."""

import math

import numpy as np
import pytest
from scipy import stats

from sb3_guard.envs import Scenario
from sb3_guard.envs.layout import Footprint, LayoutError, arrange, redraw

ARENA = ((-2.0, -2.0, 2.0, 2.0),)


def footprints(task="goal", ghosts=8):
    parts = [Footprint("robot", 1, 0.4, ARENA)]
    if task == "goal":
        parts.append(Footprint("goal", 1, 0.4, ARENA))
    else:
        parts.append(Footprint("targets", 2, 0.5, ARENA, mover=True))
    return [*parts, Footprint("ghosts", ghosts, 0.5, ARENA, mover=True)]


def sequential(parts, rng):
    """Blind sampling: at most 100 draws for each object in turn, else all over again."""
    while True:
        placed = []
        for f in parts:
            for _ in range(f.num):
                low, high = -2 + f.keepout, 2 - f.keepout
                for x, y in rng.uniform(low, high, (100, 2)):
                    if all(math.hypot(x - a, y - b) >= f.keepout + k for a, b, k in placed):
                        placed.append((x, y, f.keepout))
                        break
                else:
                    break
            else:
                continue
            break
        else:
            return np.array(placed)[:, :2]


def check(parts, layout):
    """Every pair keeps its keep-outs and the greater margin, every centre its own keep-out from the
    border."""
    placed = [(*place[:2], f) for f in parts for place in layout[f.name].tolist()]
    for i, (x, y, f) in enumerate(placed):
        for a, b, other in placed[:i]:
            gap = f.keepout + other.keepout + max(f.margin, other.margin)
            assert math.hypot(x - a, y - b) >= gap - 1e-12
        assert any(
            x0 + f.keepout <= x <= x1 - f.keepout and y0 + f.keepout <= y <= y1 - f.keepout
            for x0, y0, x1, y1 in f.placements
        )
        assert not f.out_of_reach(np.array([[x], [y]]))[0]


@pytest.mark.parametrize(
    "parts",
    [
        footprints(),
        footprints("chase"),
        [Footprint("robot", 1, 0.4, ARENA, ((0.0, 0.0),)), Footprint("zones", 9, 0.4, ARENA)],
        [Footprint("near", 6, 0.3, ARENA, reach=1.0), Footprint("far", 4, 0.3, ARENA, margin=0.1)],
        [
            Footprint("strips", 5, 0.1, ((-2, -2, -1, 2), (1, -2, 2, 2))),
            Footprint("blocks", 3, 0.4, ARENA),
        ],
        [Footprint("none", 0, 0.4, ARENA), Footprint("one", 1, 0.4, ARENA)],
    ],
    ids=["goal", "chase", "fixed", "reach", "rectangles", "empty"],
)
def test_layouts_obey_the_rule(parts):
    rng = np.random.default_rng(0)
    for _ in range(50):
        check(parts, arrange(parts, rng))


def features(layouts):
    """Of [L, K, 2] layouts: coordinates of robot, goal and ghosts; nearest distances of ghosts."""
    gaps = np.linalg.norm(layouts[:, :, None] - layouts[:, None], axis=-1)
    gaps[:, np.arange(gaps.shape[1]), np.arange(gaps.shape[1])] = np.inf
    return {
        "robot |x|": np.abs(layouts[:, 0]).ravel(),
        "second |x|": np.abs(layouts[:, 1]).ravel(),
        "ghosts |x|": np.abs(layouts[:, 2:]).ravel(),
        "robot to ghost": gaps[:, 0, 2:].min(axis=1),
        "second to ghost": gaps[:, 1, 2:].min(axis=1),
        "nearest": gaps[:, 2:].min(axis=2).ravel(),
    }


def difference(task, count):
    """Kolmogorov-Smirnov distance of each feature between :func:`arrange` and the reference."""
    parts, rng = footprints(task), np.random.default_rng(0)
    ours = np.array(
        [np.concatenate(list(arrange(parts, rng).values()))[:, :2] for _ in range(count)]
    )
    reference = np.array([sequential(parts, rng) for _ in range(count)])
    ours, reference = features(ours), features(reference)
    return {k: stats.ks_2samp(ours[k], reference[k]).statistic for k in ours}


@pytest.mark.slow
def test_the_distribution_is_close_to_that_of_sequential_sampling():
    """Goal with eight ghosts: distances of 0.03 to 0.08 over 3000 layouts; 400 add noise."""
    measured = difference("goal", 400)
    print({name: round(float(d), 3) for name, d in measured.items()})
    assert max(measured.values()) < 0.13


def test_a_single_object_is_uniform_over_its_rectangles():
    """Two rectangles of room 1.8 × 3.8 and 0.8 × 3.8 m: shares of 9 to 4."""
    f = Footprint("one", 1, 0.1, ((-2, -2, 0, 2), (1, -2, 2, 2)))
    rng = np.random.default_rng(0)
    xy = np.array([arrange([f], rng)["one"][0, :2] for _ in range(2000)])
    left = xy[:, 0] < 0
    assert left.mean() == pytest.approx(9 / 13, abs=0.04)
    assert stats.kstest(xy[left, 0], stats.uniform(-1.9, 1.8).cdf).pvalue > 1e-3
    assert stats.kstest(xy[:, 1], stats.uniform(-1.9, 3.8).cdf).pvalue > 1e-3


def test_heights_lie_in_their_range_and_within_reach():
    rng = np.random.default_rng(0)
    free = Footprint("free", 8, 0.2, ARENA, height=(0.5, 1.5))
    near = Footprint("near", 4, 0.2, ARENA, height=(0.5, 1.5), reach=1.2)
    high = Footprint("high", 4, 0.2, ARENA, height=(0.5, 1.5), reach=0.9, reach_center=(0, 0, 1.3))
    flat = Footprint("flat", 1, 0.2, ARENA, height=0.26)
    layouts = [arrange([free, near, high, flat], rng) for _ in range(100)]
    z = np.concatenate([layout["free"][:, 2] for layout in layouts])
    assert stats.kstest(z, stats.uniform(0.5, 1.0).cdf).pvalue > 1e-3
    points = np.concatenate([layout["near"] for layout in layouts])
    assert (np.linalg.norm(points, axis=1) <= 1.2 + 1e-12).all()
    assert points[:, 2].min() >= 0.5
    points = np.concatenate([layout["high"] for layout in layouts])
    assert (np.linalg.norm(points - [0, 0, 1.3], axis=1) <= 0.9 + 1e-12).all()
    assert 0.5 <= points[:, 2].min() < 0.8 and points[:, 2].max() <= 1.5
    assert all(layout["flat"][0, 2] == 0.26 for layout in layouts)


def test_fixed_locations_are_kept_and_others_yield():
    parts = [
        Footprint("first", 2, 0.5, ARENA, ((0.0, 0.0), (1.0, 1.0))),
        Footprint("rest", 8, 0.4, ARENA),
    ]
    layout = arrange(parts, np.random.default_rng(0))
    np.testing.assert_array_equal(layout["first"][:, :2], [[0, 0], [1, 1]])
    check(parts, layout)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ([Footprint("few", 2, 0.4, ARENA), Footprint("boulders", 9, 0.9, ARENA)], "boulders"),
        ([Footprint("far", 3, 0.5, ARENA, reach=0.4)], "far"),
    ],
    ids=["crowded", "reach"],
)
def test_what_cannot_be_placed_is_named(parts, words):
    with pytest.raises(LayoutError, match=words):
        arrange(parts, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"placements": ((0, 0, 0, 1),)}, "placement"),
        ({"placements": ((0, 0, 0.5, 1),), "locations": ((3, 3),)}, "keepout 0.4 does not fit"),
        ({"num": 1, "locations": ((0, 0), (1, 1))}, "2 locations for 1"),
        (
            {"height": (2.5, 3.0), "reach": 2.0},
            r"height is out of .* reach: 2\.50 m .* reaches 2\.0",
        ),
        (
            {
                "locations": ((0, 0), (0, 1.5)),
                "reach_center": (2, 1.5, 0),
                "reach": 2.2,
                "height": (1, 2),
            },
            r"location \(0, 0\) is out of .* reach: 2\.69 m from \(2, 1\.5, 0\) even",
        ),
    ],
)
def test_bad_footprints_are_refused(kwargs, words):
    with pytest.raises(ValueError, match=words):
        Footprint(**{"name": "x", "num": 3, "keepout": 0.4, **kwargs})


def test_places_that_are_all_fixed_need_no_rectangle():
    Footprint("x", 1, 0.4, ((0, 0, 0.1, 0.1),), ((3.0, 3.0),))
    base = Scenario.parse("Goal_Point_2Hazards")
    small = {"locations": [[1, 1]], "placements": [[0.8, 0.8, 1.2, 1.2]]}
    base.override(goal={**small, "ends": True}).build()  # the first goal is the only one
    with pytest.raises(ValueError, match=r"goal: keepout 0\.4 does not fit the placement"):
        base.override(goal=small).build()


@pytest.mark.parametrize(
    "params",
    [
        {"goal": {"locations": [[1.9, 1]]}},
    ],
    ids=str,
)
def test_what_an_arm_cannot_reach_is_refused_at_construction(params):
    with pytest.raises(ValueError, match=r"out of the robot's reach: .*2\.0 m"):
        Scenario.parse("Goal_Arm3_2Hazards").override(**params).build()


@pytest.mark.parametrize(
    ("suite", "params", "reason"),
    [
        # all but a sliver of the layouts begin at the goal
        ("Goal_Point_0Hazards", {"goal": {"size": 4.5}},
         r"goal\.size = 4\.5: its goal is reached immediately"),

        ("Goal_Point_2Hazards", {"hazards": {"size": 5}},
         r"hazards\.size = 5\.0: a cost at the start"),


        (
            "Chase_Arm3_0Hazards",
            {"chase": {"num": 1, "solid": True, "locations": [[0, 1]], "size": 0.6,
                       "height": [1.5, 1.5]}, "robot": {"heading": 0.0}},
            r"chase\.size = 0\.6: a solid target touches the robot immediately",
        ),
    ],
)  # fmt: skip
def test_starts_that_are_never_clean_name_only_what_spoils_them(suite, params, reason):
    engine = Scenario.parse(suite).override(**params).build()
    engine.seed(0, np.random.default_rng(0))
    with pytest.raises(LayoutError, match=rf"none of 100 layouts .* clean \({reason}\): make size"):
        engine.reset(np.zeros(1, dtype=int))


GOAL = Footprint("goal", 1, 0.4, ARENA)


@pytest.mark.parametrize("mover", [False, True])
def test_a_new_place_is_clear_of_where_everything_is_now(mover):
    rng = np.random.default_rng(0)
    rocks = Footprint("rocks", 4, 0.5, ARENA, mover=mover)
    now = np.array([[-1.0, -1, 0], [1, 1, 0], [0, 0, 0], [1, -1, 0]])
    for _ in range(30):
        place = redraw(GOAL, {rocks: now}, rng)
        assert (np.linalg.norm(now[:, :2] - place[:2], axis=1) >= 0.9).all()


def test_movers_give_way_to_a_goal_without_room_and_others_do_not():
    """A 2.5 × 2.5 m lattice of discs, 0.9 m clear around each, leaves no room."""
    grid = np.array([[x, y, 0] for x in (-1.5, -0.5, 0.5, 1.5) for y in (-1.5, -0.5, 0.5, 1.5)])
    rng = np.random.default_rng(0)
    still = Footprint("still", 16, 0.5, ARENA)
    moving = Footprint("moving", 16, 0.5, ARENA, mover=True)
    assert redraw(GOAL, {still: grid}, rng, tries=3) is None
    assert redraw(GOAL, {moving: grid}, rng, tries=3) is not None
    assert redraw(GOAL, {still: grid, moving: grid + 5}, rng, tries=3) is None


def test_new_goals_keep_clear_of_ghosts_that_have_moved():
    engine = Scenario.parse("Goal_Point_4Ghosts").build(1)
    engine.seed(0, np.random.default_rng(0))
    engine.reset(np.zeros(1, dtype=np.int32))
    ghosts = engine.places("ghosts")
    for _ in range(20):
        ghosts[0, :, :2] = engine.rngs[0].uniform(-1.5, 1.5, (4, 2))
        assert engine.redraw("goal", 0)
        goal = engine.places("goal")[0, 0]
        assert (np.linalg.norm(ghosts[0, :, :2] - goal[:2], axis=1) >= 0.9).all()
        assert math.dist(goal[:2], engine.robot.position[0, :2]) >= 0.8


def test_new_goals_keep_clear_of_vases_and_balls_that_were_pushed():
    engine = Scenario.parse("Push_Point_3Vases").build(1)
    engine.seed(0, np.random.default_rng(0))
    engine.reset(np.zeros(1, dtype=np.int32))
    qpos = engine.batch.bind("qpos")
    qpos[0, [-21, -14, -7]] = [-1.0, 0.0, 1.0]  # x of the three vases
    qpos[0, [-20, -13, -6]] = 1.0
    qpos[0, -28:-26] = [0.0, -1.0]  # the ball
    engine.batch.forward()
    for _ in range(20):
        assert engine.redraw("goal", 0)
        x, y = engine.places("goal")[0, 0, :2]
        assert min(math.hypot(x - a, y - 1) for a in (-1, 0, 1)) >= 0.55
        assert math.hypot(x, y + 1) >= 0.6


@pytest.mark.parametrize("base", [(0.0, 0.0), (1.2, -0.9)])
@pytest.mark.parametrize("suite", ["Goal_Arm3_3Hazards", "Push_Arm6_8Ghosts", "Goal_Arm6_8Ghosts"])
def test_what_an_arm_has_to_reach_is_within_reach_of_its_base(suite, base):
    engine = Scenario.parse(suite).override(robot={"locations": [base]}).build(1)
    reach = engine.robot.reach
    assert math.isfinite(reach)
    for seed in range(10):
        engine.seed(0, np.random.default_rng(seed))
        engine.reset(np.zeros(1, dtype=np.int32))
        for name in {"goal", "ball", "hazards"} & set(engine.footprints):
            assert np.linalg.norm(engine.places(name)[0] - [*base, 0], axis=1).max() <= reach
        assert not engine.task.succeeded(engine.task.measure())[0]
        for _ in range(5):
            assert len(engine.task.advance(np.zeros(1, dtype=int))) == 0
            assert not engine.task.succeeded(engine.task.measure())[0]
            goal = engine.places("goal")[0, 0]
            assert np.linalg.norm(goal - [*base, 0]) <= reach
            # of its base, as first goals; of its hand the goal is only not reached yet
            assert math.dist(goal[:2], base) >= engine.robot.keepout + engine.task.keepout


def test_a_robot_of_limited_reach_stands_at_a_fixed_place():
    base = Scenario.parse("Goal_Arm3_2Hazards")
    engine = base.override(robot={"locations": []}).build()
    engine.reset(np.zeros(1, dtype=np.int32))
    np.testing.assert_array_equal(engine.places("robot")[0, 0], 0.0)
    with pytest.raises(ValueError, match="robot: 2 locations for 1 objects"):
        base.override(robot={"locations": [[0, 0], [1, 1]]}).build()
    with pytest.raises(ValueError, match=r"robot.placements = .* stands at a fixed place"):
        base.override(robot={"placements": [[-1, -1, 1, 1]]})


@pytest.mark.parametrize("suite", ["Goal_Point_0Hazards", "Goal_Arm3_0Hazards"])
def test_goals_are_not_reached_when_they_appear(suite):
    """A goal so wide that one place in three or so would be reached already."""
    engine = Scenario.parse(suite).override(goal={"size": 1.4}).build(1)
    for seed in range(15):
        engine.seed(0, np.random.default_rng(seed))
        engine.reset(np.zeros(1, dtype=np.int32))
        for _ in range(3):
            assert not engine.task.succeeded(engine.task.measure())[0]
            assert len(engine.task.advance(np.zeros(1, dtype=int))) == 0


def test_a_part_can_keep_a_margin_of_its_own():
    base = Scenario.parse("Goal_Point_2Hazards")
    engine = base.override(goal={"margin": 1.0}).build(20)
    engine.reset(np.arange(20))
    goal, hazards = engine.places("goal")[:, 0, :2], engine.places("hazards")[..., :2]
    gap = np.linalg.norm(hazards - goal[:, None], axis=-1)
    assert 1.8 <= gap.min() < 2.2
    flying = base.override(hazards={"space": "spatial", "height": [0.3, 0.3]}).build(3)
    flying.reset(np.arange(3))
    np.testing.assert_array_equal(flying.places("hazards")[..., 2], 0.3)

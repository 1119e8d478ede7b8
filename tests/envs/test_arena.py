"""The arena: its size, its walls and the physics options it gives a world."""

import numpy as np
import pytest
from worlds import world

import sb3_guard


def test_everything_is_placed_in_an_arena_of_its_size():
    engine = world("Goal_Point_8Hazards", 3, arena={"size": 3.5})
    assert engine.footprints["hazards"].placements == ((-3.5, -3.5, 3.5, 3.5),)
    assert 2.0 < abs(engine.places("hazards")[..., :2]).max() <= 3.5 - 0.4
    own = world("Goal_Point_8Hazards", layout={"placements": [[-3, -3, 3, 3]]})
    assert own.footprints["hazards"].placements == ((-3.0, -3.0, 3.0, 3.0),)


@pytest.mark.parametrize(
    ("robot", "action", "edge"),
    [("Point", [1.0, 0.0], 1.0), ("Ant", [0.0] * 8, 1.0), ("Drone", [1.0] * 4, 2.0)],
)
def test_no_robot_passes_solid_walls(robot, action, edge):
    reached = []
    for walls in ("none", "solid"):
        engine = world(
            f"Goal_{robot}_0Hazards",
            arena={"walls": walls, "size": 1.0},
            robot={"locations": [[0.5, 0.0]], "heading": 0.0},
            goal={"size": 0.01},
        )
        engine.batch.bind("qvel")[0, 0] = 3.0 if robot == "Ant" else 0.0  # is thrown
        for _ in range(100):
            engine.step(np.array([action]))
        reached.append(abs(engine.robot.position).max())
    assert reached[0] > edge > reached[1]  # a Drone's is the lid


def test_pushed_objects_stay_within_solid_walls():
    engine = world(
        "Push_Point_0Hazards",
        arena={"walls": "solid"},
        push={"object_locations": [[1.0, 0.0]], "locations": [[0.0, 1.5]]},
        robot={"locations": [[-1.0, 0.0]]},
    )
    ball = engine.task.positions("ball")
    engine.batch.bind("qvel")[0, -6] = 5.0
    for _ in range(200):
        engine.step(np.zeros((1, 2)))
        assert ball[0, 0, 0] < 2.0


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"arena": {"frame_skip": 10**9}}, "frame_skip"),
        ({"layout": {"restarts": 10**9}}, "restarts"),
    ],
)
def test_numbers_that_nobody_can_mean_are_refused(given, name):
    with pytest.raises(ValueError, match=f"{name} = 1000000000 must be"):
        sb3_guard.make("Goal_Point_8Hazards", **given)

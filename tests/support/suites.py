"""The environments that every promise is tested on, and the sizes they must have."""

from itertools import cycle, product

import pytest

from sb3_guard.envs import env_ids

# the named suites, and the robots that have none in each task
IDS = env_ids("guard") + [
    f"{task}_{robot}_8Hazards-v0"
    for task, robot in product(("Goal", "Push", "Chase", "Defense", "Button"), ("Car", "Doggo"))
]

# robot: actions, and observation sizes of Goal, Push, Chase and Defense
SIZES = {
    "Point": (2, 30, 32, 44),
    "Swimmer": (2, 40, 42, 54),
    "Ant": (8, 62, 64, 76),
    "Walker": (10, 62, 64, 76),
    "Humanoid": (6, 50, 52, 64),
    "Hopper": (5, 46, 48, 60),
    "Arm3": (3, 259, 268, 430),
    "Arm6": (6, 355, 367, 583),
    "Drone": (4, 83, 86, 140),
    "Car": (2, 42, 44, 56),
    "Doggo": (12, 74, 76, 88),
}

# each robot once, and each task with each constraint
COVER = [
    f"{task}_{robot}_8{constraint}-v0"
    for robot, (task, constraint) in zip(
        SIZES,
        cycle(product(("Goal", "Push", "Chase", "Defense", "Button"), ("Hazards", "Ghosts"))),
        strict=False,
    )
]
# what every test runs, and the others, which ``make test-slow`` runs too
CASES = [*COVER, *(pytest.param(i, marks=pytest.mark.slow) for i in IDS if i not in COVER)]

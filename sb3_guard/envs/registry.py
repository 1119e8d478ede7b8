"""Which robots, tasks and constraints there are, and the suites that they make.

Adding one to its table here, or with :func:`register_robot`, :func:`register_task` or
:func:`register_constraint` from outside, is all it takes to use it in ids, scenarios and commands.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

from sb3_guard.envs import constraints, robots, tasks
from sb3_guard.envs.part import Constraint, Robot, Task
from sb3_guard.envs.robots.robot import MJCFRobot
from sb3_guard.spelling import did_you_mean

ROBOTS: dict[str, type[Robot]] = {
    "Point": robots.Point,
    "Car": robots.Car,
    "Doggo": robots.Doggo,
    "Swimmer": robots.Swimmer,
    "Ant": robots.Ant,
    "Walker": robots.Walker,
    "Humanoid": robots.Humanoid,
    "Hopper": robots.Hopper,
    "Arm3": robots.Arm3,
    "Arm6": robots.Arm6,
    "Drone": robots.Drone,
}
TASKS: dict[str, type[Task]] = {
    "Goal": tasks.Goal,
    "Push": tasks.Push,
    "Chase": tasks.Chase,
    "Defense": tasks.Defense,
    "Button": tasks.Button,
}
CONSTRAINTS: dict[str, type[Constraint]] = {
    "Hazards": constraints.Hazards,
    "Ghosts": constraints.Ghosts,
    "Vases": constraints.Vases,
    "Pillars": constraints.Pillars,
    "Buttons": constraints.Buttons,
    "Gremlins": constraints.Gremlins,
}

EPISODE_STEPS = 1000  # control steps
LADDER = (1, 2, 4, 8, 16)  # numbers of a constraint's objects, by growing difficulty
# The named suites: every combination of these, each with eight constraint objects.
SUITE_ROBOTS = (
    "Point",
    "Swimmer",
    "Ant",
    "Walker",
    "Humanoid",
    "Hopper",
    "Arm3",
    "Arm6",
    "Drone",
)
SUITE_TASKS = ("Goal", "Push", "Chase", "Defense")
SUITE_CONSTRAINTS = ("Hazards", "Ghosts")


def env_ids() -> list[str]:
    """The ids of the named suites."""
    return [
        f"{task}_{robot}_8{constraint}-v0"
        for task, robot, constraint in product(SUITE_TASKS, SUITE_ROBOTS, SUITE_CONSTRAINTS)
    ]


def register_robot(
    name: str, robot: type[Robot] | None = None, *, xml: str | Path | None = None, **attributes: Any
) -> None:
    """Make a robot known under ``name``.

    :param name: what ids and scenarios call it
    :param robot: a :class:`~sb3_guard.envs.part.Robot` class
    :param xml: or the robot's MJCF file, by the conventions of
        :class:`~sb3_guard.envs.robots.robot.MJCFRobot`
    :param attributes: with ``xml``, class attributes such as ``timestep`` and ``workspace``
    :raises ValueError: neither or both of ``robot`` and ``xml`` are given, or the name is not
        usable
    """
    if (robot is None) == (xml is None):
        raise ValueError(f"robot {name!r} needs a class or an xml file, not both and not neither")
    if robot is None:
        file = Path(str(xml)).resolve()
        if not file.is_file():
            raise ValueError(f"robot {name!r}: there is no file {str(xml)!r}")
        known = ["timestep", "workspace", "lidar_bodies", "center", "reach"]
        for key in attributes:
            if key not in known:
                raise ValueError(f"robot {name!r} has no {key!r}: {did_you_mean(key, known)}")
        timestep = attributes.get("timestep", 0.002)
        if not isinstance(timestep, float) or not timestep > 0:
            raise ValueError(f"robot {name!r}: timestep = {timestep!r} must be a positive float, s")
        if attributes.get("workspace", "planar") not in ("planar", "spatial"):
            raise ValueError(
                f"robot {name!r}: workspace = {attributes['workspace']!r} must be 'planar' or "
                "'spatial'"
            )
        body = {"asset": "", "timestep": 0.002, **attributes, "path": classmethod(lambda cls: file)}
        robot = type(name, (MJCFRobot,), body)
    elif attributes:
        raise ValueError(f"robot {name!r}: {sorted(attributes)} go with xml, not with a class")
    _add(ROBOTS, name, robot, Robot)


def register_task(name: str, task: type[Task]) -> None:
    """Make a task known under ``name`` to ids, scenarios and commands."""
    _add(TASKS, name, task, Task)


def register_constraint(name: str, constraint: type[Constraint]) -> None:
    """Make a constraint known under ``name`` to ids, scenarios and commands."""
    _add(CONSTRAINTS, name, constraint, Constraint)


def _add(table: dict[str, Any], name: str, part: type, kind: type) -> None:
    if not isinstance(part, type) or not issubclass(part, kind):
        raise ValueError(f"{name!r} = {part!r} must be a subclass of {kind.__name__}")
    for other in table:
        if name.lower() == other.lower() and table[other] is not part:
            raise ValueError(
                f"a {kind.__name__.lower()} called {other!r} is known already: use another name"
            )
    if not name.isidentifier() or not name.isascii() or "_" in name:
        raise ValueError(
            f"{name!r} cannot be part of an id: use letters and digits, a letter first and no "
            "underscore"
        )
    table[name] = part

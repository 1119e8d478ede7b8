"""Which robots, tasks and constraints there are.

Adding one to its table here, or with :func:`register_robot`, :func:`register_task` or
:func:`register_constraint` from outside, is all it takes to use it in ids, scenarios and commands.
"""

import math
import re
from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import mujoco

from sb3_guard.envs.arena import Arena
from sb3_guard.envs.check_part import explodes
from sb3_guard.envs.constraints import limits
from sb3_guard.envs.engine import Engine
from sb3_guard.envs.part import Constraint, Part, Robot, Task
from sb3_guard.envs.robots import guard as guard_robots
from sb3_guard.envs.robots import gym_mujoco, safety_gymnasium
from sb3_guard.envs.robots.from_file import robot_class
from sb3_guard.envs.robots.robot import MJCFRobot

P = TypeVar("P", bound=Part)


def _parts(kind: str, *names: str) -> dict[str, Any]:
    """Classes by their names: ``Leave`` of the tasks is in ``sb3_guard/envs/tasks/leave.py``."""
    modules = [import_module(f"sb3_guard.envs.{kind}.{name.lower()}") for name in names]
    return {name: getattr(module, name) for name, module in zip(names, modules, strict=True)}


def guard(parts: Mapping[str, type[P]]) -> dict[str, type[P]]:
    """Those of a table that are GUARD's, each with a page of its own in the documentation."""
    return {name: part for name, part in parts.items() if part.family == "guard"}


_ROBOTS: tuple[type[Robot], ...] = (
    guard_robots.Point, guard_robots.Car, guard_robots.Doggo, guard_robots.Swimmer,
    guard_robots.Ant, guard_robots.Walker, guard_robots.Humanoid, guard_robots.Hopper,
    guard_robots.Arm3, guard_robots.Arm6, guard_robots.Drone,
    gym_mujoco.AntV4, gym_mujoco.HalfCheetahV4, gym_mujoco.HopperV4, gym_mujoco.HumanoidV4,
    gym_mujoco.SwimmerV4, gym_mujoco.Walker2dV4,
    safety_gymnasium.SafetyPoint, safety_gymnasium.SafetyCar, safety_gymnasium.SafetyAnt,
    safety_gymnasium.SafetyDoggo, safety_gymnasium.SafetyRacecar,
)  # fmt: skip
ROBOTS = {robot.__name__: robot for robot in _ROBOTS}
TASKS: dict[str, type[Task]] = _parts(
    "tasks",
    "Goal",
    "Push",
    "Chase",
    "Defense",
    "Button",
    "Forward",
    "Circle",
    "Run",
)
CONSTRAINTS: dict[str, type[Constraint]] = _parts(
    "constraints",
    "Hazards",
    "Ghosts",
    "Vases",
    "Pillars",
    "Buttons",
    "Gremlins",
    "Speed",
    "Boundary",
)
CONSTRAINTS |= {
    limit.__name__: limit
    for limit in (
        limits.JointLimits,
        limits.JointSpeed,
        limits.JointTorque,
        limits.BaseTilt,
        limits.BaseHeight,
        limits.FloorContact,
        limits.SelfCollision,
    )
}

# What else sets parameters, in the fields of a scenario that these name.
KEYWORDS = {
    "robot": "robot_params",
    "task": "task_params",
    "lidar": "lidar",
    "layout": "layout",
    "observe": "observe",
    "arena": "arena",
}
OPTIONS = (  # of functions that make environments
    "name", "scenario", "cost", "flatten", "width", "height", "camera", "render_mode",
    "max_episode_steps", "num_threads",
)  # fmt: skip


def register_robot(
    name: str,
    robot: type[Robot] | None = None,
    *,
    xml: str | Path | mujoco.MjSpec | None = None,
    **attributes: Any,
) -> None:
    """Make a robot known under ``name``.

    A file may be as its maker wrote it: the arena takes the place of its floor and lights, its
    options and sensors stay, and what the joints do is observed unless sensors cover it
    (:mod:`sb3_guard.envs.robots.robot`). What it lacks, such as servos or a keyframe, is added to
    its MjSpec, which is given in its place.

    :param name: what ids and scenarios call it
    :param robot: a :class:`~sb3_guard.envs.part.Robot` class
    :param xml: or the robot's MJCF file, or a :class:`mujoco.MjSpec`, which is not changed
    :param attributes: with ``xml``, what the file does not say, such as ``center``; the page
        *Parameters* lists them with their units and defaults
    :raises ValueError: neither or both of ``robot`` and ``xml`` are given, an attribute is unknown
        or bad, the file has no robot that can act or one that explodes when it is left alone, or
        the name is not usable
    """
    if (robot is None) == (xml is None):
        raise ValueError(
            f"robot {name!r} needs a class or an xml file, one of the two: "
            f"register_robot({name!r}, xml='{name}.xml')"
        )
    if robot is None:
        robot = robot_of_file(name, xml, attributes)
        own: Any = robot.from_params({}, "robot")
        goal = TASKS["Goal"].from_params(own.defaults.get("goal", {}))
        arena = Arena.from_params(own.defaults.get("arena", {}))
        unsteady = explodes(Engine(own, goal, arena=arena), speed=math.inf)  # it diverges
        if unsteady is not None:
            raise ValueError(f"robot {name!r}: {unsteady}")
    elif attributes:
        raise ValueError(f"robot {name!r}: {sorted(attributes)} go with xml, not with a class")
    _add(ROBOTS, name, robot, Robot)


def robot_of_file(
    name: str, xml: str | Path | mujoco.MjSpec, attributes: Mapping[str, Any]
) -> type[MJCFRobot]:
    """The robot of a file, not registered, see :func:`register_robot`."""
    source = xml if isinstance(xml, mujoco.MjSpec) else Path(xml).resolve()
    if isinstance(source, Path) and not source.is_file():
        raise ValueError(f"robot {name!r}: there is no file {str(xml)!r}")
    return robot_class(name, source, attributes)


def register_task(name: str, task: type[Task]) -> None:
    """Make a task known under ``name`` to ids, scenarios and commands.

    :raises ValueError: the class is not a task, or the name is not usable
    """
    _check_keyword(name, CONSTRAINTS)
    _add(TASKS, name, task, Task)


def register_constraint(name: str, constraint: type[Constraint]) -> None:
    """Make a constraint known under ``name`` to ids, scenarios and commands.

    :raises ValueError: the class is not a constraint, or the name is not usable
    """
    _check_keyword(name, TASKS)
    _add(CONSTRAINTS, name, constraint, Constraint)


def _check_keyword(name: str, others: Iterable[str]) -> None:
    """Refuse a name whose lower case sets something else's parameters.

    :param others: the parts of other kinds that have keywords of their own
    """
    key = str(name).lower()
    if key in (*KEYWORDS, *OPTIONS, *map(str.lower, others)):
        raise ValueError(
            f"{name!r} cannot name a part: its parameters would be set with {key}=..., which means "
            "something else; use another name"
        )


def _add(table: dict[str, Any], name: str, part: Any, kind: type[Part]) -> None:
    """Make a part known; one that is defined again, as by a notebook's cell, takes its place.

    :raises ValueError: this is no name for an id, or no class of this kind
    """
    if not isinstance(name, str) or re.fullmatch("[A-Za-z][A-Za-z0-9]*", name) is None:
        raise ValueError(
            f"{name!r} cannot be part of an id: use letters and digits, a letter first and no "
            "underscore"
        )
    if not isinstance(part, type) or not issubclass(part, kind):
        hint = "; a file is given as xml=..." if kind is Robot else ""
        raise ValueError(f"{name!r} = {part!r} must be a subclass of {kind.__name__}{hint}")
    for other, known in table.items():
        if name.lower() == other.lower() and not (name == other and _same(part, known)):
            raise ValueError(f"{other!r} is already taken by another class: use another name")
    if "name" not in vars(part) and not issubclass(part, Robot):
        part.name = name.lower()
    table[name] = part


def _same(part: type, other: type) -> bool:
    """Whether two classes have one source."""
    if issubclass(part, MJCFRobot) and issubclass(other, MJCFRobot) and part.path() != other.path():
        return False
    return (part.__module__, part.__qualname__) == (other.__module__, other.__qualname__)

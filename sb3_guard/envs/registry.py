"""Which robots, tasks and constraints there are.

Adding one to its table here, or with :func:`register_robot`, :func:`register_task` or
:func:`register_constraint` from outside, is all it takes to use it in ids, scenarios and commands.
"""

import dataclasses
import inspect
import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import mujoco

from sb3_guard.checks import check_integer
from sb3_guard.envs.arena import INTEGRATORS, Arena
from sb3_guard.envs.check_part import check_part
from sb3_guard.envs.engine import Engine
from sb3_guard.envs.parameters import PartError
from sb3_guard.envs.part import Constraint, Part, Robot, Task
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


ROBOTS: dict[str, type[Robot]] = _parts(
    "robots",
    "Point",
    "Car",
    "Doggo",
    "Swimmer",
    "Ant",
    "Walker",
    "Humanoid",
    "Hopper",
    "Arm3",
    "Arm6",
    "Drone",
)
ROBOTS |= {
    robot.__name__: robot
    for robot in (
        gym_mujoco.AntV4,
        gym_mujoco.HalfCheetahV4,
        gym_mujoco.HopperV4,
        gym_mujoco.HumanoidV4,
        gym_mujoco.SwimmerV4,
        gym_mujoco.Walker2dV4,
        safety_gymnasium.SafetyPoint,
        safety_gymnasium.SafetyCar,
        safety_gymnasium.SafetyAnt,
        safety_gymnasium.SafetyDoggo,
    )
}
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
    "JointLimits",
    "JointSpeed",
    "JointTorque",
    "BaseTilt",
    "BaseHeight",
    "FloorContact",
    "SelfCollision",
)

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
        or bad, the file has no robot that can act, or the name is not usable
    """
    _check_name(name)
    if (robot is None) == (xml is None):
        raise ValueError(
            f"robot {name!r} needs a class or an xml file, one of the two: "
            f"register_robot({name!r}, xml='{name.lower()}.xml')"
        )
    if robot is None:
        source = xml if isinstance(xml, mujoco.MjSpec) else Path(str(xml)).resolve()
        if isinstance(source, Path) and not source.is_file():
            raise ValueError(f"robot {name!r}: there is no file {str(xml)!r}")
        robot = robot_class(name, source, attributes)
    elif attributes:
        raise ValueError(f"robot {name!r}: {sorted(attributes)} go with xml, not with a class")
    _check_class(name, robot, Robot)
    _check_robot(name, robot)
    _check_contract(name, robot)
    _add(ROBOTS, name, robot)


def _check_robot(name: str, robot: type[Robot]) -> None:
    """Refuse attributes of a robot that are missing or that no robot can have."""

    def positive(value: Any) -> bool:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and value > 0

    def finite(value: Any) -> bool:
        return value is None or (positive(value) and value < math.inf)

    def texts(value: Any) -> bool:
        return isinstance(value, (list, tuple)) and bool(value) and all(map(_is_text, value))

    rules: dict[str, tuple[Callable[[Any], bool], str]] = {
        "timestep": (finite, "a positive number of seconds, such as 0.002"),
        "integrator": (lambda v: v in (None, *INTEGRATORS), f"one of {', '.join(INTEGRATORS)}"),
        "workspace": (lambda v: v in ("planar", "spatial"), "'planar' or 'spatial'"),
        "reach": (
            positive,
            "a positive number of metres; leave it out for a robot that can go anywhere",
        ),
    }
    if issubclass(robot, MJCFRobot):
        rules["lidar_bodies"] = texts, "a list of names of bodies, such as ['robot']"
        rules["center"] = _is_text, "the name of a body"
    check_integer(f"robot {name!r}: frame_skip", robot.frame_skip)
    for key, (fits, what) in rules.items():
        value = getattr(robot, key, None)
        if not fits(value):
            raise ValueError(f"robot {name!r}: {key} = {value!r} must be {what}")


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def register_task(name: str, task: type[Task]) -> None:
    """Make a task known under ``name`` to ids, scenarios and commands.

    :raises ValueError: the class is not a complete task, or the name is not usable
    """
    _check_name(name)
    _check_keyword(name, CONSTRAINTS)
    _check_class(name, task, Task, "reward")
    _check_contract(name, task)
    _add(TASKS, name, task)


def register_constraint(name: str, constraint: type[Constraint]) -> None:
    """Make a constraint known under ``name`` to ids, scenarios and commands.

    :raises ValueError: the class is not a complete constraint, or the name is not usable
    """
    _check_name(name)
    _check_keyword(name, TASKS)
    _check_class(name, constraint, Constraint, "cost")
    _check_contract(name, constraint)
    _add(CONSTRAINTS, name, constraint)


def _check_name(name: Any) -> None:
    if not _is_text(name) or not name.isidentifier() or not name.isascii() or "_" in name:
        raise ValueError(
            f"{name!r} cannot be part of an id: use letters and digits, a letter first and no "
            "underscore"
        )


def _check_keyword(name: str, others: Iterable[str]) -> None:
    """Refuse a name whose lower case sets something else's parameters.

    :param others: the parts of other kinds that have keywords of their own
    """
    key = name.lower()
    if key in (*KEYWORDS, *OPTIONS, *map(str.lower, others)):
        raise ValueError(
            f"{name!r} cannot name a part: its parameters would be set with {key}=..., which means "
            "something else; use another name"
        )


def _check_class(name: str, part: Any, kind: type, verb: str = "") -> None:
    """Refuse what cannot be used as a part of this kind.

    :param verb: a method that it must have of its own
    """
    if not isinstance(part, type) or not issubclass(part, kind):
        given = getattr(part, "__name__", repr(part))
        hint = "; a file is given as xml=..." if kind is Robot else ""
        raise ValueError(f"{name!r} = {given} must be a subclass of {kind.__name__}{hint}")
    parameters = [
        key for key, what in inspect.get_annotations(part).items() if "ClassVar" not in str(what)
    ]
    if "name" in parameters:
        raise ValueError(
            f"class {part.__name__}: name is not a parameter; write it without a type, name = ..."
        )
    decorated = "__dataclass_params__" in vars(part)
    if not dataclasses.is_dataclass(part) or (parameters and not decorated):
        unread = f": its parameters {', '.join(parameters)} are not read" if parameters else ""
        raise ValueError(
            f"class {part.__name__} is not a dataclass{unread}; write @dataclass in the line above "
            f"class {part.__name__}"
        )
    if verb and getattr(part, verb) is getattr(kind, verb):
        raise ValueError(f"class {part.__name__} must define {verb}(), as every {kind.__name__}")


def _check_contract(name: str, part: type[Part]) -> None:
    """Run a part with its defaults in a small world, and warn if it can't be in one.

    :raises PartError: it does not keep its contract
    """

    def make(rows: int) -> Engine:
        one: Any = part.from_params({}, name.lower() if not issubclass(part, Robot) else None)
        if isinstance(one, Robot):
            goal = TASKS["Goal"].from_params(one.defaults.get("goal", {}))
            arena = Arena.from_params(one.defaults.get("arena", {}))
            return Engine(one, goal, num_envs=rows, num_threads=1, arena=arena)
        robot = ROBOTS[part.tried_with or ("Point" if "planar" in part.spaces else "Drone")]()
        if isinstance(one, Task):
            return Engine(robot, one, num_envs=rows, num_threads=1)
        return Engine(robot, TASKS["Goal"](), [one], num_envs=rows, num_threads=1)

    try:
        check_part(make, name)
    except PartError:
        raise
    except Exception as error:  # it may need other company
        if isinstance(error, ValueError) and issubclass(part, MJCFRobot):
            raise  # its file is at fault
        warnings.warn(
            f"{name} was not tried: a small world with it raised {type(error).__name__}: {error}; "
            "it is registered, but may not work",
            stacklevel=4,
        )


def _add(table: dict[str, Any], name: str, part: type[Part]) -> None:
    """Make a part known; one that is defined again, as by a notebook's cell, takes its place."""
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

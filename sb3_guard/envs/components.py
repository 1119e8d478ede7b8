"""What each number of an observation and of an action is: name, place, bounds and unit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_guard.envs.robots.model_file import holding
from sb3_guard.envs.robots.robot import MJCFRobot

if TYPE_CHECKING:
    from sb3_guard.envs.engine import Engine

# Names and units of what a free joint, a ball, a slide and a hinge add to qpos and to qvel
_QUATERNION = [(f"q{axis}", "") for axis in "wxyz"]
_COORDINATES: dict[str, list[list[tuple[str, str]]]] = {
    "qpos": [
        [*((axis, "m") for axis in "xyz"), *_QUATERNION], _QUATERNION, [("", "m")], [("", "rad")]
    ],
    "qvel": [
        [*((axis, "m/s") for axis in "xyz"), *((f"ω{axis}", "rad/s") for axis in "xyz")],
        [(f"ω{axis}", "rad/s") for axis in "xyz"], [("", "m/s")], [("", "rad/s")],
    ],
}  # fmt: skip
# What Gymnasium's Humanoid observes beside its joints
_UNITS = {
    "cinert": "kg m², kg m, kg", "cvel": "rad/s, m/s", "qfrc_actuator": "N m", "cfrc_ext": "N m, N"
}  # fmt: skip


class Component(NamedTuple):
    """One named part of the flat observation.

    :param start: its first index
    :param stop: the index after its last
    """

    name: str
    start: int
    stop: int
    low: float
    high: float
    unit: str


class Actuator(NamedTuple):
    """What one number of an action moves.

    :param name: of the actuator, or of its joint
    :param low: its least action
    :param high: its greatest
    :param control: which controls these set
    :param stop: the control that stops it; None: the last one, which a position servo holds
    """

    name: str
    low: float
    high: float
    control: tuple[float, float]
    stop: float | None


def components(engine: Engine) -> Iterator[Component]:
    """The components of the flat observation in their order; joints one by one."""
    model = engine.model
    for name, where in engine.observation_layout.items():
        channel = engine.channels[name]
        low, high = channel.low, channel.high
        if name in ("qpos", "qvel"):
            every = [
                (f"{name} {model.joint(i).name.removeprefix('robot/')} {part}".strip(), unit)
                for i in range(model.njnt)
                for part, unit in _COORDINATES[name][model.jnt_type[i]]
            ]
            hidden = len(every) - (where.stop - where.start)  # the first ones
            for i, (part, unit) in enumerate(every[hidden:], where.start):
                yield Component(part, i, i + 1, low, high, unit)
            continue
        unit = channel.unit or _UNITS.get(name, "")
        yield Component(name, where.start, where.stop, low, high, unit)


def actuators(engine: Engine) -> Iterator[Actuator]:
    """The actuators in the order of the action's numbers."""
    model, robot = engine.model, engine.robot
    limits = np.array(
        robot.controls if isinstance(robot, MJCFRobot) else model.actuator_ctrlrange.T
    )
    holds, stated = holding(model), robot.stop if isinstance(robot, MJCFRobot) else {}
    for i, (low, high) in enumerate(limits.T.tolist()):
        name = model.actuator(i).name or model.joint(model.actuator_trnid[i, 0]).name
        least, most = (np.broadcast_to(b, model.nu)[i] for b in robot.action_range)
        name = name.removeprefix("robot/")
        stop = stated.get(name, None if holds[i] else 0.0)
        stop = None if stop is None else min(max(stop, low), high)
        yield Actuator(name, float(least), float(most), (low, high), stop)

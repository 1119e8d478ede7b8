"""What the verbs of a part must give: arrays of the right shape, movers, observations."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_guard.envs.motion import Law, Moving
from sb3_guard.envs.observation import Compass, Scan, Values
from sb3_guard.envs.parameters import PartError, misshapen
from sb3_guard.envs.part import Part
from sb3_guard.envs.types import Array


def per_row(part: Part, verb: str, value: Any, rows: int, dtype: type = float) -> Array:
    """What a verb of a part gave, [N], a copy: the part may keep and change its own.

    :param rows: N
    :raises PartError: it has another shape
    """
    out: Array = np.array(value, dtype=dtype)
    if out.shape != (rows,):
        raise PartError(misshapen(f"{verb} of {part.name}", out.shape, (rows,)))
    return out


def check_moving(part: Part, rows: int) -> None:
    """Refuse movers that are none.

    :param rows: N
    :raises PartError: names the part and what it must give
    """
    moving = part.moving()
    for group in moving if isinstance(moving, tuple | list) else (moving,):
        if not (
            isinstance(group, Moving)
            and isinstance(group.points, np.ndarray)
            and isinstance(group.law, Law)
        ):
            raise PartError(
                f"moving() of {part.name} gives {group!r}: it must be a tuple of "
                "Moving(points, law, planar), of an array [N, K, 3] and a Law"
            )
        shape = group.points.shape
        if len(shape) != 3 or (shape[0], shape[2]) != (rows, 3):
            raise PartError(misshapen(f"moving() of {part.name}", shape, (rows, "K", 3)))


def check_observations(part: Part, rows: int, finite: bool = False) -> None:
    """Refuse observations that are not what they must be.

    :param part: whose observations
    :param rows: N
    :param finite: whether their numbers must be finite: once an episode has begun
    :raises PartError: names the part, the observation and what it must be
    """
    found = part.observations()
    if not isinstance(found, Mapping):
        raise PartError(
            f"observations() of {part.name} gives {found!r}: it must be a mapping of names to "
            "Scan, Compass or Values, {} for none"
        )
    for name, what in found.items():
        label = f"observations()[{name!r}] of {part.name}"
        rest = {Scan: ("K", 3), Compass: (3,), Values: ("d",)}.get(type(what))
        if rest is None:
            raise PartError(
                f"{label} is {what!r}: it must be a Scan of points [N, K, 3], a Compass to a point "
                "[N, 3] or Values [N, d]"
            )
        shape, expected = np.shape(what[0]), (rows, *rest)
        fits = len(shape) == len(expected) and all(
            isinstance(e, str) or e == s for s, e in zip(shape, expected, strict=True)
        )
        visible = what.visible if isinstance(what, Scan) else None
        if not isinstance(what[0], np.ndarray) or not fits:
            raise PartError(misshapen(label, shape, expected))
        if visible is not None and np.shape(visible) != (rows,):
            raise PartError(misshapen(f"visible of {label}", np.shape(visible), (rows,)))
        if finite and not np.isfinite(what[0].astype(float)).all():
            raise PartError(f"{label} is not finite: {what[0][0]}")

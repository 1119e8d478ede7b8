"""How ghosts and targets move: towards the robot or away from it, home, and apart.

Everything is a displacement per control step, in metres. Let d_r be the offset from a mover to the
robot and d_o the offset to the origin. Beyond r0 of the origin it heads home; within, what it does
depends on whether the robot is within r1 (Zhao et al. 2024, §4: ghosts, chase and defense targets).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Array = np.ndarray
TINY = 1e-12  # m: the unit vector of a zero offset is zero


@dataclass(frozen=True)
class Law:
    """Where a kind of mover is drawn, and how fast.

    With ``unit`` speeds are metres per control step along unit vectors, home is sought in the plane
    and like movers closer than ``gap`` part. Without, they are fractions of the offsets themselves,
    as in the paper's equations, and nothing keeps movers apart.

    :param near: speed towards the robot within r1 of it; negative flees
    :param far: speed towards the robot beyond r1
    :param settle: speed towards the origin beyond r1 of the robot
    :param home: speed towards the origin beyond r0 of it
    :param apart: speed away from each like mover closer than ``gap``
    :param gap: m
    :param r0: radius around the origin that is not left, m
    :param r1: distance from the robot at which the behaviour changes, m
    :param origin: (x, y, z) m
    :param unit: whether speeds go along unit vectors
    """

    near: float = 0.0
    far: float = 0.0
    settle: float = 0.0
    home: float = 0.0
    apart: float = 0.0
    gap: float = 0.0
    r0: float = np.inf
    r1: float = 0.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    unit: bool = True


def advance(points: Array, robot: Array, law: Law, planar: bool) -> None:
    """Move by one control step, in place.

    Coordinates are kept apart, [N, K] each: loops over a last axis of 2 or 3 would be slow.

    :param points: where the movers are, [N, K, 3] m
    :param robot: where the robot is, [N, 3] m
    :param law: their law of motion
    :param planar: whether they move and measure in the plane
    """
    here = [points[..., j] for j in range(2 if planar else 3)]
    to_robot = [robot[:, j, None] - x for j, x in enumerate(here)]
    to_origin = [law.origin[j] - x for j, x in enumerate(here[:2] if law.unit else here)]
    robot_distance, origin_distance = _length(to_robot), _length(to_origin)
    outside, near = origin_distance > law.r0, robot_distance <= law.r1
    pull = np.where(near, law.near, law.far)
    draw = np.where(near, 0.0, law.settle)
    pull[outside] = 0.0
    draw[outside] = law.home
    if law.unit:
        pull /= np.maximum(robot_distance, TINY)
        draw /= np.maximum(origin_distance, TINY)
    pushes = _repulsion(here, law.gap, law.apart) if law.unit and law.apart else None
    for j, x in enumerate(here):
        move = pull * to_robot[j]
        if j < len(to_origin):
            move += draw * to_origin[j]
        if pushes is not None:
            move += pushes[j]
        x += move


def _length(offset: list[Array]) -> Array:
    """Euclidean length of offsets given by coordinate."""
    total = offset[0] * offset[0]
    for x in offset[1:]:
        total += x * x
    return np.sqrt(total)


def _repulsion(points: list[Array], gap: float, speed: float) -> list[Array] | None:
    """How far points of a row part: ``speed`` away from each other one that is closer than ``gap``.

    :param points: by coordinate, [N, K] m each
    :return: by coordinate, [N, K] m each; None if all keep their distance
    """
    offset = [x[:, :, None] - x[:, None] for x in points]  # [N, K, K], from the second to the first
    distance = _length(offset)
    pairs = np.flatnonzero(distance < gap)
    n, k = points[0].shape
    if len(pairs) == n * k:  # each is close to itself alone
        return None
    push = speed / np.maximum(distance.reshape(-1)[pairs], TINY)
    # summed in the order of the second points, whatever the number of rows
    return [
        np.bincount(pairs // k, push * d.reshape(-1)[pairs], n * k).reshape(n, k) for d in offset
    ]

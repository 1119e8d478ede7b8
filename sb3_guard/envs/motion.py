"""How ghosts and targets move: towards the robot or away from it, home, and apart.

Everything is a displacement per control step, in metres. Let d_r be the offset from a mover to the
robot and d_o the offset to the origin. Beyond r0 of the origin it heads home; within, what it does
depends on whether the robot is within r1 (Zhao et al. 2024, §4: ghosts, chase and defense targets).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from sb3_guard.envs.geometry import length

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

    :param points: where the movers are, [N, K, 3] m
    :param robot: where the robot is, [N, 3] m
    :param law: their law of motion
    :param planar: whether they move and measure in the plane
    """
    points = points.T[: 2 if planar else 3]
    here = points.copy()  # by coordinate, [2 or 3, K, N]
    to_robot = robot.T[: len(here), None] - here
    size = 2 if law.unit else len(here)
    to_origin = np.array(law.origin[:size])[:, None, None] - here[:size]
    robot_distance, origin_distance = length(to_robot), length(to_origin)
    outside, near = origin_distance > law.r0, robot_distance <= law.r1
    pull = np.where(near, law.near, law.far)
    draw = np.where(near, 0.0, law.settle)
    pull[outside] = 0.0
    draw[outside] = law.home
    if law.unit:
        pull /= np.maximum(robot_distance, TINY)
        draw /= np.maximum(origin_distance, TINY)
    move = pull * to_robot
    move[:size] += draw * to_origin
    if law.unit and law.apart:
        _part(move, here, law.gap, law.apart)
    points += move


@functools.lru_cache
def _pairs(k: int) -> tuple[Array, Array]:
    """Numbers of the first and of the second of every pair of K movers, in order."""
    return np.triu_indices(k, 1)


def _part(move: Array, points: Array, gap: float, speed: float) -> None:
    """Add ``speed`` away from each other point of the row that is closer than ``gap``.

    :param move: what to add to, by coordinate, [2 or 3, K, N] m
    :param points: by coordinate, [2 or 3, K, N] m
    """
    k, n = points.shape[1:]
    first, second = _pairs(k)
    offset = points.take(first, axis=1) - points.take(second, axis=1)  # [2 or 3, pairs, N]
    distance = length(offset)
    close = np.flatnonzero(distance < gap)
    if not len(close):
        return
    pair, row = np.divmod(close, n)
    push = offset.reshape(len(offset), -1)[:, close]
    push *= speed / np.maximum(distance.reshape(-1)[close], TINY)
    # each mover's pushes are summed in the order of the others, whatever the number of rows
    moved = np.concatenate([second[pair] * n + row, first[pair] * n + row])
    for x, away in zip(move, push, strict=True):
        x += np.bincount(moved, np.concatenate([-away, away]), k * n).reshape(k, n)

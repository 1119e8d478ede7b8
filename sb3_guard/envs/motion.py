"""How ghosts and targets move: towards the robot or away from it, home, and apart.

Everything is a displacement per control step, in metres. Let d_r be the offset from a mover to the
robot and d_o the offset to the origin. Beyond r0 of the origin it heads home; within, what it does
depends on whether the robot is within r1 (Zhao et al. 2024, §4: ghosts, chase and defense targets).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs.geometry import norm

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


def displacement(points: Array, robot: Array, law: Law, planar: bool) -> Array:
    """How far movers go in one control step.

    :param points: where they are, [N, K, 3] m
    :param robot: where the robot is, [N, 3] m
    :param law: their law of motion
    :param planar: whether they move and measure in the plane
    :return: [N, K, 2] m in the plane, [N, K, 3] m in space
    """
    size = 2 if planar else 3
    here = points[..., :size]
    to_robot = robot[:, None, :size] - here  # [N, K, size]
    to_origin = law.origin[:size] - here
    if law.unit and not planar:
        to_origin[..., 2] = 0.0
    robot_distance, origin_distance = norm(to_robot), norm(to_origin)  # [N, K]
    outside, near = origin_distance > law.r0, robot_distance <= law.r1
    pull = np.where(outside, 0.0, np.where(near, law.near, law.far))
    draw = np.where(outside, law.home, np.where(near, 0.0, law.settle))
    if law.unit:
        pull /= np.maximum(robot_distance, TINY)
        draw /= np.maximum(origin_distance, TINY)
    to_robot *= pull[..., None]
    to_origin *= draw[..., None]
    to_robot += to_origin
    if law.unit and law.apart > 0:
        to_robot += repulsion(here, law.gap, law.apart)
    return to_robot


def repulsion(points: Array, gap: float, speed: float) -> Array:
    """Push points apart: ``speed`` away from each other point of the row that is closer than ``gap``.

    :param points: [N, K, d] m
    :return: [N, K, d] m
    """
    offset = points[:, :, None] - points[:, None]  # [N, K, K, d], from the second to the first
    distance = norm(offset)
    close = distance < gap
    if np.count_nonzero(close) == close.shape[0] * close.shape[1]:  # each only to itself
        return np.zeros(points.shape)
    push = np.where(close, speed / np.maximum(distance, TINY), 0.0)
    offset *= push[..., None]
    return offset.sum(axis=2)

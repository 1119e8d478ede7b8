"""How ghosts and targets move: towards the robot or away from it, home, and apart.

Everything is a displacement per control step, in metres. Let d_r be the offset from a mover to the
robot and d_o the offset to the origin. Beyond r0 of the origin it heads home; within, what it does
depends on whether the robot is within r1 (Zhao et al. 2024, §4: ghosts, chase and defense targets).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sb3_guard.envs.geometry import length
from sb3_guard.envs.types import Array

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
    :param gap: m, or [N] m, live, where it is not the same in all rows
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
    gap: float | Array = 0.0
    r0: float = np.inf
    r1: float = 0.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    unit: bool = True


class Moving(NamedTuple):
    """Like movers and what they do.

    :param points: where they are, [N, K, 3] m, live
    :param law: their law of motion
    :param planar: whether they move and measure in the plane
    """

    points: Array
    law: Law
    planar: bool


class MoverGroup:
    """All movers of a world that can be moved in one pass, whatever parts they belong to.

    :param groups: of like movers; all in the plane or all in space, all by unit vectors or none
    """

    def __init__(self, groups: Sequence[Moving]) -> None:
        planar, self._unit = groups[0].planar, groups[0].law.unit
        self._size = 2 if planar else 3
        self._level = self._unit and not planar  # home is sought in the plane
        self._live = [g.points.T[: self._size] for g in groups]  # by coordinate
        ends = np.cumsum([g.points.shape[1] for g in groups]).tolist()
        self._columns = [slice(i, j) for i, j in zip([0, *ends], ends, strict=False)]
        laws = [g.law for g in groups for _ in range(g.points.shape[1])]
        k, n = len(laws), len(groups[0].points)
        # the movers, their origins and the robot
        self._points = np.zeros((self._size, 2 * k + 1, n))
        self._points[:, k : 2 * k] = np.array([w.origin[: self._size] for w in laws]).T[..., None]
        # pairs of like movers that part, the later one first
        part = [c for c in self._columns if self._unit and laws[c.start].apart]
        each = [np.array(np.triu_indices(c.stop - c.start, 1)) + c.start for c in part]
        pairs = np.concatenate([np.zeros((2, 0), dtype=int), *each], axis=1)[::-1]
        # offsets lead from each mover to the robot, from each to its origin, and within each pair
        movers = np.arange(k)
        self._from = np.concatenate([movers, movers, pairs[0]])
        self._to = np.concatenate([np.full(k, 2 * k), k + movers, pairs[1]])
        ends = (2 * k + np.cumsum([0, *(p.shape[1] for p in each)])).tolist()
        spans = [slice(i, j) for i, j in itertools.pairwise(ends)]  # of each group's pairs
        self._gaps = [(s, laws[c.start].gap) for s, c in zip(spans, part, strict=True)]
        self._drawn = any(np.ndim(gap) for _, gap in self._gaps)
        self._radii = np.empty((2 * k + pairs.shape[1], n if self._drawn else 1))
        self._radii[:k, :] = np.array([[law.r1] for law in laws])
        self._radii[k : 2 * k, :] = np.array([[law.r0] for law in laws])
        self._update_gaps()
        # speeds towards robot and origin, [2, 4 K]: outside r0 twice, within it far and near
        self._speeds = np.array(
            [
                [(0.0, 0.0, law.far, law.near) for law in laws],
                [(law.home, law.home, law.settle, 0.0) for law in laws],
            ]
        ).reshape(2, -1)
        self._outside = 4 * movers[:, None]
        self._inside = self._outside + 2
        self._apart = np.array([laws[i].apart for i in pairs[1]])
        # from a flat index of [pairs, N] to those of the pair's movers in [2 or 3, K, N]
        ends = pairs[:, None] + k * np.arange(self._size)[:, None]
        self._shift = n * (ends - np.arange(pairs.shape[1])).reshape(2 * self._size, -1)

    def advance(self, robot: Array) -> None:
        """Move by one control step, in place.

        :param robot: where the robot is, [N, 3] m
        """
        for live, columns in zip(self._live, self._columns, strict=True):
            self._points[:, columns] = live
        self._points[:, -1] = robot.T[: self._size]
        offset = self._points.take(self._to, axis=1)  # [2 or 3, 2 K + pairs, N]
        offset -= self._points.take(self._from, axis=1)
        k, n = len(self._outside), offset.shape[2]
        if self._drawn:
            self._update_gaps()
        if self._level:
            offset[2, k : 2 * k] = 0.0
        distance = length(offset)
        within = distance <= self._radii
        case = np.where(within[k : 2 * k], self._inside, self._outside)
        case += within[:k]
        speed = self._speeds.take(case, axis=1)  # [2, K, N]
        if self._unit:
            speed /= np.maximum(distance[: 2 * k], TINY).reshape(2, k, n)
        aims = offset[:, : 2 * k].reshape(-1, 2, k, n)
        aims *= speed
        move = aims[:, 0] + aims[:, 1]
        close = within[2 * k :].ravel().nonzero()[0]
        if len(close):
            self._part(move, offset, distance, close)
        for live, columns in zip(self._live, self._columns, strict=True):
            np.add(self._points[:, columns], move[:, columns], out=live)

    def _update_gaps(self) -> None:
        """Movers part below the gap, not at it."""
        for pairs, gap in self._gaps:
            self._radii[pairs] = np.nextafter(gap, -1.0)

    def _part(self, move: Array, offset: Array, distance: Array, close: Array) -> None:
        """Add a push away from each like mover of the row that is closer than the gap.

        :param move: what to add to, by coordinate, [2 or 3, K, N] m
        :param offset: to robots, to origins and within pairs, [2 or 3, 2 K + pairs, N] m
        :param distance: the same for distances, [2 K + pairs, N] m
        :param close: which are closer than the gap: flat indices of [pairs, N], rising
        """
        _, k, n = move.shape
        pair, where = close // n, close + 2 * k * n
        push = offset.reshape(len(offset), -1).take(where, axis=1)
        push *= self._apart.take(pair) / np.maximum(distance.take(where), TINY)
        moved = self._shift.take(pair, axis=1)
        moved += close
        # each mover's pushes are summed in the order of the others, whatever the number of rows
        away = np.concatenate([-push, push])
        move += np.bincount(moved.ravel(), away.ravel(), move.size).reshape(move.shape)


class Motion:
    """All that moves by a law, in as few groups as can be.

    :param parts: whose movers they are, as ``moving()`` of each says
    """

    def __init__(self, parts: Sequence[Any]) -> None:
        self._parts = parts
        self._moving: list[Moving] = []
        self._groups: list[MoverGroup] = []

    def advance(self, robot: Array) -> None:
        """Move by one control step, in place.

        :param robot: where the robot is, [N, 3] m
        """
        moving = [group for part in self._parts for group in part.moving()]
        # the same groups as before unless a part says otherwise
        same = len(moving) == len(self._moving) and all(
            new.points is old.points
            and (new.law is old.law or new.law == old.law)
            and new.planar is old.planar
            for new, old in zip(moving, self._moving, strict=True)
        )
        if not same:
            self._moving, self._groups = moving, grouped(moving)
        for group in self._groups:
            group.advance(robot)


def grouped(moving: Iterable[Moving]) -> list[MoverGroup]:
    """Movers that move alike together, in few groups; those of no movers are left out."""
    alike: dict[tuple[bool, bool], list[Moving]] = {}
    for group in moving:
        if group.points.shape[1]:
            alike.setdefault((group.planar, group.law.unit), []).append(group)
    return [MoverGroup(groups) for groups in alike.values()]

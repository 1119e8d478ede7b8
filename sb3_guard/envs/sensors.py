"""What a robot perceives of the other parts: pseudo-lidar and compass, as arrays.

Both work on points already expressed in body frames, by coordinate, as
:func:`sb3_guard.envs.geometry.into_frames` gives them.
Formulas: Ray et al. 2019 (Safety Gym) and, for the third dimension, Zhao et al. 2024 (GUARD).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sb3_guard.envs.geometry import into_frames, length
from sb3_guard.envs.parameters import Parameters, param

Array = np.ndarray


@dataclass(frozen=True)
class Channel:
    """One named component of the observation: its size, bounds and unit."""

    size: int
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""


class Scan(NamedTuple):
    """Points that a channel of pseudo-lidar shows.

    :param points: [N, K, 3] m
    :param planar: whether they lie in the plane: one ring of bins instead of a sphere, whatever
        their height
    :param color: of its halo in pictures; None: the part's
    :param lit: the rows in which they show, [N] bool; None: all
    """

    points: Array
    planar: bool
    color: tuple[float, float, float] | None = None
    lit: Array | None = None


class Compass(NamedTuple):
    """A point that a channel gives the direction of.

    :param point: [N, 3] m
    :param planar: whether it lies in the plane; of a robot in the plane two coordinates are seen
    """

    point: Array
    planar: bool = True


def compass(v: Array) -> Array:
    """Nearly unit vectors towards points from offsets by coordinate, both [2 or 3, ...] m.

    The length is ‖v‖ / (‖v‖ + 1 mm): zero, not NaN, on the spot.
    """
    return v / (length(v) + 0.001)


@functools.lru_cache
def _starts(n: int, bodies: int, groups: tuple[int, ...], bins: int) -> Array:
    """Flat index of the first bin that each point may show in, in [N, B, groups, bins]: [B, K, N].

    :param groups: how many of the K points belong to each group
    """
    first = np.arange(0, n * bodies * len(groups) * bins, bins).reshape(n, bodies, len(groups))
    return np.repeat(first, groups, axis=2).transpose(1, 2, 0).copy()


@functools.lru_cache
def _shown(columns: int, rows: int, alias: bool) -> Array:
    """The bins in which an object in a bin shows: [1, bins], only there; with ``alias``, [3, bins],
    also after and before it on the ring; with several rows, [5, bins], also above and below it.
    """
    column, row = np.divmod(np.arange(columns * rows), rows)
    where = [(column, row)]
    if alias:
        where += [((column + 1) % columns, row), ((column - 1) % columns, row)]
    if alias and rows > 1:  # beyond the poles there is only the polar bin itself
        where += [(column, np.minimum(row + 1, rows - 1)), (column, np.maximum(row - 1, 0))]
    return np.array([column * rows + row for column, row in where])


@dataclass(frozen=True)
class Lidar(Parameters):
    """A pseudo-lidar: each bin holds the closeness of the nearest object in its direction."""

    name = "lidar"

    bins: int = param(16, "directions in the plane", low=1, high=1000)
    azimuth: int = param(10, "directions around, in space", low=1, high=1000)
    elevation: int = param(6, "directions from down to up, in space", low=1, high=1000)
    gain: float = param(1.0, "decay of closeness exp(−gain · distance), 1/m", above=0)
    max_distance: float | None = param(
        None, "closeness falls linearly to 0 at this distance, m; null: exponentially", above=0
    )
    alias: bool = param(True, "whether an object also shows, weaker, in the neighbouring bins")

    def size(self, planar: bool) -> int:
        """Number of bins of one lidar body."""
        return self.bins if planar else self.azimuth * self.elevation

    def channel(self, bodies: int, planar: bool) -> Channel:
        """What :meth:`scan` returns of a group, once flattened to [N, bodies · bins]."""
        return Channel(bodies * self.size(planar), 0.0, 1.0, "closeness")

    def scan(self, v: Array, groups: Sequence[int] | None = None) -> Array:
        """Closeness per body, group of objects and bin.

        :param v: objects in body frames, by coordinate: [2, B, K, N] m in the plane, [3, B, K, N] m
            in space
        :param groups: how many of the K objects belong to each of G groups, in order; None: one has
            them all
        :return: [N, B, G, bins] or [N, B, G, azimuth · elevation], within [0, 1]
        """
        d, bodies, k, n = v.shape
        sizes = (k,) if groups is None else tuple(groups)
        columns, rows = (self.bins, 1) if d == 2 else (self.azimuth, self.elevation)
        shown = 1 if not self.alias else 3 if rows == 1 else 5
        values = np.empty((shown, bodies, k, n))  # what each object shows, and its neighbours
        closeness, distance = values[0], length(v)
        if self.max_distance is None:
            np.exp(np.multiply(-self.gain, distance, out=distance), out=closeness)
        else:
            np.maximum(0.0, self.max_distance - distance, out=closeness)
            closeness /= self.max_distance
        turn = np.arctan2(v[1], v[0])
        turn *= columns / (2 * math.pi)
        turn %= columns
        column = np.minimum(turn.astype(np.intp), columns - 1)
        cell = column
        if self.alias:
            np.multiply(np.subtract(turn, column, out=turn), closeness, out=values[1])
            np.subtract(closeness, values[1], out=values[2])
        if rows > 1:
            tilt = np.arctan2(v[2], length(v[:2]))
            tilt += math.pi / 2
            tilt *= rows / math.pi
            row = np.minimum(tilt.astype(np.intp), rows - 1)
            cell = column * rows + row
            if self.alias:
                np.multiply(np.subtract(tilt, row, out=tilt), closeness, out=values[3])
                np.subtract(closeness, values[3], out=values[4])
        places = _shown(columns, rows, self.alias).take(cell, axis=1)
        places += _starts(n, bodies, sizes, columns * rows)
        out = np.zeros((n, bodies, len(sizes), columns * rows))
        np.maximum.at(out.reshape(-1), places.reshape(-1), values.reshape(-1))
        return out


class Lookout:
    """The robot's lidar bodies, which see all scans and compasses of a world in one pass.

    :param lidar: settings of the pseudo-lidar
    :param grounded: whether the robot moves in the plane
    """

    def __init__(self, lidar: Lidar, grounded: bool) -> None:
        self._lidar, self._grounded = lidar, grounded
        self._seen: list[tuple[str, tuple[int, ...], bool]] = []  # name, shape, planar

    def _coordinates(self, sight: Scan | Compass) -> int:
        """How many coordinates of a sight's points, in the bodies' frames, count."""
        return 2 if sight.planar and (self._grounded or isinstance(sight, Scan)) else 3

    def channel(self, sight: Scan | Compass, bodies: int) -> Channel:
        """What :meth:`look` returns of a sight."""
        if isinstance(sight, Scan):
            return self._lidar.channel(bodies, sight.planar)
        return Channel(bodies * self._coordinates(sight), -1.0, 1.0, "direction")

    def azimuth(self, scan: Scan) -> int:
        """Bins of a scan around the axis of the lidar."""
        return self._lidar.bins if scan.planar else self._lidar.azimuth

    def _plan(self, sights: Mapping[str, Scan | Compass]) -> None:
        """Settle in which order these sights are looked at: alike ones side by side."""
        kinds: dict[tuple[bool, int], list[str]] = {}
        for name, sight in sights.items():
            kind = (isinstance(sight, Compass), self._coordinates(sight))
            kinds.setdefault(kind, []).append(name)
        self._order = [name for kind in sorted(kinds) for name in kinds[kind]]
        self._size = max((size for _, size in kinds), default=2)
        self._flat = 0  # points seen as lying on the floor, whatever their height; they come first
        self._scans: list[tuple[int, slice, list[int], list[str]]] = []
        self._compasses: list[tuple[int, slice, list[str]]] = []
        start = 0
        for towards, size in sorted(kinds):
            names = kinds[towards, size]
            each = [1 if towards else sights[name][0].shape[1] for name in names]
            where = slice(start, start + sum(each))
            if towards:
                self._compasses.append((size, where, names))
            else:
                self._scans.append((size, where, each, names))
                self._flat = where.stop if size == 2 else self._flat
            start = where.stop

    def look(
        self, sights: Mapping[str, Scan | Compass], origin: Array, rotation: Array
    ) -> dict[str, Array]:
        """What is seen, by name: [N, bodies · bins] or [N, bodies · coordinates].

        :param sights: by name
        :param origin: positions of the lidar bodies, [N, B, 3] m
        :param rotation: rotations of the lidar bodies, body to world, [N, B, 3, 3]
        """
        if not sights:
            return {}
        seen = [(name, s[0].shape, s.planar) for name, s in sights.items()]
        if seen != self._seen:
            self._plan(sights)
            self._seen = seen
        columns = [sights[name][0].T for name in self._order]  # of a compass [3, N]
        points = np.concatenate([c if c.ndim == 3 else c[:, None] for c in columns], axis=1)
        points[2, : self._flat] = 0.0
        v = into_frames(origin, rotation, points, self._size)  # [2 or 3, B, K, N]
        out, n = {}, len(origin)
        for size, where, groups, names in self._scans:
            closeness = self._lidar.scan(v[:size, :, where], groups)
            for i, name in enumerate(names):
                out[name] = closeness[:, :, i].reshape(n, -1)
                lit = sights[name].lit  # type: ignore[union-attr]
                if lit is not None:
                    out[name][~np.asarray(lit, dtype=bool)] = 0.0
        for size, where, names in self._compasses:
            directions = compass(v[:size, :, where])
            for i, name in enumerate(names):
                out[name] = directions[:, :, i].T.reshape(n, -1)
        return out

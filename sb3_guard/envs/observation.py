"""What is observed: values, and points seen by pseudo-lidar or compass.

Every part names what it lets the robot observe (``Part.observations``): each is a :class:`Scan`, a
:class:`Compass` or :class:`Values`.
Formulas: Ray et al. 2019 (Safety Gym) and, for the third dimension, Zhao et al. 2024 (GUARD).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sb3_guard.envs.geometry import length
from sb3_guard.envs.parameters import Parameters, param
from sb3_guard.envs.types import Array


@dataclass(frozen=True)
class Channel:
    """One named component of the observation: its size, bounds and unit."""

    size: int
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""


class Scan(NamedTuple):
    """Points that are seen by pseudo-lidar.

    :param points: [N, K, 3] m
    :param planar: whether they lie in the plane: one ring of bins instead of a sphere, whatever
        their height
    :param color: of the lidar's ring in pictures; None: the part's
    :param visible: the rows in which they are seen, [N] bool; None: all
    """

    points: Array
    planar: bool
    color: tuple[float, float, float] | None = None
    visible: Array | None = None


class Compass(NamedTuple):
    """A point whose direction is observed.

    :param point: [N, 3] m
    :param planar: whether it lies in the plane; of a robot in the plane two coordinates are seen
    """

    point: Array
    planar: bool = True


class Values(NamedTuple):
    """Numbers that are observed as they are.

    :param values: [N, d], always the same d
    :param low: their least value
    :param high: their greatest value
    :param unit: such as ``"m/s"``
    """

    values: Array
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""


Observations = Mapping[str, Scan | Compass | Values]


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
    falloff: str = param(
        "exponential",
        "closeness: exp(−gain · distance), or 1 − distance / range",
        choices=("exponential", "linear"),
    )
    gain: float = param(1.0, "decay of an exponential falloff, 1/m", above=0)
    range: float | None = param(
        None, "distance at which a linear falloff reaches 0, m; null: 3", above=0
    )
    alias: bool = param(True, "whether an object also shows, weaker, in the neighbouring bins")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.falloff == "exponential" and self.range is not None:
            raise ValueError(
                f"lidar.range = {self.range!r} needs a linear falloff: set lidar={{'falloff': "
                f"'linear', 'range': {self.range!r}}}, or "
                "lidar={'falloff': 'exponential', 'range': None}"
            )

    def size(self, planar: bool) -> int:
        """Number of bins of one lidar body."""
        return self.bins if planar else self.azimuth * self.elevation

    def channel(self, bodies: int, planar: bool) -> Channel:
        """What :meth:`scan` returns of a group, once flattened to [N, bodies · bins]."""
        return Channel(bodies * self.size(planar), 0.0, 1.0, "closeness")

    def described(self, planar: bool) -> dict[str, Any]:
        """The meaning of its numbers, for a sensor that delivers the same."""
        columns, rows = (self.bins, 1) if planar else (self.azimuth, self.elevation)
        a, e = 360 / columns, 180 / rows
        bins = f"azimuths from {a:g} i to {a:g} (i + 1) degrees, from x towards y"
        up = f"; elevations from {e:g} j - 90 to {e:g} (j + 1) - 90; at {rows} i + j"
        linear, far = f"max(0, 1 - d / {self.range or 3:g})", f"exp(-{self.gain:g} d)"
        near = linear if self.falloff == "linear" else far
        return {"closeness": near, "bins": bins if planar else bins + up, "alias": self.alias}

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
        if self.falloff == "exponential":
            np.exp(np.multiply(-self.gain, distance, out=distance), out=closeness)
        else:
            limit = 3.0 if self.range is None else self.range
            np.maximum(0.0, limit - distance, out=closeness)
            closeness /= limit
        turn = np.arctan2(v[1], v[0])
        turn *= columns / (2 * math.pi)
        turn += columns * (turn < 0)  # as turn %= columns, in a third of its time
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

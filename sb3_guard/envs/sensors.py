"""What a robot perceives of the other parts: pseudo-lidar and compass, as arrays.

Both work on points already expressed in body frames, by coordinate, as
:func:`sb3_guard.envs.geometry.into_frames` gives them.
Formulas: Ray et al. 2019 (Safety Gym) and, for the third dimension, Zhao et al. 2024 (GUARD).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from sb3_guard.envs.geometry import length
from sb3_guard.envs.parameters import Parameters, param

Array = np.ndarray


@dataclass(frozen=True)
class Channel:
    """One named component of the observation: its size, bounds and unit."""

    size: int
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""


def compass(v: Array) -> Array:
    """Nearly unit vectors towards points from offsets by coordinate, both [2 or 3, ...] m.

    The length is ‖v‖ / (‖v‖ + 1 mm): zero, not NaN, on the spot.
    """
    return v / (length(v) + 0.001)


@functools.lru_cache
def _starts(n: int, bodies: int, bins: int) -> Array:
    """Flat index of the first bin of every body in an array [N, B, bins]: [B, 1, N]."""
    return np.arange(0, n * bodies * bins, bins).reshape(n, bodies).T[:, None].copy()


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
        """What :meth:`scan` returns once flattened to [N, bodies · bins]."""
        return Channel(bodies * self.size(planar), 0.0, 1.0, "closeness")

    def scan(self, v: Array) -> Array:
        """Closeness per bin and body.

        :param v: objects in body frames, by coordinate: [2, B, K, N] m in the plane, [3, B, K, N] m
            in space
        :return: [N, B, bins] or [N, B, azimuth · elevation], within [0, 1]
        """
        d, bodies, _, n = v.shape
        columns, rows = (self.bins, 1) if d == 2 else (self.azimuth, self.elevation)
        distance = length(v)
        if self.max_distance is None:
            closeness = np.exp(-self.gain * distance)
        else:
            closeness = np.maximum(0.0, self.max_distance - distance) / self.max_distance
        turn = np.arctan2(v[1], v[0])
        turn *= columns / (2 * math.pi)
        turn %= columns
        column = np.minimum(turn.astype(np.intp), columns - 1)
        cell, values = column, [closeness]
        if self.alias:
            turned = (turn - column) * closeness
            values += [turned, closeness - turned]
        if rows > 1:
            tilt = np.arctan2(v[2], length(v[:2]))
            tilt += math.pi / 2
            tilt *= rows / math.pi
            row = np.minimum(tilt.astype(np.intp), rows - 1)
            cell = column * rows + row
            if self.alias:
                raised = (tilt - row) * closeness
                values += [raised, closeness - raised]
        places = _shown(columns, rows, self.alias).take(cell, axis=1)
        places += _starts(n, bodies, columns * rows)
        out = np.zeros((n, bodies, columns * rows))
        np.maximum.at(out.reshape(-1), places.reshape(-1), np.concatenate(values, axis=None))
        return out

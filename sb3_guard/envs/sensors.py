"""What a robot perceives of the other parts: pseudo-lidar and compass, as arrays.

Both work on points already expressed in body frames (:func:`sb3_guard.envs.geometry.into_frames`).
Formulas: Ray et al. 2019 (Safety Gym) and, for the third dimension, Zhao et al. 2024 (GUARD).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

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
    """Nearly unit vectors towards points, [..., d], from offsets in metres, [..., d].

    The length is ‖v‖ / (‖v‖ + 1 mm): zero, not NaN, on the spot.
    """
    total = v[..., 0] * v[..., 0]
    for j in range(1, v.shape[-1]):
        total = total + v[..., j] * v[..., j]
    return v / (np.sqrt(total) + 0.001)[..., None]


@dataclass(frozen=True)
class Lidar(Parameters):
    """A pseudo-lidar: each bin holds the closeness of the nearest object in its direction."""

    name = "lidar"

    bins: int = param(16, "directions in the plane", low=1)
    azimuth: int = param(10, "directions around, in space", low=1)
    elevation: int = param(6, "directions from down to up, in space", low=1)
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

        :param v: objects in body frames, [N, B, K, 2] m in the plane, [N, B, K, 3] m in space
        :return: [N, B, bins] or [N, B, azimuth · elevation], within [0, 1]
        """
        n, bodies, _, d = v.shape
        size = self.size(d == 2)
        out = np.zeros((n, bodies, size))
        flat = out.reshape(-1)
        x, y = v[..., 0], v[..., 1]
        planar2 = x * x + y * y
        length = np.sqrt(planar2 if d == 2 else planar2 + v[..., 2] * v[..., 2])
        if self.max_distance is None:
            closeness = np.exp(-self.gain * length)
        else:
            closeness = np.maximum(0.0, self.max_distance - length) / self.max_distance
        columns = self.bins if d == 2 else self.azimuth
        turn = np.arctan2(y, x) * (columns / (2 * math.pi))
        turn = np.where(turn < 0, turn + columns, turn)
        column = np.minimum(turn.astype(np.intp), columns - 1)
        across = turn - column
        base = (np.arange(n * bodies) * size).reshape(n, bodies, 1)
        after = np.where(column + 1 == columns, 0, column + 1)
        before = np.where(column == 0, columns - 1, column - 1)

        def mark(index: Array, value: Array) -> None:
            np.maximum.at(flat, index.reshape(-1), value.reshape(-1))

        if d == 2:
            mark(base + column, closeness)
            if self.alias:
                mark(base + after, across * closeness)
                mark(base + before, (1 - across) * closeness)
            return out
        rows = self.elevation
        tilt = (np.arctan2(v[..., 2], np.sqrt(planar2)) + math.pi / 2) * (rows / math.pi)
        row = np.minimum(tilt.astype(np.intp), rows - 1)
        up = tilt - row
        mark(base + column * rows + row, closeness)
        if self.alias:
            mark(base + after * rows + row, across * closeness)
            mark(base + before * rows + row, (1 - across) * closeness)
            # elevation does not wrap: the outermost bins keep their own neighbour's share
            mark(base + column * rows + np.minimum(row + 1, rows - 1), up * closeness)
            mark(base + column * rows + np.maximum(row - 1, 0), (1 - up) * closeness)
        return out

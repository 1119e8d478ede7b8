"""What a robot perceives of the other parts: pseudo-lidar and compass, as arrays.

Both work on points already expressed in body frames (:func:`sb3_guard.envs.geometry.into_frames`).
Formulas: Ray et al. 2019 (Safety Gym) and, for the third dimension, Zhao et al. 2024 (GUARD).
"""

from __future__ import annotations

import functools
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


@functools.lru_cache
def _starts(n: int, bodies: int, columns: int, rows: int) -> Array:
    """Flat index of bin (1, 0) of every body in an array [N, B, columns, rows]: [N, B, 1]."""
    return np.arange(rows, n * bodies * columns * rows, columns * rows).reshape(n, bodies, 1)


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
        columns, rows = (self.bins, 1) if d == 2 else (self.azimuth, self.elevation)
        x, y = v[..., 0], v[..., 1]
        planar = np.sqrt(x * x + y * y)
        length = planar if d == 2 else np.sqrt(x * x + y * y + v[..., 2] * v[..., 2])
        if self.max_distance is None:
            closeness = np.exp(-self.gain * length)
        else:
            closeness = np.maximum(0.0, self.max_distance - length) / self.max_distance
        # a ring of columns with a spare one at either end, folded onto the other end when all is
        # in: neighbours need no wrapping
        out = np.zeros((n, bodies, columns + 2, rows))
        turn = np.arctan2(y, x) * (columns / (2 * math.pi)) % columns
        column = np.minimum(turn.astype(np.intp), columns - 1)
        place = _starts(n, bodies, columns + 2, rows) + column * rows  # [N, B, K] index into out
        if d == 3:
            tilt = (np.arctan2(v[..., 2], planar) + math.pi / 2) * (rows / math.pi)
            row = np.minimum(tilt.astype(np.intp), rows - 1)
            place += row
        places, values = [place], [closeness]
        if self.alias:
            turned = (turn - column) * closeness
            places += [place + rows, place - rows]
            values += [turned, closeness - turned]
            if d == 3:
                # elevation does not wrap: beyond the poles there is only the polar bin itself
                raised = (tilt - row) * closeness
                places += [place + (row < rows - 1), place - (row > 0)]
                values += [raised, closeness - raised]
        np.maximum.at(
            out.reshape(-1), np.concatenate(places, axis=None), np.concatenate(values, axis=None)
        )
        if self.alias:
            np.maximum(out[:, :, 1], out[:, :, -1], out=out[:, :, 1])
            np.maximum(out[:, :, -2], out[:, :, 0], out=out[:, :, -2])
        return out[:, :, 1:-1].reshape(n, bodies, columns * rows)

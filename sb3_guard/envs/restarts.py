"""Layouts by the rule to the letter: whenever an object finds no room, all over again.

Where few layouts succeed, many are begun at once, and those that succeed are kept for the next
episodes of the same row. All are independent draws from one generator, so their distribution is
that of one after the other.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from sb3_guard.envs.layout import Footprint, square_distance
from sb3_guard.envs.types import Array

TRIES = (6, 12, 20, 30, 32)  # draws of an object, 100, each batch only if those before clash
BLOCK = 256  # layouts begun at once
KEPT = 16  # of those that succeed


class Restarts:
    """Draws layouts until one succeeds.

    :param footprints: what to place, in order
    :param count: layouts begun, in blocks of 256, before it is given up
    :param array: gives arrays ``[N, *shape]`` by name, which are part of the engine's state
    """

    def __init__(
        self, footprints: Sequence[Footprint], count: int, array: Callable[..., Array]
    ) -> None:
        self._blocks = math.ceil(count / BLOCK)
        objects = sum(f.num for f in footprints)
        self._kept = array("restarts/kept", (KEPT, 2, objects))
        self._left = array("restarts/left", dtype=np.int64)  # how many are kept, [N]

    def forget(self, rows: Array | int) -> None:
        """Forget layouts that are kept, since the generators of these rows change."""
        self._left[rows] = 0

    def draw(
        self,
        row: int,
        rng: np.random.Generator,
        footprints: Sequence[Footprint],
        apart: Array,
        xy: Array,
        fixed: Array,
        begin: bool,
    ) -> Array | None:
        """A layout in which each object in turn found room among 100 draws.

        :param footprints: what to place in this episode, in order; K objects, as when those
            layouts were begun that are kept
        :param apart: squared distances that objects keep, [K, K, 1] m²
        :param xy: where those are that have a fixed place, [2, K, 1] m
        :param fixed: which these are, [K] bool
        :param begin: whether layouts are begun if none is kept
        :return: all places, [2, K, 1] m, or None if there is no such layout
        """
        owner = [f for f in footprints for _ in range(f.num)]
        for _ in range(self._blocks * begin):
            if self._left[row]:
                break
            layouts = self._begin(owner, rng, apart, xy, fixed)
            self._left[row] = len(layouts)
            self._kept[row, : len(layouts), :, : len(owner)] = layouts[::-1]
        if not self._left[row]:
            return None
        self._left[row] -= 1
        return self._kept[row, self._left[row], :, : len(owner), None].copy()

    def _begin(
        self,
        owner: Sequence[Footprint],
        rng: np.random.Generator,
        apart: Array,
        xy: Array,
        fixed: Array,
    ) -> Array:
        """The first of a block of layouts that succeed, [up to KEPT, 2, K] m."""
        order = np.append(np.flatnonzero(fixed), np.flatnonzero(~fixed))
        layouts = np.repeat(xy[:, order], BLOCK, axis=2)
        for i in range(int(fixed.sum()), len(order)):
            k, before = order[i], order[:i]
            room = _place(owner[k], apart[k, before, None], layouts, i, rng)
            layouts = layouts[:, :, room]
        out = np.empty((min(layouts.shape[2], KEPT), *layouts.shape[:2]))
        out[..., order] = np.moveaxis(layouts[:, :, :KEPT], 2, 0)
        return out


def _place(f: Footprint, apart: Array, layouts: Array, i: int, rng: np.random.Generator) -> Array:
    """Place object ``i`` clear of those before it, in each of n layouts.

    :param apart: squared distances to keep from those, [i, 1, 1] m²
    :param layouts: the places in the layouts, [2, K, n] m, to be written
    :return: in which it found room, [n] bool
    """
    room = np.zeros(layouts.shape[2], dtype=bool)
    rows = np.arange(len(room))
    for tries in TRIES:
        draws = f.draw(rng, tries * len(rows)).reshape(2, tries, len(rows))
        near = square_distance(draws, layouts[:, :i, None, rows]) < apart
        clash = np.logical_or.reduce(near)  # [tries, rows]
        if math.isfinite(f.reach):
            clash |= f.out_of_reach(draws)
        columns = np.arange(len(rows))
        first = clash.argmin(axis=0)  # the first clear draw, if there is one
        layouts[:, i, rows] = draws[:, first, columns]
        room[rows] = ~clash[first, columns]
        rows = np.flatnonzero(~room)
        if not len(rows):
            break
    return room

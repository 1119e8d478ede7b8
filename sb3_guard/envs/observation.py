"""What is observed: values, and points seen by pseudo-lidar or compass.

Every part names what it lets the robot observe (``Part.observations``): each is a :class:`Scan`, a
:class:`Compass` or :class:`Values`. The :class:`Observer` makes the observation of them, with one
pass over all points whatever parts they belong to.
Formulas: Ray et al. 2019 (Safety Gym) and, for the third dimension, Zhao et al. 2024 (GUARD).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from sb3_guard.envs.geometry import into_frames, length
from sb3_guard.envs.parameters import Parameters, PartError, misshapen, param
from sb3_guard.spelling import did_you_mean

if TYPE_CHECKING:
    from sb3_guard.envs.part import Part, Robot

Array = np.ndarray


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


class Observer:
    """Makes the observation of what the parts of a world let the robot observe.

    :param robot: whose lidar bodies see all scans and compasses
    :param parts: what they are of
    :param lidar: settings of the pseudo-lidar
    :param components: names of what is observed, in the order of the flat observation; None:
        everything, in alphabetical order
    :raises ValueError: an unknown component, with the nearest match; two parts observe one name; a
        part's observations are not what they must be
    """

    def __init__(
        self,
        robot: Robot,
        parts: Sequence[Part],
        lidar: Lidar,
        components: Sequence[str] | None = None,
    ) -> None:
        self._robot, self._parts, self._lidar = robot, parts, lidar
        self._level = robot.workspace == "planar"
        self._rows, self._bodies = robot.frames[0].shape[:2]
        self._checked = False  # whether points and values have been found to be finite
        self._seen: list[tuple[str, tuple[int, ...], bool]] = []  # name, shape, planar
        known: dict[str, Channel] = {}
        for part in parts:
            check_observations(part, self._rows)
            for name, channel in self.channels_of(part).items():
                if name in known:
                    raise ValueError(
                        f"{part.name} and another part both observe {name!r}; give the constraint, "
                        "or the robot's sensor, another name"
                    )
                known[name] = channel
        self._names = known.keys()
        for name in components or ():
            if name not in known:
                hint = did_you_mean(name, sorted(known))
                raise ValueError(f"observe.components names no component {name!r}: {hint}")
        chosen = sorted(known) if components is None else components
        self.channels = {name: known[name] for name in chosen}
        self.slices: dict[str, slice] = {}
        self.size = 0
        for name, channel in self.channels.items():
            self.slices[name] = slice(self.size, self.size + channel.size)
            self.size += channel.size

    def _coordinates(self, what: Scan | Compass) -> int:
        """How many coordinates of its points, in the bodies' frames, count."""
        return 2 if what.planar and (self._level or isinstance(what, Scan)) else 3

    def channels_of(self, part: Part) -> dict[str, Channel]:
        """Size, bounds and unit of what one part lets the robot observe, by name."""
        return {name: self._channel(what) for name, what in part.observations().items()}

    def _channel(self, what: Scan | Compass | Values) -> Channel:
        if isinstance(what, Values):
            return Channel(what.values.shape[1], what.low, what.high, what.unit)
        if isinstance(what, Scan):
            return self._lidar.channel(self._bodies, what.planar)
        return Channel(self._bodies * self._coordinates(what), -1.0, 1.0, "direction")

    def observe(self, dtype: DTypeLike = np.float32) -> Array:
        """The flat observation of every row, [N, D], a new array.

        :param dtype: what the observation, computed in float64, is cast to
        :raises ValueError: names or sizes are not those of the first observation
        """
        if not self._checked:
            for part in self._parts:
                check_observations(part, self._rows, finite=True)
            self._checked = True
        found: dict[str, Scan | Compass | Values] = {}
        for part in self._parts:
            found.update(part.observations())
        if found.keys() != self._names:
            odd = ", ".join(map(repr, sorted(found.keys() ^ self._names)))
            raise ValueError(
                f"observations() must always have the same names; {odd} came or went: for what is "
                "not seen, give a Scan that is not visible, or zeros"
            )
        try:
            seen = self.look({name: found[name] for name in self.channels})
        except Exception:
            for part in self._parts:  # whose fault is it?
                check_observations(part, self._rows, finite=True)
            raise
        obs = np.concatenate([seen[name] for name in self.slices], axis=1, dtype=dtype)
        if obs.shape[1] != self.size:
            widths = {name: (c.size, np.shape(seen[name])[1]) for name, c in self.channels.items()}
            name = next(n for n, (size, width) in widths.items() if size != width)
            raise ValueError(
                f"{name!r} of the observation has {widths[name][1]} columns; at first it had "
                f"{widths[name][0]}"
            )
        return obs

    def readings(self, row: int) -> list[tuple[Array, int, tuple[float, float, float]]]:
        """Every lidar of a row: closeness [bodies · bins], bins around, and color."""
        scans = {
            name: (scan, part.color if scan.color is None else scan.color)
            for part in self._parts
            for name, scan in part.observations().items()
            if isinstance(scan, Scan)
        }
        seen = self.look({name: scan for name, (scan, _) in scans.items()})
        return [
            (seen[name][row], self._lidar.bins if scan.planar else self._lidar.azimuth, color)
            for name, (scan, color) in scans.items()
        ]

    def _arrange(self, points: Mapping[str, Scan | Compass]) -> None:
        """Settle in which order points are looked at: alike ones side by side."""
        kinds: dict[tuple[bool, int], list[str]] = {}
        for name, what in points.items():
            kind = (isinstance(what, Compass), self._coordinates(what))
            kinds.setdefault(kind, []).append(name)
        self._order = [name for kind in sorted(kinds) for name in kinds[kind]]
        self._size = max((size for _, size in kinds), default=2)
        self._flat = 0  # points seen as lying on the floor, whatever their height; they come first
        self._scans: list[tuple[int, slice, list[int], list[str]]] = []
        self._compasses: list[tuple[int, slice, list[str]]] = []
        start = 0
        for towards, size in sorted(kinds):
            names = kinds[towards, size]
            each = [1 if towards else points[name][0].shape[1] for name in names]
            where = slice(start, start + sum(each))
            if towards:
                self._compasses.append((size, where, names))
            else:
                self._scans.append((size, where, each, names))
                self._flat = where.stop if size == 2 else self._flat
            start = where.stop

    def look(self, observations: Observations) -> dict[str, Array]:
        """What is observed, by name: [N, bodies · bins], [N, bodies · coordinates] or values."""
        out: dict[str, Array] = {}
        points: dict[str, Scan | Compass] = {}
        for name, what in observations.items():
            if isinstance(what, Values):
                out[name] = what.values
            else:
                points[name] = what
        if not points:
            return out
        seen = [(name, s[0].shape, s.planar) for name, s in points.items()]
        if seen != self._seen:
            self._arrange(points)
            self._seen = seen
        origin, rotation = self._robot.frames
        columns = [points[name][0].T for name in self._order]  # of a compass [3, N]
        places = np.concatenate([c if c.ndim == 3 else c[:, None] for c in columns], axis=1)
        places[2, : self._flat] = 0.0
        v = into_frames(origin, rotation, places, self._size)  # [2 or 3, B, K, N]
        n = len(origin)
        for size, where, groups, names in self._scans:
            closeness = self._lidar.scan(v[:size, :, where], groups)
            for i, name in enumerate(names):
                out[name] = closeness[:, :, i].reshape(n, -1)
                visible = points[name].visible  # type: ignore[union-attr]
                if visible is not None:
                    out[name][~np.asarray(visible, dtype=bool)] = 0.0
        for size, where, names in self._compasses:
            directions = compass(v[:size, :, where])
            for i, name in enumerate(names):
                out[name] = directions[:, :, i].T.reshape(n, -1)
        return out


def check_observations(part: Part, rows: int, finite: bool = False) -> None:
    """Refuse observations that are not what they must be.

    :param part: whose observations
    :param rows: N
    :param finite: whether their numbers must be finite: once an episode has begun
    :raises PartError: names the part, the observation and what it must be
    """
    found = part.observations()
    if not isinstance(found, Mapping):
        raise PartError(
            f"observations() of {part.name} gives {found!r}: it must be a mapping of names to "
            "Scan, Compass or Values, {} for none"
        )
    for name, what in found.items():
        label = f"observations()[{name!r}] of {part.name}"
        rest = {Scan: ("K", 3), Compass: (3,), Values: ("d",)}.get(type(what))
        if rest is None:
            raise PartError(
                f"{label} is {what!r}: it must be a Scan of points [N, K, 3], a Compass to a point "
                "[N, 3] or Values [N, d]"
            )
        shape, expected = np.shape(what[0]), (rows, *rest)
        fits = len(shape) == len(expected) and all(
            isinstance(e, str) or e == s for s, e in zip(shape, expected, strict=True)
        )
        visible = what.visible if isinstance(what, Scan) else None
        if not isinstance(what[0], np.ndarray) or not fits:
            raise PartError(misshapen(label, shape, expected))
        if visible is not None and np.shape(visible) != (rows,):
            raise PartError(misshapen(f"visible of {label}", np.shape(visible), (rows,)))
        if finite and not np.isfinite(what[0].astype(float)).all():
            raise PartError(f"{label} is not finite: {what[0][0]}")

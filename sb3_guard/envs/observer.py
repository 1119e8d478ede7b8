"""The observation: what all parts let the robot observe, in one pass over all points."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from sb3_guard.envs.geometry import into_frames
from sb3_guard.envs.observation import Channel, Compass, Lidar, Observations, Scan, Values, compass
from sb3_guard.envs.part import Part, Robot
from sb3_guard.envs.types import Array
from sb3_guard.fields import did_you_mean


class Observer:
    """Makes the observation of what the parts of a world let the robot observe.

    :param robot: whose lidar bodies see all scans and compasses
    :param parts: what they are of
    :param lidar: settings of the pseudo-lidar
    :param components: names of what is observed, in the order of the flat observation; None:
        everything, in alphabetical order
    :raises ValueError: an unknown component, with the nearest match; two parts observe one name
    """

    def __init__(
        self,
        robot: Robot,
        parts: Sequence[Part],
        lidar: Lidar,
        components: Sequence[str] | None = None,
    ) -> None:
        self._robot, self._lidar = robot, lidar
        self._parts = [part for part in parts if part.observations()]  # always of the same names
        self._level = robot.workspace == "planar"
        self._bodies = robot.frames[0].shape[1]
        self._seen: list[tuple[str, tuple[int, ...], bool]] = []  # name, shape, planar
        known: dict[str, Channel] = {}
        for part in self._parts:
            for name, channel in self.channels_of(part).items():
                if name in known:
                    raise ValueError(
                        f"{part.name} and another part both observe {name!r}; give the constraint, "
                        "or the robot's sensor, another name"
                    )
                known[name] = channel
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

    def described(self) -> dict[str, dict[str, Any]]:
        """Formula, order, frames and axes that real sensors have to deliver, by component."""
        robot, found = self._robot, dict[str, dict[str, Any]]()
        bodies: Any = getattr(robot, "sensing", None) or getattr(robot, "lidar_bodies", ())
        for name, what in [each for part in self._parts for each in part.observations().items()]:
            if isinstance(what, Values):
                found[name] = getattr(robot, "described", lambda name: {})(name)
                continue
            said = {"direction": "v / (|v| + 0.001)"}
            said = self._lidar.described(what.planar) if isinstance(what, Scan) else said
            found[name] = {"frames": [*bodies], "axes": "xyz"[: self._coordinates(what)], **said}
        return found

    def _channel(self, what: Scan | Compass | Values) -> Channel:
        if isinstance(what, Values):
            return Channel(what.values.shape[1], what.low, what.high, what.unit)
        if isinstance(what, Scan):
            return self._lidar.channel(self._bodies, what.planar)
        return Channel(self._bodies * self._coordinates(what), -1.0, 1.0, "direction")

    def observe(self, dtype: DTypeLike = np.float32) -> Array:
        """The flat observation of every row, [N, D], a new array.

        :param dtype: what the observation, computed in float64, is cast to
        """
        found: dict[str, Scan | Compass | Values] = {}
        for part in self._parts:
            found.update(part.observations())
        seen = self.look({name: found[name] for name in self.channels})
        return np.concatenate([seen[name] for name in self.slices], axis=1, dtype=dtype)

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
        self._size = max(size for _, size in kinds)
        self._scans: list[tuple[int, slice, list[int], list[str]]] = []
        self._compasses: list[tuple[int, slice, list[str]]] = []
        nums = {name: math.prod(what[0].shape[1:-1]) for name, what in points.items()}
        # all points by coordinate, [2 or 3, K, N] m, and where in it those of each are
        self._points = np.zeros((3, sum(nums.values()), len(next(iter(points.values()))[0])))
        self._places: dict[str, Array] = {}
        start = 0
        for towards, size in sorted(kinds):
            names, first = kinds[towards, size], start
            for name in names:
                columns = start if towards else slice(start, start + nums[name])
                # the z that a planar scan leaves out stays 0: it sees points as lying on the floor
                self._places[name] = self._points[: 3 if towards else size, columns]
                start += nums[name]
            where = slice(first, start)
            if towards:
                self._compasses.append((size, where, names))
            else:
                self._scans.append((size, where, [nums[name] for name in names], names))

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
        for name, places in self._places.items():  # [2 or 3, K, N]; of a compass [3, N]
            places[:] = points[name][0].T[: len(places)]
        v = into_frames(origin, rotation, self._points, self._size)  # [2 or 3, B, K, N]
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

"""What a picture shows in addition to the bodies: zones, lidars, shadows, border and cameras.

All of it is added to the abstract scene of one frame, so the physics model has none of it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sb3_guard.envs.types import Array

if TYPE_CHECKING:
    from sb3_guard.envs.engine import Engine
    from sb3_guard.envs.part import Robot

COST_COLOR = (0.85, 0.1, 0.1)
SHADOW = (0.58, 0.60, 0.63)
RING, RING_STEP = 0.15, 0.06  # m, radius of the first lidar ring, and how much wider each next is
BEAD = 0.02  # m, radius
WALL = 0.2  # m, height of a wall that is drawn only
# m along x and y for each m of height: a shadow falls away from the light
_SLANT = np.array([0.25, 0.35])
_SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE
_CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
_BOX = mujoco.mjtGeom.mjGEOM_BOX
_LABEL = mujoco.mjtGeom.mjGEOM_LABEL


class ScenePainter:
    """Adds shapes to a scene, for :meth:`sb3_guard.envs.part.Part.draw`.

    :param scene: what they are added to
    :param engine: whose parts draw
    :param data: one row's state
    :param row: which row
    """

    def __init__(
        self, scene: mujoco.MjvScene, engine: Engine, data: mujoco.MjData, row: int
    ) -> None:
        self._scene, self._engine, self._data, self._row = scene, engine, data, row
        self._rings = 0

    def zone(
        self, center: Array, radius: float, half_height: float, color: tuple[float, ...]
    ) -> None:
        """A cylinder, or a sphere if ``half_height`` is 0, at ``center``, [3] m."""
        kind = _CYLINDER if half_height else _SPHERE
        height = half_height or radius
        self._add(kind, (radius, height, height), center, (*color, 0.35))

    def wall(self, start: Array, end: Array, color: tuple[float, ...]) -> None:
        """A see-through wall on the floor between two places, [2] m."""
        along, high = (end - start) / 2, WALL / 2
        middle = np.array([*(start + along), self.floor + high])
        shape = self._add(_BOX, (float(np.hypot(*along)), 0.015, high), middle, (*color, 0.5))
        if shape is not None:
            x, y = along / np.hypot(*along)
            shape.mat[:] = [[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]]

    @functools.cached_property
    def floor(self) -> float:
        """Its height, m."""
        planes = self._engine.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        return float(min(self._data.geom_xpos[planes, 2], default=0.0))

    @functools.cached_property
    def _first_ring(self) -> tuple[Array, Array, Array]:
        """Its centers [B, 3] m, the rotations [B, 3, 3] of the lidar bodies, its radii [B] m."""
        robot, model = self._engine.robot, self._engine.model
        origin, rotation = robot.frames
        # above robots on the floor, where it can be seen
        lift = [0.0, 0.0, 0.25 if robot.workspace == "planar" else 0.0]
        centers = origin[self._row] + lift
        thick = _thickness(model, self._data, robot_geoms(model, robot), centers)
        return centers, rotation[self._row], np.maximum(RING, thick + 1.5 * BEAD)

    def ring(self, closeness: Array, azimuth: int, color: tuple[float, ...]) -> None:
        """Beads around each lidar body, the more solid the closer what they show.

        The first ring has a radius of 15 cm, or more where the robot itself would hide it; each
        other one is 6 cm wider.

        :param closeness: [bodies · azimuth · elevation]
        :param azimuth: bins around
        :param color: red, green, blue
        """
        centers, rotations, radii = self._first_ring
        radii = radii + RING_STEP * self._rings
        self._rings += 1
        beads = np.asarray(closeness).reshape(len(radii), azimuth, -1)
        for b, a, e in np.ndindex(*beads.shape):
            turn = (a + 0.5) * 2 * math.pi / azimuth
            rise = (e + 0.5) * math.pi / beads.shape[2] - math.pi / 2
            ray = np.array(
                [math.cos(turn) * math.cos(rise), math.sin(turn) * math.cos(rise), math.sin(rise)]
            )
            at = centers[b] + rotations[b] @ (radii[b] * ray)
            self._add(_SPHERE, (BEAD,) * 3, at, (*color, 0.08 + 0.92 * float(beads[b, a, e])))

    def shadows(self) -> None:
        """The shadow on the floor of every body that is in the scene so far.

        A flat copy of each geom, cast along the light: soft enough, and without the marks of
        shadow maps, in which zones would throw shadows too. A world with such lights has none.
        """
        model = self._engine.model
        if not model.nlight or model.light_castshadow.any():
            return
        flat = np.array([[1.0, 0.0, _SLANT[0]], [0.0, 1.0, _SLANT[1]], [0.0, 0.0, 0.0]])
        plane = int(mujoco.mjtGeom.mjGEOM_PLANE)
        bodies = [g for g in self._scene.geoms[: self._scene.ngeom] if g.type != plane]
        for body in bodies:
            place = flat @ (body.pos - [0.0, 0.0, self.floor]) + [0.0, 0.0, self.floor + 0.002]
            shape = self._add(_SPHERE, (1.0, 1.0, 1.0), place, (*SHADOW, 1.0))
            if shape is None or body.pos[2] < self.floor:
                return
            shape.type, shape.dataid, shape.size[:] = body.type, body.dataid, body.size
            # a copy thinner than it is far from the floor's depth steps
            shape.mat[:] = (flat + np.diag([0.0, 0.0, 1e-3])) @ body.mat
            shape.specular = 0.0

    def border(self, middle: Array, half: Array, color: tuple[float, ...]) -> None:
        """A line around a rectangle on the floor.

        :param middle: its middle, [2] m
        :param half: half its sides, [2] m
        """
        width = 0.008 * float(max(half))
        for axis in (0, 1):
            for side in (-1.0, 1.0):
                at, size = np.array([*middle, self.floor]), [*(half + width), 0.003]
                at[axis] += side * half[axis]
                size[axis] = width
                self._add(_BOX, tuple(size), at, (*color, 1.0))

    def heading(self) -> None:
        """A dart on the floor, where a robot that moves on it looks."""
        robot, row = self._engine.robot, self._row
        origin, rotation = robot.frames
        forward = getattr(robot, "eye", (None, None, (1.0, 0.0, 0.0)))[2]
        ahead = (rotation[row, 0] @ forward) * [1.0, 1.0, 0.0]
        length = float(np.linalg.norm(ahead))
        if robot.workspace != "planar" or length < 1e-3:
            return
        ahead /= length
        reach = float(self._first_ring[2][0]) + 0.05
        start = origin[row, 0] + reach * ahead
        start[2] = self.floor + 0.03
        dart = self._add(_SPHERE, (1.0, 1.0, 1.0), start, (0.15, 0.15, 0.2, 1.0))
        if dart is not None:
            mujoco.mjv_connector(
                dart, mujoco.mjtGeom.mjGEOM_ARROW, 0.03, start, start + 0.3 * ahead
            )

    def glow(self, center: Array) -> None:
        """The tint of a robot while it has a cost."""
        self._add(_SPHERE, (0.3,) * 3, center, (*COST_COLOR, 0.5))

    def say(self, words: Mapping[str, str], aspect: float, line: float) -> None:
        """Text in the upper left corner of a picture.

        :param words: of each line, by name
        :param aspect: width of the picture by its height
        :param line: height of a line, by the picture's
        """
        eye = self._scene.camera[0]
        right = np.cross(eye.forward, eye.up)
        for i, (name, text) in enumerate(words.items(), start=1):
            x, y = -0.9 * aspect, 1.0 - 2.0 * line * i  # from -1 to 1
            slope = eye.frustum_top / eye.frustum_near
            place = eye.pos + eye.forward + slope * (x * right + y * eye.up)  # 1 m away
            label = self._add(_LABEL, (0.1,) * 3, place, (1.0, 1.0, 1.0, 1.0))
            if label is not None:
                label.label = f"{name} {text}"

    def _add(
        self, kind: mujoco.mjtGeom, size: tuple[float, ...], center: Array, rgba: tuple[float, ...]
    ) -> mujoco.MjvGeom | None:
        scene = self._scene
        if scene.ngeom >= scene.maxgeom:
            return None
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(
            geom,
            kind,
            np.asarray(size, dtype=float),
            np.asarray(center, dtype=float),
            np.eye(3).reshape(-1),
            np.asarray(rgba, dtype=np.float32),
        )
        scene.ngeom += 1
        return geom


def frame_all(points: Array, elevation: float, aspect: float, fovy: float) -> tuple[Array, float]:
    """From where a camera that looks along y sees all points, and they fill its picture.

    :param points: [K, 3] m
    :param elevation: of the camera above the floor, degrees; 90 looks straight down
    :param aspect: width of the picture by its height
    :param fovy: vertical angle of view, degrees
    :return: the point looked at, [3] m, and the distance to it, m
    """
    tilt = math.radians(elevation)
    right = np.array([1.0, 0.0, 0.0])
    ahead = np.array([0.0, math.cos(tilt), -math.sin(tilt)])
    up = np.array([0.0, math.sin(tilt), math.cos(tilt)])
    reach = 0.94 * math.tan(math.radians(fovy) / 2)  # a margin of 3 % on each side
    at, distance = points.mean(axis=0), 1.0
    for _ in range(50):  # a contraction: both settle within a few rounds
        offset = points - at
        depth = distance + offset @ ahead
        x, y = offset @ right / depth, offset @ up / depth
        spread = max(np.ptp(x) / aspect, np.ptp(y)) / (2 * reach)
        at = at + distance / 2 * ((x.max() + x.min()) * right + (y.max() + y.min()) * up)
        distance = max(distance * spread, 1.2 * float(-(offset @ ahead).min()), 0.1)
    return at, float(distance)


def robot_geoms(model: mujoco.MjModel, robot: Robot) -> list[int]:
    """The geoms of a robot."""
    bodies = robot.bodies(model)
    return [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] in bodies]


def _thickness(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: list[int], points: Array
) -> Array:
    """How thick the geoms around each point are, by the thickest; 0 where there is none, [B] m.

    :param points: [B, 3] m
    """
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    offset = points[:, None] - data.geom_xpos[geoms]  # [B, G, 3]
    middle, half = model.geom_aabb[geoms, :3], model.geom_aabb[geoms, 3:]  # in the geoms' frames
    inside = np.abs(np.einsum("gij,bgi->bgj", rotation, offset) - middle) <= half
    thick: Array = np.where(inside.all(axis=2), half.min(axis=1), 0.0).max(axis=1, initial=0.0)
    return thick


def has_arena(engine: Engine) -> bool:
    """Whether anything but the robot is placed in the arena: else nothing happens at its edge."""
    return any(f.num > 0 for name, f in engine.footprints.items() if name != "robot")


def arena(engine: Engine) -> tuple[Array, Array]:
    """Middle and half sides, [2] m each, of what holds all placements and locations.

    The arena belongs to it: movers and arms are at home at the origin. Where there is nothing but
    the robot, it is as large an area around its start.
    """
    boxes = list(engine.arena.placements) if has_arena(engine) else []
    for footprint in engine.footprints.values():
        boxes += footprint.placements
        boxes += [(x, y, x, y) for x, y in footprint.locations]
    boxes = boxes or list(engine.arena.placements)
    low, high = np.min(boxes, axis=0)[:2], np.max(boxes, axis=0)[2:]
    half = (high - low) / 2
    return (low + high) / 2, half if has_arena(engine) else np.maximum(half, engine.arena.size)

"""Arms stand still and are as near to things as their nearest link."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation
from sb3_guard.envs.robots.robot import PREFIX, MJCFRobot, as_slice
from sb3_guard.envs.types import Array


@dataclass
class Arm(MJCFRobot):
    """A robot arm on a fixed base. Its position is that of the end effector, its last link.

    A link is the capsule, or the sphere, around the segment from the origin of its body to that of
    the next, with the radius of its geom.
    """

    timestep = 0.002
    integrator = "Euler"
    workspace = "spatial"
    reach = 2.0
    thickness = 0.0
    links: ClassVar[tuple[str, ...]]

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        model = sim.model
        bodies = [model.body(PREFIX + link).id for link in self.links]
        self._links = as_slice(bodies)
        self._radii = model.geom_size[model.body_geomadr[bodies], 0][:, None, None]
        self.thickness = max(self.thickness, float(self._radii.max()))

    def clearance(self, points: Array, planar: bool) -> Array:
        """Distance of points from the surface of the nearest link, [N, K] m; negative inside."""
        size = 2 if planar else 3
        start = geometry.by_coordinate(self._xpos[:, self._links])[:size]  # [2 or 3, L, N]
        # the end effector is a segment of no length
        end = np.concatenate([start[:, 1:], start[:, -1:]], axis=1)
        gap = geometry.segment_distance(start, end, geometry.by_coordinate(points)[:size])
        gap -= self._radii  # [L, K, N]
        return gap.min(axis=0).T.copy()


@dataclass
class FileArm(MJCFRobot):
    """An arm of anybody's file: a link is the capsule around a geom that meets something."""

    thickness = 0.0
    heading: float = param(0.0, "heading, rad")  # never random: not all arms turn all around
    near: ClassVar[tuple[str, ...]] = ("goal", "hazards", "ghosts")  # parts in its reach
    shoulder: ClassVar[Array]  # where its first joint is in the file, [3] m
    places: ClassVar[Array]  # where its end effector can be, [n, 3] m, likewise

    def __post_init__(self) -> None:
        super().__post_init__()
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        self.hand = self.places @ turn + self.reach_center
        x, y, z = (self.shoulder @ turn + self.reach_center).tolist()
        self.reach_center = (x, y, z)
        square = [x - self.reach, y - self.reach, x + self.reach, y + self.reach]
        suited = {kind: {"placements": [square], **self.defaults[kind]} for kind in self.near}
        self.defaults = {**self.defaults, **suited}

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        model = sim.model
        meets = (model.geom_contype | model.geom_conaffinity) != 0
        of_arm = np.flatnonzero(np.isin(model.geom_bodyid, self.bodies(model)))
        geoms = of_arm[meets[of_arm]] if meets[of_arm].any() else of_arm
        middle, half = model.geom_aabb[geoms, :3], model.geom_aabb[geoms, 3:]
        longest, rows = half.argmax(axis=1), np.arange(len(geoms))
        radii = np.sort(half, axis=1)[:, 1]
        ends = np.zeros_like(half)
        ends[rows, longest] = half[rows, longest] - radii
        self._links, self._radii = geoms, radii[:, None, None]
        self.thickness = max(self.thickness, float(self._radii.max()))
        self._ends = middle - ends, middle + ends  # [L, 3] m each, in the geoms' frames

    def clearance(self, points: Array, planar: bool) -> Array:
        """Distance of points from the nearest link, [N, K] m."""
        size, batch = 2 if planar else 3, self.sim.batch
        places = batch.bind("geom_xpos")[:, self._links]  # [N, L, 3]
        axes = batch.bind("geom_xmat")[:, self._links].reshape(*places.shape, 3)
        start, end = (
            geometry.by_coordinate(places + np.einsum("nlij,lj->nli", axes, e))[:size]
            for e in self._ends
        )
        gap = geometry.segment_distance(start, end, geometry.by_coordinate(points)[:size])
        nearest: Array = (gap - self._radii).min(axis=0).T.copy()  # of [L, K, N]
        return nearest

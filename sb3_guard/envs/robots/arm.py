"""What arms share: they stand still and are as near to things as their nearest link."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from sb3_guard.envs import geometry
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Array, Simulation
from sb3_guard.envs.robots.robot import PREFIX, MJCFRobot


@dataclass
class Arm(MJCFRobot):
    """A robot arm on a fixed base; its position is the end effector's, the last link's.

    A link is the capsule, or the sphere, around the segment from the origin of its body to that of
    the next, with the radius of its geom.
    """

    timestep = 0.002
    workspace = "spatial"
    reach = 2.0
    links: ClassVar[tuple[str, ...]]

    locations: tuple[tuple[float, float], ...] = param(
        ((0.0, 0.0),), "fixed start, one (x, y), m; empty: anywhere in the placements"
    )

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        model = sim.model
        bodies = [model.body(PREFIX + link).id for link in self.links]
        # the end effector is a segment of no length
        self._starts, self._ends = bodies, [*bodies[1:], bodies[-1]]
        self._radii = model.geom_size[model.body_geomadr[bodies], 0]

    def clearance(self, points: Array, planar: bool) -> Array:
        """Distance of points from the surface of the nearest link, [N, K] m; negative inside."""
        start, end = self._xpos[:, self._starts], self._xpos[:, self._ends]  # [N, L, 3]
        if planar:
            start, end, points = start.copy(), end.copy(), points.copy()
            start[..., 2] = end[..., 2] = points[..., 2] = 0.0
        gap = geometry.segment_distance(start, end, points) - self._radii[:, None]  # [N, L, K]
        return gap.min(axis=1)

"""What arms share: they stand still and are as near to things as their nearest link."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sb3_guard.envs import geometry
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
    links: ClassVar[tuple[str, ...]]

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        model = sim.model
        bodies = [model.body(PREFIX + link).id for link in self.links]
        self._links = as_slice(bodies)
        self._radii = model.geom_size[model.body_geomadr[bodies], 0][:, None, None]

    def clearance(self, points: Array, planar: bool) -> Array:
        """Distance of points from the surface of the nearest link, [N, K] m; negative inside."""
        size = 2 if planar else 3
        start = geometry.by_coordinate(self._xpos[:, self._links])[:size]  # [2 or 3, L, N]
        # the end effector is a segment of no length
        end = np.concatenate([start[:, 1:], start[:, -1:]], axis=1)
        gap = geometry.segment_distance(start, end, geometry.by_coordinate(points)[:size])
        gap -= self._radii  # [L, K, N]
        return gap.min(axis=0).T.copy()

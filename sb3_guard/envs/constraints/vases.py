"""Vases: light boxes that must not be touched or moved."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.constraints.obstacles import Obstacles
from sb3_guard.envs.objects import BOX
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Array


@dataclass
class Vases(Obstacles):
    """Boxes that slide when pushed (Ray et al. 2019).

    Cost, over the vases: the number touched, ``displacement_weight`` times how far they are from
    their places and ``velocity_weight`` times how fast they move, where above the thresholds.
    """

    name = "vases"
    color = (0.1, 0.8, 0.85)
    trespassable = False
    movable = "passive"
    space = "planar"
    spaces = ("planar",)
    solid = True
    free = True
    usual_keepout = 0.15

    size: float = param(0.1, "half of an edge, m", above=0)
    keepout: float | None = param(
        None, "radius kept clear around a vase, m; null: 0.15, or what covers it", low=0
    )
    density: float = param(0.01, "kg/m³", above=0)
    displacement_weight: float = param(0.0, "cost per metre from its place", low=0)
    displacement_threshold: float = param(1e-3, "least displacement that costs, m", low=0)
    velocity_weight: float = param(1.0, "cost per m/s", low=0)
    velocity_threshold: float = param(1e-4, "least speed that costs, m/s", low=0)

    @property
    def cover(self) -> float:
        return math.sqrt(2) * self.size

    def shape(self, body: mujoco.MjsBody) -> None:
        geom = self.add_geom(body, BOX, (self.size, self.size, self.size))
        geom.density = self.density

    def amounts(self) -> Array:
        vases = self.bodies
        moved = geometry.distance(vases.positions, self.sim.places(self.group), planar=True)
        speed = geometry.norm(vases.velocities)
        return (
            super().amounts()
            + self.displacement_weight * np.where(moved > self.displacement_threshold, moved, 0.0)
            + self.velocity_weight * np.where(speed >= self.velocity_threshold, speed, 0.0)
        )

"""Hazards: zones on the floor that cost the robot its depth inside them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs.layout import Footprint, Rectangle
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Array, Constraint, Painter, Simulation
from sb3_guard.envs.sensors import Channel


def penetration(depth: Array, weight: float, indicator: bool) -> Array:
    """Cost of being inside zones, [N], from depths, [N, K] m, positive inside.

    Dense: weight times the sum of the depths. Indicator: 1 if inside any zone.
    """
    inside = np.maximum(depth, 0.0)
    if indicator:
        return (inside > 0).any(axis=1).astype(float)
    return weight * inside.sum(axis=1)


@dataclass
class Hazards(Constraint):
    """Zones that do not move and can be crossed (Zhao et al. 2024, §4.3).

    Cost: Σ max(0, size − distance) over the zones, distance from the robot's position to the centre.
    """

    name = "hazards"
    color = (0.1, 0.3, 0.95)
    trespassable = True
    movable = "no"

    num: int = param(8, "number of zones", low=0)
    size: float = param(0.3, "radius of a zone, m", above=0)
    keepout: float = param(0.4, "radius kept clear around a zone, m", low=0)
    weight: float = param(1.0, "cost per metre of depth", low=0)
    indicator: bool = param(False, "cost 1 inside any zone instead of the depth")
    locations: tuple[tuple[float, float], ...] = param((), "fixed centres (x, y), m")
    placements: tuple[Rectangle, ...] = param((), "rectangles to draw from, m; empty: the arena")
    space: str | None = param(
        None, "planar or spatial; null: the robot's workspace", choices=(None, "planar", "spatial")
    )
    height: tuple[float, float] = param((0.5, 1.5), "range of z in space, m")

    def footprints(self) -> tuple[Footprint, ...]:
        height = 0.0 if self.planar else self.height
        return (
            Footprint(
                self.name, self.num, self.keepout, self.placements, self.locations, height=height
            ),
        )

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self.centers = sim.places(self.name)  # [N, num, 3]

    def cost(self) -> Array:
        depth = self.size - self.sim.robot.clearance(self.centers, self.planar)
        return penetration(depth, self.weight, self.indicator)

    def observe(self) -> dict[str, Array]:
        return {f"{self.name}_lidar": self.sim.lidar(self.centers, self.planar)}

    def channels(self) -> dict[str, Channel]:
        return {f"{self.name}_lidar": self.sim.lidar_channel(self.planar)}

    def draw(self, painter: Painter, row: int) -> None:
        for center in self.centers[row]:
            painter.zone(center, self.size, 0.01 if self.planar else 0.0, self.color)
        lidar = self.sim.lidar(self.centers, self.planar)[row]
        painter.halo(lidar, self.sim.lidar_azimuth(self.planar), self.color)

"""Hazards: zones that do not move and cost the robot its depth inside them."""

from __future__ import annotations

from dataclasses import dataclass

from sb3_guard.envs.constraints.obstacles import Obstacles
from sb3_guard.envs.objects import Spatial
from sb3_guard.envs.part import Simulation


@dataclass
class Hazards(Spatial, Obstacles):
    """Zones to keep out of: discs on the floor, or spheres in the air (Zhao et al. 2024, §4.3).

    Cost: Σ max(0, size − distance) over the zones, the distance from the robot's position, or from
    the nearest link of an arm, to the zone's centre, for discs in the plane.
    """

    name = "hazards"
    color = (0.1, 0.3, 0.95)
    trespassable = True
    movable = "no"
    reachable = True

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self.check_height(sim, self.size, all_of_it=False)
        if self.num:
            self.check_size(sim, self.group, self.size)

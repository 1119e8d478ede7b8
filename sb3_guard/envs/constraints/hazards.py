"""Hazards: zones that do not move and cost the robot its depth inside them."""

from dataclasses import dataclass

from sb3_guard.envs.constraints.obstacles import Obstacles
from sb3_guard.envs.groups import check_reachable
from sb3_guard.envs.part import HEIGHT, SPACE, Simulation


@dataclass
class Hazards(Obstacles):
    """Zones to keep out of: discs on the floor, or spheres in the air (Zhao et al. 2024, §4.3).

    Cost: ``weight`` · Σ max(0, size − distance), m, over the zones, where the distance is from the
    centre to the robot's position, or to the nearest link of an arm (in the plane for discs).
    """

    name = "hazards"
    color = (0.0, 0.4, 0.85)
    trespassable = True
    movable = "no"
    reachable = True

    space: str | None = SPACE
    height: tuple[float, float] = HEIGHT

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        check_reachable(self, everywhere=False)

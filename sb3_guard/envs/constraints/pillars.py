"""Pillars: columns that stand in the way."""

from dataclasses import dataclass

import mujoco

from sb3_guard.envs.constraints.obstacles import Obstacles
from sb3_guard.envs.groups import CYLINDER, add_geom
from sb3_guard.envs.parameters import param


@dataclass
class Pillars(Obstacles):
    """Columns that do not move (Ray et al. 2019). Cost: the number touched."""

    name = "pillars"
    color = (0.45, 0.45, 0.5)
    trespassable = False
    movable = "no"
    spaces = ("planar",)
    solid = True
    usual_keepout = 0.3

    size: float = param(0.2, "radius of a pillar, m", above=0)
    keepout: float | None = param(
        None, "radius kept clear around a pillar, m; null: 0.3, or what covers it", low=0
    )
    half_height: float = param(0.5, "half of a pillar's height, m", above=0)

    def shape(self, body: mujoco.MjsBody) -> None:
        size = (self.size, self.half_height)
        add_geom(body, CYLINDER, size, self.color, lift=self.half_height)

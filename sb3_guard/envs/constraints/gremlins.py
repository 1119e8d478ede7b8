"""Gremlins: boxes that go round in circles whatever the robot does."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from sb3_guard.envs.constraints.obstacles import Obstacles
from sb3_guard.envs.groups import BOX, add_geom
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation
from sb3_guard.envs.placed import MOST
from sb3_guard.envs.types import Array, Generators


@dataclass
class Gremlins(Obstacles):
    """Boxes that move on circles around their places (Ray et al. 2019).

    At time t a gremlin is at travel · (sin ωt, cos ωt) from its place. Cost: the number touched.
    """

    name = "gremlins"
    color = (0.55, 0.1, 0.9)
    trespassable = False
    movable = "active"
    spaces = ("planar",)
    solid = True
    moves = True
    usual_keepout = 0.5

    num: int = param(8, "number of objects", low=0, high=MOST)
    size: float = param(0.1, "half of an edge, m", above=0)
    keepout: float | None = param(
        None,
        "radius kept clear around the middle of a circle, m; null: 0.5, or what covers all of it",
        low=0,
    )
    travel: float = param(0.3, "radius of the circles, m", low=0)
    every: str = param(
        "control",
        "whether they move before every control step or before every physics step",
        choices=("control", "physics"),
    )
    welded: bool = param(
        False, "whether they are light boxes pulled along by welds; false: nothing stops them"
    )
    density: float = param(0.001, "of welded ones, kg/m³", above=0)
    rate: float = param(1.0, "angular speed ω, rad per simulated second", low=0)

    @property
    def cover(self) -> float:
        return self.travel + math.sqrt(2) * self.size

    @property
    def begins(self) -> float:
        return 0.0  # pulled up at once

    def shape(self, body: mujoco.MjsBody) -> None:
        size = (self.size,) * 3
        if not self.welded:
            add_geom(body, BOX, size, self.color, lift=self.size)
            return
        add_geom(body, BOX, size, self.color, free=True).density = self.density

    def positions(self, footprint: str) -> Array:
        """The middles of the circles, [N, num, 3] m, which ``keepout`` is about."""
        return self.sim.places(footprint)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._time = sim.batch.bind("time")  # [N] s since the episode began

    def reset(self, ids: Array, rngs: Generators) -> None:
        super().reset(ids, rngs)
        self._turn(ids)

    def before_step(self) -> None:
        self._turn(slice(None))

    def _turn(self, rows: Array | slice) -> None:
        """Go where the clock of these rows says."""
        phase = self.rate * self._time[rows]
        places = self.group.places[rows].copy()  # [n, num, 3]
        places[..., 0] += (self.travel * np.sin(phase))[:, None]
        places[..., 1] += (self.travel * np.cos(phase))[:, None]
        self.group.move(places, rows)

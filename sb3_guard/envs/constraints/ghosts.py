"""Ghosts: zones that come after the robot, or bodies that bump into it."""

from dataclasses import dataclass

from sb3_guard.envs import motion
from sb3_guard.envs.constraints.obstacles import Obstacles
from sb3_guard.envs.groups import check_reachable
from sb3_guard.envs.layout import AWAY
from sb3_guard.envs.movers import Movers
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation


@dataclass
class Ghosts(Movers, Obstacles):
    """Zones that follow the robot until they are within r1 of it (Zhao et al. 2024, §4.3).

    Farther than r0 from the origin, a ghost returns to it at v0; otherwise it approaches the robot
    at v1 until it is within r1, and waits there. Cost: ``weight`` · Σ max(0, size − distance), m,
    over the ghosts, where the distance is from the centre to the robot's position, or to the
    nearest link of an arm (in the plane for those on the floor). Of solid ones: the number touched.
    """

    name = "ghosts"
    color = (1.0, 0.1, 0.5)
    trespassable = True
    movable = "active"
    usual_keepout = 0.5
    moves = True

    keepout: float | None = param(
        None, "radius kept clear around an object, m; null: 0.5, or what covers a solid one", low=0
    )
    v1: float | None = param(None, "speed towards the robot; null: speed", low=0)
    r1: float = param(1.5, "distance to the robot at which they wait, m", low=0)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        if not self.solid:
            check_reachable(self, everywhere=False)

    def before_step(self) -> None:
        if "num" in self.ranges:  # their law has led home who is away
            self.group.places[self.absent] = AWAY
        super().before_step()

    def law(self) -> motion.Law:
        return self._law(far=self.speed if self.v1 is None else self.v1, r1=self.r1)

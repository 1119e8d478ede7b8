"""Circle: run around the origin."""

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.observation import Observations, Scan
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Painter, Simulation, Task
from sb3_guard.envs.types import Array


@dataclass
class Circle(Task):
    """Run counter-clockwise on a circle around the origin (Achiam et al. 2017).

    Reward: ``reward_speed`` · v / (1 + \\|r − radius\\|), with the speed v around the origin and
    the distance r from it.
    """

    name = "circle"
    family = "safety_gymnasium"
    interactive = False
    contact = False
    targets = "one"
    spaces = ("planar",)
    color = (0.2, 0.7, 0.3)

    reward_limit: float | None = param(
        10.0, "rewards are cut off at ± this; null: they are not", above=0
    )
    radius: float = param(1.5, "of the circle, m", above=0)
    reward_speed: float = param(0.1, "reward per m/s on the circle")

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._origin = np.zeros((sim.num_envs, 1, 3))

    def reward(self, before: Array, now: Array) -> Array:
        (x, y, _), (u, v, _) = self.sim.robot.position.T, self.sim.robot.velocity.T
        r = geometry.length(np.stack([x, y]))
        around = (v * x - u * y) / np.maximum(r, 1e-12)
        return self.reward_speed * around / (1.0 + np.abs(r - self.radius))

    def observations(self) -> Observations:
        return {"circle_lidar": Scan(self._origin, True)}

    def draw(self, painter: Painter, row: int) -> None:
        painter.zone(self._origin[row, 0], self.radius, 0.01, self.color)

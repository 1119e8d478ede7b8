"""Defense: keep targets out of a protected area."""

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs import geometry, motion
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Painter, Simulation
from sb3_guard.envs.tasks.targets import Targets
from sb3_guard.envs.types import Array

SLATE = (0.30, 0.35, 0.45)


@dataclass
class Defense(Targets):
    """Drive targets out of a circle around the origin (Zhao et al. 2024, §4.2).

    Farther than r0 from the origin, a target returns to it at v0; otherwise it flees at v1 from a
    robot within r1, or approaches the origin at v2. Reward, summed over the targets:
    ‖xy − origin‖ ÷ ``radius`` − 1 inside the circle, ``reward_outside`` outside.
    """

    name = "defense"

    r1: float | None = param(
        None, "distance to the robot within which they flee, m; null: 2, in space 2.5", low=0
    )
    v2: float | None = param(None, "speed towards the origin; null: speed", low=0)
    radius: float = param(1.5, "radius of the protected circle, m", above=0)
    reward_outside: float = param(0.1, "reward for each target outside the circle")

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._home = np.array([[self.origin]])  # [1, 1, 3] m

    def law(self) -> motion.Law:
        r1 = self.r1 if self.r1 is not None else 2.0 if self.planar else 2.5
        v2 = self.speed if self.v2 is None else self.v2
        return self._law(near=-self.flight, settle=v2, r1=r1)

    def measure(self) -> Array:
        """Distances of the targets from the origin in the plane, [N, num] m."""
        return geometry.distance(self.group.centers, self._home, planar=True)

    def reward(self, before: Array, now: Array) -> Array:
        depth = now / self.radius - 1
        return np.where(depth < 0, depth, self.reward_outside).sum(axis=1)

    def draw(self, painter: Painter, row: int) -> None:
        super().draw(painter, row)
        painter.zone(np.array([*self.origin[:2], 0.0]), self.radius, 0.005, SLATE)

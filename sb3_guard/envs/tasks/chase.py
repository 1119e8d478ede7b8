"""Chase: come close to targets that run away."""

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs import motion
from sb3_guard.envs.parameters import param
from sb3_guard.envs.tasks.targets import Targets
from sb3_guard.envs.types import Array


@dataclass
class Chase(Targets):
    """Get close to the nearest of several fleeing targets (Zhao et al. 2024, §4.2).

    Farther than r0 from the origin, a target returns to it at v0; otherwise it flees at v1 from a
    robot within r1, or waits. Reward: the distance gained on the nearest target (of an arm, from
    its nearest link), times ``reward_distance``; none in the first step of an episode.
    """

    name = "chase"

    r1: float = param(3.0, "distance to the robot within which they flee, m", low=0)
    reward_distance: float = param(1.0, "reward per metre gained")

    def law(self) -> motion.Law:
        return self._law(near=-self.flight, r1=self.r1)

    def measure(self) -> Array:
        """Distance from the robot to the nearest target, [N, 1] m."""
        distances = self.sim.robot.clearance(self.group.centers, self.planar)
        return distances.min(axis=1, keepdims=True)

    def reward(self, before: Array, now: Array) -> Array:
        gain = before[:, 0] - now[:, 0]
        return np.where(self.sim.steps > 1, self.reward_distance * gain, 0.0)

"""Goal: reach a place; the next one appears as soon as it is reached."""

from __future__ import annotations

from dataclasses import dataclass

from sb3_guard.envs import geometry
from sb3_guard.envs.objects import Spatial
from sb3_guard.envs.part import Array, Simulation
from sb3_guard.envs.tasks.destination import Destination


@dataclass
class Goal(Spatial, Destination):
    """Reach a place (Zhao et al. 2024, §4.2).

    Reward: the distance gained in a control step, times ``reward_distance``, plus ``bonus`` when
    the robot's position is within ``size`` of the goal.
    """

    name = "goal"
    interactive = False
    contact = False

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self.check_height(sim, self.size, all_of_it=True)
        self.check_size(sim, "goal", self.size)

    def measure(self) -> Array:
        """Distance from the robot to the goal, [N, 1] m."""
        return geometry.distance(self.sim.robot.position, self.place, self.planar)[:, None]

    def reward(self, before: Array, now: Array) -> Array:
        return self.reward_distance * (before[:, 0] - now[:, 0])

    def succeeded(self, now: Array) -> Array:
        return now[:, 0] <= self.size

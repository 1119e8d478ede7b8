"""Goal: reach a place; the next one appears as soon as it is reached."""

from dataclasses import dataclass

from sb3_guard.envs import geometry
from sb3_guard.envs.groups import check_reachable
from sb3_guard.envs.part import HEIGHT, SPACE, Simulation
from sb3_guard.envs.tasks.destination import Destination
from sb3_guard.envs.types import Array


@dataclass
class Goal(Destination):
    """Reach a place (Zhao et al. 2024, §4.2).

    Reward: the distance gained in a control step, times ``reward_distance``, plus ``bonus`` when
    the robot's position is within ``size`` of the goal.
    """

    name = "goal"
    interactive = False
    contact = False

    space: str | None = SPACE
    height: tuple[float, float] = HEIGHT

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        check_reachable(self, everywhere=True)

    def measure(self) -> Array:
        """Distance from the robot to the goal, [N, 1] m."""
        return geometry.distance(self.sim.robot.position, self.place, self.planar)[:, None]

    def reward(self, before: Array, now: Array) -> Array:
        return self.reward_distance * (before[:, 0] - now[:, 0])

    def succeeded(self, now: Array) -> Array:
        return now[:, 0] <= self.sizes

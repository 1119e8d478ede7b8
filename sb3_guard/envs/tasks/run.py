"""Run: get on towards a place that is far away."""

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation, Task
from sb3_guard.envs.types import Array


@dataclass
class Run(Task):
    """Run towards a place (Ji et al. 2023).

    Reward: the distance gained, times ``reward_distance``.
    """

    name = "run"
    family = "safety_gymnasium"
    interactive = False
    contact = False
    targets = "one"
    spaces = ("planar",)
    camera = "track"

    target: tuple[float, float] = param((0.0, -1000.0), "where to, (x, y) m")
    reward_distance: float = param(60.0, "reward per metre gained")

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._target = np.array([*self.target, 0.0])

    def measure(self) -> Array:
        """Distance from the robot to the target, [N, 1] m."""
        return geometry.distance(self.sim.robot.position, self._target, planar=True)[:, None]

    def reward(self, before: Array, now: Array) -> Array:
        return self.reward_distance * (before[:, 0] - now[:, 0])

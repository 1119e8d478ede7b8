"""Forward: run along the x axis, with little effort."""

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation, Task
from sb3_guard.envs.types import Array


@dataclass
class Forward(Task):
    """Reward: speed along x, and a bonus for each step, less the squared controls.

    The speed is the distance that the robot's position moved in the control step, divided by its
    duration (Brockman et al. 2016; v4 of Gymnasium's MuJoCo environments).
    """

    name = "forward"
    family = "velocity"
    interactive = False
    contact = False
    targets = "one"
    color = (0.2, 0.7, 0.3)
    camera = "track"

    speed: float = param(1.0, "reward per m/s along x")
    survival: float = param(0.0, "reward of a step")
    control: float = param(0.0, "weight of the squared controls, summed", low=0)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._ctrl = sim.batch.bind("ctrl")

    def measure(self) -> Array:
        """Where the robot is along x, [N, 1] m."""
        return self.sim.robot.position[:, :1]

    def reward(self, before: Array, now: Array) -> Array:
        speed = (now - before)[:, 0] / self.sim.control_step
        return self.speed * speed + self.survival - self.control * np.square(self._ctrl).sum(axis=1)

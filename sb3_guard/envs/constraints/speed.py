"""Speed: a limit to how fast the robot may move."""

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Constraint, Simulation
from sb3_guard.envs.types import Array, Generators


@dataclass
class Speed(Constraint):
    """Cost 1 in each step in which the robot is faster than ``limit`` m/s (Zhang et al. 2020).

    The speed is the distance covered in the control step, divided by its duration.
    """

    name = "speed"
    family = "velocity"
    trespassable = True
    movable = "no"
    color = (0.9, 0.2, 0.1)
    most_cost = 1.0

    limit: float = param(1.0, "highest speed that is free, m/s", low=0)
    axes: str = param(
        "xy", "x: forwards along the x axis only; xy: in the plane", choices=("x", "xy")
    )

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._before = sim.array(f"{self.name}/before", (2,))

    def reset(self, ids: Array, rngs: Generators) -> None:
        self._before[ids] = 0.0

    def before_step(self) -> None:
        self._before[:] = self.sim.robot.position[:, :2]

    def _speed(self) -> Array:
        """Of the last control step, 0 before the first, [N] m/s."""
        velocity = (self.sim.robot.position[:, :2] - self._before) / self.sim.control_step
        speed = velocity[:, 0]
        if self.axes == "xy":
            speed = np.sqrt(velocity[:, 0] ** 2 + velocity[:, 1] ** 2)
        return np.where(self.sim.steps > 0, speed, 0.0)

    def cost(self) -> Array:
        return (self._speed() > self.limit).astype(float)

    def words(self, row: int) -> dict[str, str]:
        return {"speed": f"{self._speed()[row]:z.2f} m/s, limit {self.limit:.2f}"}

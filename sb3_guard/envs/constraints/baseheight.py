"""BaseHeight: the robot's position stays between two heights."""

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Constraint, Simulation
from sb3_guard.envs.types import Array


@dataclass
class BaseHeight(Constraint):
    """The robot neither falls nor jumps.

    Cost ``weight`` in each step at whose end its position is below ``low`` or above ``high``.
    """

    name = "baseheight"
    family = "robot"
    trespassable = True
    movable = "no"
    remedy = "move its low and high apart, or let the robot begin in another pose"

    low: float | None = param(
        None, "least height that is free, m; null: half of the height at the start"
    )
    high: float | None = param(None, "greatest height that is free, m; null: any")
    weight: float = param(1.0, "cost of a step beyond them", low=0)
    ends: bool = param(False, "whether the episode ends beyond them")

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._low = 0.5 * sim.robot.altitude if self.low is None else self.low
        self._high = np.inf if self.high is None else self.high
        if self._low >= self._high:
            raise ValueError(
                f"{self.name}.low = {self._low:g} must be less than high = {self._high:g}, m"
            )

    def _beyond(self) -> Array:
        height = self.sim.robot.position[:, 2]
        beyond: Array = (height < self._low) | (height > self._high)
        return beyond

    def cost(self) -> Array:
        return self.weight * self._beyond()

    def terminated(self) -> Array:
        return self._beyond() if self.ends else super().terminated()

    def words(self, row: int) -> dict[str, str]:
        height = self.sim.robot.position[row, 2]
        return {"height": f"{height:.2f} m, free from {self._low:.2f} to {self._high:.2f}"}

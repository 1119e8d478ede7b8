"""What constraints of many like objects have in common: a price for entering or touching them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs.objects import Objects
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Array, Constraint


@dataclass
class Obstacles(Objects, Constraint):
    """Objects that the robot pays for.

    Cost of those it can cross: Σ max(0, size − distance), the distance from the robot's position,
    an arm's from its nearest link, to the centre. Cost of solid ones: how many it touches when the
    control step ends, each counted once however many contact points it has.
    """

    weight: float = param(1.0, "cost per metre of depth, or per object touched", low=0)
    indicator: bool = param(False, "cost 1 whenever there is any, instead of the sum")

    def amounts(self) -> Array:
        """What each object costs, [N, num]."""
        if self.solid:
            return self.weight * self.bodies.touched
        depth = self.size - self.sim.robot.clearance(self.centers, self.planar)
        return self.weight * np.maximum(depth, 0.0)

    def cost(self) -> Array:
        amounts = self.amounts()
        if self.indicator:
            return (amounts > 0).any(axis=1).astype(float)
        return amounts.sum(axis=1)

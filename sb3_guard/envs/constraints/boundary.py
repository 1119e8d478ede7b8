"""Boundary: lines that the robot can cross; being beyond them has a cost."""

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Constraint, Painter
from sb3_guard.envs.types import Array

ENDLESS = 50.0  # m, how far a line is drawn that has no end


@dataclass
class Boundary(Constraint):
    """Cost 1 while the robot is outside lines at ±``x`` or ±``y`` m (Ji et al. 2023).

    None means no boundary.
    """

    name = "boundary"
    family = "safety_gymnasium"
    trespassable = True
    movable = "no"
    spaces = ("planar",)
    color = (0.9, 0.7, 0.1)
    most_cost = 1.0

    x: float | None = param(1.125, "farthest from the y axis, m; null: anywhere", low=0)
    y: float | None = param(None, "farthest from the x axis, m; null: anywhere", low=0)

    def cost(self) -> Array:
        beyond = np.zeros(self.sim.num_envs, dtype=bool)
        for axis, limit in enumerate((self.x, self.y)):
            if limit is not None:
                beyond |= np.abs(self.sim.robot.position[:, axis]) > limit
        return beyond.astype(float)

    def draw(self, painter: Painter, row: int) -> None:
        position = self.sim.robot.position[row, :2]
        limits = np.array([np.nan if limit is None else limit for limit in (self.x, self.y)])
        # a line without an end is drawn around the robot, which never comes to where it stops
        low = np.where(np.isnan(limits), position - ENDLESS, -limits)
        high = np.where(np.isnan(limits), position + ENDLESS, limits)
        for axis in np.flatnonzero(~np.isnan(limits)):
            for side in (low, high):
                start, end = low.copy(), high.copy()
                start[axis] = end[axis] = side[axis]
                painter.wall(start, end, self.color)

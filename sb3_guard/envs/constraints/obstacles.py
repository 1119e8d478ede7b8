"""The base of constraints with several alike objects: a cost for entering or touching them."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sb3_guard.envs.layout import Footprint, first
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Constraint, Simulation
from sb3_guard.envs.placed import Placed
from sb3_guard.envs.types import Array


@dataclass
class Obstacles(Placed, Constraint):
    """Objects of one size that incur a cost.

    Cost of those that the robot can cross, discs on the floor or spheres in the air:
    Σ max(0, size − distance), where the distance is from the centre to the robot's position, or to
    the nearest link of an arm. Cost of solid ones, which have a :meth:`shape`: how many the robot
    touches when the control step ends, each counted once however many contact points it has.
    """

    bounds: ClassVar[dict[str, str]] = {**Constraint.bounds, "amounts": "most_cost"}

    weight: float = param(1.0, "cost per metre of depth, or per object touched", low=0)
    indicator: bool = param(False, "cost 1 if there is any, instead of the sum")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.solid and "size" in self.ranges:
            low, high = self.ranges["size"]
            raise ValueError(
                f"{self.name}.size = {{'low': {low:g}, 'high': {high:g}}} cannot be drawn of solid "
                "ones, which are bodies: give one number"
            )

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._nums = self.current("num")[:, None]
        # one number is faster than the same number for all rows
        self._sizes = self.current("size")[:, None] if "size" in self.ranges else self.size

    def present(self, footprint: Footprint, row: int) -> Footprint:
        is_mine = footprint.name == self.name
        return first(footprint, int(self._nums[row, 0])) if is_mine else footprint

    @property
    def absent(self) -> Array:
        """Which objects the episodes are without, [N, num] bool."""
        absent: Array = np.arange(self.num) >= self._nums
        return absent

    def amounts(self) -> Array:
        """What each object costs, [N, num]."""
        if self.solid:
            return self.weight * self.group.touched
        depth = self._sizes - self.sim.robot.clearance(self.group.centers, self.planar)
        return self.weight * np.maximum(depth, 0.0)

    def per_step(self) -> str:
        return "Cost 1 in a step with any." if self.indicator else super().per_step()

    def cost(self) -> Array:
        amounts = self.amounts()
        if self.indicator:
            return (amounts > 0).any(axis=1).astype(float)
        return amounts.sum(axis=1)

    @property
    def most_cost(self) -> float:  # type: ignore[override]
        """A point's mean distance from m ≥ 2 centres, 2k apart, is ≥ k: Σ depths ≤ m (size − k)."""
        most, thickness = float(self.num), self.sim.robot.thickness
        if not self.solid:
            most *= self.size + thickness
            if self.movable == "no" and thickness == 0 and len(self.locations) < 2:
                depths = self.num * (self.size - self.group.footprint.keepout)
                most = min(most, max(self.size, depths))
        return 1.0 if self.indicator else self.weight and self.weight * most

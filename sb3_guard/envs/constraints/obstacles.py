"""What constraints of many like objects have in common: a price for entering or touching them."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from sb3_guard.envs.groups import MOST, Group
from sb3_guard.envs.layout import Footprint, Rectangle, first
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Array, Constraint, Simulation, World


@dataclass
class Obstacles(Constraint):
    """Objects of one size that incur a cost.

    Cost of those that the robot can cross, discs on the floor or spheres in the air:
    Σ max(0, size − distance), where the distance is from the centre to the robot's position, or to
    the nearest link of an arm. Cost of solid ones, which have a :meth:`shape`: how many the robot
    touches when the control step ends, each counted once however many contact points it has.
    """

    num: int = param(8, "number of objects", low=0, high=MOST, drawn=True)
    size: float = param(0.3, "radius of an object, m", above=0, drawn=True)
    keepout: float | None = param(
        None, "radius kept clear around an object, m; null: 0.4, or what covers a solid one", low=0
    )
    locations: tuple[tuple[float, float], ...] = param((), "fixed places (x, y), m")
    placements: tuple[Rectangle, ...] = param((), "rectangles to draw from, m; empty: the arena")
    margin: float = param(0.0, "extra distance to every other object, m", low=0)
    weight: float = param(1.0, "cost per metre of depth, or per object touched", low=0)
    indicator: bool = param(False, "cost 1 if there is any, instead of the sum")

    usual_keepout: ClassVar[float] = 0.4  # m, of objects that it covers
    free: ClassVar[bool] = False  # whether solid objects can be pushed
    welded = False  # whether they can be pushed but are pulled back
    moves: ClassVar[bool] = False  # whether they leave their places by themselves
    reachable: ClassVar[bool] = False  # whether they lie within the robot's reach

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.solid and "size" in self.ranges:
            low, high = self.ranges["size"]
            raise ValueError(
                f"{self.name}.size = {{'low': {low:g}, 'high': {high:g}}} cannot be drawn of solid "
                "ones, which are bodies: give one number"
            )

    @property
    def cover(self) -> float:
        """Radius around its place that a solid object never leaves, m."""
        return self.size

    @property
    def begins(self) -> float | None:
        """How deep objects that can be pushed begin in the floor, m; None: as they rest."""
        return None

    def shape(self, body: mujoco.MjsBody) -> None:
        """Add the geoms of a solid object, whose frame is its place."""
        raise NotImplementedError(f"{self.name} cannot be solid")

    def build(self, world: World) -> None:
        super().build(world)
        self.group = Group(
            self,
            world,
            self.name,
            self.num,
            self.keepout,
            self.usual_keepout,
            self.cover,
            self.shape if self.solid else None,
            self.size if self.free or self.welded else None,
            self.welded,
            self.begins,
            reachable=self.reachable,
            grip="friction" if self.free else None,
            mover=self.moves,
        )
        self.groups = (self.group,)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._nums, self._sizes = self.current("num")[:, None], self.current("size")[:, None]

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
            return self.weight * self.group.bodies.touched
        depth = self._sizes - self.sim.robot.clearance(self.group.centers, self.planar)
        return self.weight * np.maximum(depth, 0.0)

    def cost(self) -> Array:
        amounts = self.amounts()
        if self.indicator:
            return (amounts > 0).any(axis=1).astype(float)
        return amounts.sum(axis=1)

"""What tasks with a place to reach have in common: the place, and a new one once it is reached."""

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.layout import Footprint, Rectangle
from sb3_guard.envs.observation import Compass, Observations, Scan, Values
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Painter, Simulation, Task, World
from sb3_guard.envs.types import Array

REDRAWS = 20  # new places drawn before one that is reached already is accepted


@dataclass
class Destination(Task):
    """A place that the robot, or what it pushes, has to reach."""

    size: float = param(
        0.5, "radius within which the goal counts as reached, m", above=0, drawn=True
    )
    keepout: float = param(0.4, "radius kept clear around the goal, m", low=0)
    reward_distance: float = param(1.0, "reward per metre gained")
    reward_limit: float | None = param(
        10.0, "dense rewards are cut off at ± this; null: they are not", above=0
    )
    bonus: float = param(1.0, "reward for reaching the goal")
    ends: bool = param(False, "whether reaching the goal ends the episode")
    locations: tuple[tuple[float, float], ...] = param(
        (), "fixed first goal, one (x, y), m; several: every goal is one of them, drawn again"
    )
    placements: tuple[Rectangle, ...] = param((), "rectangles to draw from, m; empty: the arena")
    margin: float = param(0.0, "extra distance to every other object, m", low=0)
    last: bool = param(False, "whether the goal is placed after everything else")
    lidar: bool = param(False, "whether the goal is also seen by a lidar")
    distance: bool = param(False, "whether the goal's closeness exp(−distance) is observed")

    color = (0.0, 0.65, 0.45)
    targets = "one"

    def footprints(self) -> tuple[Footprint, ...]:
        return (
            Footprint(
                "goal",
                1,
                self.keepout,
                self.placements,
                self.locations if len(self.locations) == 1 else (),
                self.margin,
                height=0.0 if self.planar else self.height,
                **self._within,
                redrawn=not self.ends,
                last=self.last,
                among=self.locations if len(self.locations) > 1 else (),
            ),
            *super().footprints(),
        )

    def build(self, world: World) -> None:
        super().build(world)
        self._within = world.robot.within(self.planar)
        if not self.planar:
            self._within["hand"] = world.robot.hand

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self.place = sim.places("goal")[:, 0]  # [N, 3] m
        self.sizes = self.current("size")  # [N] m

    def advance(self, ids: Array) -> Array:
        return np.array([i for i in ids.tolist() if not self._redraw(i)], dtype=int)

    def _redraw(self, row: int) -> bool:
        """Draw a new goal in one row, one still to be reached: the robot may stand above it."""
        for _ in range(REDRAWS):
            if not self.sim.redraw("goal", row):
                return False
            if not self.succeeded(self.measure())[row]:
                break
        return True

    def observations(self) -> Observations:
        out: dict[str, Scan | Compass | Values] = {"goal_compass": Compass(self.place, self.planar)}
        if self.lidar:
            out["goal_lidar"] = Scan(self.place[:, None], self.planar)
        if self.distance:
            gap = geometry.distance(self.sim.robot.position, self.place, self.planar)
            out["goal_distance"] = Values(np.exp(-gap)[:, None], 0.0, 1.0, "closeness")
        return out

    def draw(self, painter: Painter, row: int) -> None:
        lift = 0.25 if self.planar else 0.0
        painter.zone(self.place[row] + [0, 0, lift], self.sizes[row], lift, self.color)

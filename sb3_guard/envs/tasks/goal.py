"""Goal: reach a place; the next one appears as soon as it is reached."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.layout import Footprint, Rectangle
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Array, Painter, Simulation, Task
from sb3_guard.envs.sensors import Channel


@dataclass
class Goal(Task):
    """Reach a place (Zhao et al. 2024, §4.2).

    Reward: the distance gained in a control step, times ``reward_distance``, plus ``bonus`` when the
    robot's position is within ``size`` of the goal.
    """

    name = "goal"
    color = (0.1, 0.75, 0.2)
    interactive = False
    contact = False
    targets = "one"

    size: float = param(0.5, "radius within which the goal counts as reached, m", above=0)
    keepout: float = param(0.4, "radius kept clear around the goal, m", low=0)
    reward_distance: float = param(1.0, "reward per metre gained")
    bonus: float = param(1.0, "reward for reaching the goal")
    ends: bool = param(False, "whether reaching the goal ends the episode")
    locations: tuple[tuple[float, float], ...] = param((), "fixed first goal, one (x, y), m")
    placements: tuple[Rectangle, ...] = param((), "rectangles to draw from, m; empty: the arena")
    space: str | None = param(
        None, "planar or spatial; null: the robot's workspace", choices=(None, "planar", "spatial")
    )
    height: tuple[float, float] = param((0.5, 1.5), "range of z in space, m")

    def footprints(self) -> tuple[Footprint, ...]:
        height = 0.0 if self.planar else self.height
        return (Footprint("goal", 1, self.keepout, self.placements, self.locations, height=height),)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self.place = sim.places("goal")[:, 0]  # [N, 3]

    def measure(self) -> Array:
        """Distance from the robot to the goal, [N, 1] m."""
        return geometry.distance(self.sim.robot.position, self.place, self.planar)[:, None]

    def reward(self, before: Array, now: Array) -> Array:
        return self.reward_distance * (before[:, 0] - now[:, 0])

    def succeeded(self, now: Array) -> Array:
        return now[:, 0] <= self.size

    def advance(self, ids: Array) -> Array:
        return np.array([i for i in ids.tolist() if not self.sim.redraw("goal", i)], dtype=int)

    def observe(self) -> dict[str, Array]:
        return {"goal_compass": self.sim.compass(self.place)}

    def channels(self) -> dict[str, Channel]:
        return {"goal_compass": self.sim.compass_channel()}

    def draw(self, painter: Painter, row: int) -> None:
        lift = 0.25 if self.planar else 0.0
        painter.zone(self.place[row] + [0, 0, lift], self.size, lift, self.color)

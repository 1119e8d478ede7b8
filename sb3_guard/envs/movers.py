"""Objects that move by themselves: ghosts, and the targets of Chase and Defense."""

from dataclasses import dataclass

import mujoco
import numpy as np

from sb3_guard.envs import motion
from sb3_guard.envs.groups import CYLINDER, SPHERE, add_geom
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import HEIGHT, SPACE, Simulation
from sb3_guard.envs.placed import Placed
from sb3_guard.envs.types import Array, Generators


@dataclass
class Movers(Placed):
    """Objects that chase the robot or flee from it (Zhao et al. 2024, §4).

    Speeds are metres per control step under ``speed_law="unit"`` and, with the paper's equations,
    ``"proportional"``, fractions of the distance per control step. A subclass states its
    :meth:`law` of motion. Their z stays within ``height``.
    """

    space: str | None = SPACE
    height: tuple[float, float] = HEIGHT
    solid: bool = param(False, "whether they are bodies that push; false: the robot passes through")
    speed: float = param(
        1e-3, "m per control step; what the other speeds default to multiples of", low=0
    )
    speed_law: str = param(
        "unit",
        "speeds along unit vectors, or proportional: as shares of the distance per control step",
        choices=("unit", "proportional"),
    )
    v0: float | None = param(None, "speed home from beyond r0; null: speed", low=0)
    r0: float = param(2.5, "radius around the origin that they do not leave, m", low=0)
    origin: tuple[float, float, float] = param((0.0, 0.0, 0.0), "where home is, (x, y, z) m")

    @property
    def _gap(self) -> float | Array:
        """Twice their size, m; [N], live, if that is drawn."""
        drawn = "size" in self.ranges
        return self.sim.array(f"{self.name}/gap") if drawn else 2 * self.size

    def law(self) -> motion.Law:
        """How they move."""
        raise NotImplementedError

    def _law(self, **speeds: float) -> motion.Law:
        """A law of motion with what all movers have in common."""
        return motion.Law(
            home=self.speed if self.v0 is None else self.v0,
            apart=self.speed,
            gap=self._gap,
            r0=self.r0,
            origin=self.origin,
            unit=self.speed_law == "unit",
            **speeds,
        )

    def shape(self, body: mujoco.MjsBody) -> None:
        if self.planar:
            size = (self.size, self.size / 2)
            add_geom(body, CYLINDER, size, self.color, lift=self.size / 2)
        else:
            add_geom(body, SPHERE, (self.size,), self.color)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self.group.centers = self.group.places  # which move, and bodies after them
        self.motion = self.law()

    def reset(self, ids: Array, rngs: Generators) -> None:
        super().reset(ids, rngs)
        if "size" in self.ranges:
            self._gap[ids] = 2 * self.current("size")[ids]  # type: ignore[index]

    def moving(self) -> tuple[motion.Moving, ...]:
        return (motion.Moving(self.group.places, self.motion, self.planar),)

    def before_step(self) -> None:
        if not self.planar:
            z, (low, high) = self.group.places[..., 2], self.height
            np.minimum(np.maximum(z, low), high, out=z)
        if self.solid:
            self.group.move(self.group.places)

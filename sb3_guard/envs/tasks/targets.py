"""What tasks with targets that flee have in common."""

from __future__ import annotations

from dataclasses import dataclass

from sb3_guard.envs.objects import MOST, Movers
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Array, Task


@dataclass
class Targets(Movers, Task):
    """Targets that flee from the robot when it is within r1 of them."""

    color = (0.95, 0.85, 0.1)
    interactive = True
    contact = False
    targets = "many"
    spoils = "a solid target touches the robot at once"

    num: int = param(2, "number of targets", low=1, high=MOST)
    r0: float = param(2.0, "radius around the origin that they do not leave, m", low=0)
    v1: float | None = param(None, "speed away from the robot; null: 10 speed", low=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.contact = self.solid
        self.targets = "one" if self.num == 1 else "many"

    @property
    def group(self) -> str:
        return "targets"

    def blemished(self) -> Array:
        """Whether a solid target is touched: it hangs in the link of an arm, [N] bool."""
        return self.bodies.touched.sum(axis=1) > 0

    @property
    def flight(self) -> float:
        """Speed away from the robot."""
        return 10 * self.speed if self.v1 is None else self.v1

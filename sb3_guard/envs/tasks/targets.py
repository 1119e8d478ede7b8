"""What tasks with targets that flee have in common."""

from dataclasses import dataclass

from sb3_guard.envs.movers import Movers
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Task
from sb3_guard.envs.placed import MOST
from sb3_guard.envs.types import Array


@dataclass
class Targets(Movers, Task):
    """Targets that flee from the robot when it is within r1 of them."""

    color = (0.95, 0.85, 0.1)
    interactive = True
    contact = False
    targets = "many"
    objects = "targets"
    usual_keepout = 0.5
    moves = True
    invalid_reason = "a solid target touches the robot immediately"

    num: int = param(2, "number of targets", low=1, high=MOST)
    size: float = param(0.3, "radius of an object, m", above=0)
    keepout: float | None = param(
        None, "radius kept clear around an object, m; null: 0.5, or what covers a solid one", low=0
    )
    r0: float = param(2.0, "radius around the origin that they do not leave, m", low=0)
    v1: float | None = param(None, "speed away from the robot; null: 10 speed", low=0)
    reward_limit: float | None = param(
        10.0, "dense rewards are cut off at ± this; null: they are not", above=0
    )

    def invalid_start(self) -> Array:
        """Whether a solid target is touched: it hangs in the link of an arm, [N] bool."""
        return self.group.touched.sum(axis=1) > 0

    @property
    def flight(self) -> float:
        """Speed away from the robot."""
        return 10 * self.speed if self.v1 is None else self.v1

"""What limits of the robot itself have in common: a cost in each step beyond the limit."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Constraint, Robot, Simulation
from sb3_guard.envs.types import Array
from sb3_guard.spelling import matching


def prefix(robot: Robot) -> str:
    """What the names of a robot's elements begin with in the compiled world."""
    return robot.root[: robot.root.rfind("/") + 1]


@dataclass
class RobotLimit(Constraint):
    """Cost ``weight`` in each step at whose end something of the robot is above ``limit``."""

    family = "robot"
    trespassable = True
    movable = "no"
    color = (0.9, 0.2, 0.1)
    remedy = "raise its limit, or let the robot begin in another pose"
    unit: ClassVar[str]

    limit: float
    weight: float = param(1.0, "cost of a step beyond the limit", low=0)
    ends: bool = param(False, "whether the episode ends beyond the limit")

    def amount(self) -> Array:
        """What is limited, [N]."""
        raise NotImplementedError

    def beyond(self) -> Array:
        """Whether it is above the limit, [N] bool."""
        return self.amount() > self.limit

    def cost(self) -> Array:
        return self.weight * self.beyond()

    def terminated(self) -> Array:
        return self.beyond() if self.ends else super().terminated()

    def words(self, row: int) -> dict[str, str]:
        amount = f"{self.amount()[row]:.2f} {self.unit}".rstrip()
        return {self.name: f"{amount}, limit {self.limit:g}"}


@dataclass
class JointLimit(RobotLimit):
    """Cost ``weight`` in each step at whose end a joint is beyond ``limit``."""

    joints: tuple[str, ...] = param(
        (),
        "names or patterns of the hinges and slides that count, such as *_knee; empty: all hinges "
        "but those of the outermost body",
    )
    ranged: ClassVar[bool] = False  # whether only joints with a range count

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        model, start = sim.model, prefix(sim.robot)
        bodies = sim.robot.bodies(model)
        single = [j for j in range(model.njnt) if model.jnt_bodyid[j] in bodies
                  and model.jnt_type[j] >= 2]  # fmt: skip  # slides 2, hinges 3
        if self.ranged:
            single = [joint for joint in single if model.jnt_limited[joint]]
        names = {model.joint(j).name.removeprefix(start): j for j in single}
        self._ids = self._chosen(sim, names)
        self._dofs = model.jnt_dofadr[self._ids].tolist()

    def _chosen(self, sim: Simulation, names: dict[str, int]) -> list[int]:
        """The joints that count.

        :raises ValueError: there are none
        """
        model, root = sim.model, sim.model.body(sim.robot.root).id
        if self.joints:
            label = f"{self.name}.joints"
            chosen: Sequence[int] = [
                names[name] for pattern in self.joints for name in matching(label, pattern, names)
            ]
        else:
            chosen = [j for j in names.values() if model.jnt_bodyid[j] != root]
            chosen = [j for j in chosen if model.jnt_type[j] == 3]
        if not chosen:
            ranged = " with a range" if self.ranged else ""
            of_base = f": {', '.join(names)}" if names else " either"
            raise ValueError(
                f"{self.name}: the robot has no hinges{ranged} except those of its outermost body"
                f"; joints may name others{of_base}"
            )
        return sorted(set(chosen))

    def amounts(self) -> Array:
        """What is limited of each joint, [N, J]."""
        raise NotImplementedError

    def amount(self) -> Array:
        most: Array = np.abs(self.amounts()).max(axis=1)
        return most

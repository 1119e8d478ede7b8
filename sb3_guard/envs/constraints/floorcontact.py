"""FloorContact: bodies of the robot do not lean on the floor."""

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs.constraints.limits import RobotLimit, prefix
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation, World
from sb3_guard.envs.types import Array
from sb3_guard.spelling import matching


@dataclass
class FloorContact(RobotLimit):
    """The robot does not lie on the floor.

    Cost ``weight`` in each step at whose end the floor pushes one of ``bodies`` with more than
    ``limit``.
    """

    name = "floorcontact"
    unit = "N"

    limit: float = param(1.0, "greatest force that is free, N", low=0)
    bodies: tuple[str, ...] = param(
        (), "names or patterns of the bodies that count, such as *_thigh; empty: the outermost"
    )

    def build(self, world: World) -> None:
        super().build(world)
        robot, start = world.robot, prefix(world.robot)
        root = world.spec.body(robot.root)
        names = [body.name for body in (root, *root.find_all("body"))]
        names = [name.removeprefix(start) for name in names if name]
        chosen = [
            name
            for pattern in self.bodies or (robot.root.removeprefix(start),)
            for name in matching(f"{self.name}.bodies", pattern, names)
        ]
        self._felt = list(dict.fromkeys(chosen))
        for name in self._felt:
            world.feel(f"{self.name}/{name}", "world", force=True, by=start + name)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._forces = [sim.sensor(f"{self.name}/{name}") for name in self._felt]  # [N, 3] N each

    def amount(self) -> Array:
        """The greatest net force of the floor on a body, [N] N."""
        squares = np.array([(force**2).sum(axis=1) for force in self._forces])
        most: Array = np.sqrt(squares).max(axis=0)
        return most

"""SelfCollision: the robot's bodies do not hit each other."""

from dataclasses import dataclass

import mujoco
import numpy as np

from sb3_guard.envs.constraints.limits import RobotLimit
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation, World
from sb3_guard.envs.types import Array


@dataclass
class SelfCollision(RobotLimit):
    """The robot does not hit itself.

    Cost ``weight`` in each step at whose end two of its bodies press on each other with more than
    ``limit``.
    """

    name = "selfcollision"
    unit = "N"

    limit: float = param(1.0, "greatest force that is free, N", low=0)

    def build(self, world: World) -> None:
        super().build(world)
        of_largest_force, slots = 2, 1
        world.spec.add_sensor(
            name=f"{self.name}/force",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_XBODY,  # in contact sensors: the body's whole subtree
            objname=world.robot.root,
            reftype=mujoco.mjtObj.mjOBJ_XBODY,
            refname=world.robot.root,
            intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), of_largest_force, slots],
        )

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._force = sim.sensor(f"{self.name}/force")  # [N, 3] N, in the frame of the contact

    def amount(self) -> Array:
        """The greatest force of a contact between two of its bodies, [N] N."""
        strength: Array = np.sqrt((self._force**2).sum(axis=1))
        return strength

"""JointTorque: a limit to what actuators exert on joints."""

from dataclasses import dataclass

from sb3_guard.envs.constraints.limits import JointLimit
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation
from sb3_guard.envs.types import Array


@dataclass
class JointTorque(JointLimit):
    """Actuators are not strained.

    Cost ``weight`` in each step at whose end actuators exert more than ``limit`` on a joint.
    """

    name = "jointtorque"
    unit = "N m"

    limit: float = param(10.0, "highest torque that is free, N m; of slides N", low=0)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._torque = sim.batch.bind("qfrc_actuator")

    def amounts(self) -> Array:
        """Torques of all actuators together, [N, J] N m or N."""
        return self._torque[:, self._dofs]

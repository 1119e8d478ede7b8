"""JointSpeed: a limit to how fast joints turn."""

from dataclasses import dataclass

from sb3_guard.envs.constraints.limits import JointLimit
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation
from sb3_guard.envs.types import Array


@dataclass
class JointSpeed(JointLimit):
    """Joints turn slowly.

    Cost ``weight`` in each step at whose end a joint is faster than ``limit``.
    """

    name = "jointspeed"
    unit = "rad/s"

    limit: float = param(3.0, "highest speed that is free, rad/s; of slides m/s", low=0)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._qvel = sim.batch.bind("qvel")

    def amounts(self) -> Array:
        """Velocities, [N, J] rad/s or m/s."""
        return self._qvel[:, self._dofs]

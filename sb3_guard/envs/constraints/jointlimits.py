"""JointLimits: joints keep away from the ends of their ranges."""

from dataclasses import dataclass

from sb3_guard.envs.constraints.limits import JointLimit
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation
from sb3_guard.envs.types import Array


@dataclass
class JointLimits(JointLimit):
    """Joints keep away from the ends of their ranges.

    Cost ``weight`` in each step at whose end a joint is farther from the middle of its range than
    ``limit`` times half the range.
    """

    name = "jointlimits"
    unit = "of the range"
    ranged = True

    limit: float = param(0.9, "share of the range that is free", above=0, high=1)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        low, high = sim.model.jnt_range[self._ids].T
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self._places = sim.model.jnt_qposadr[self._ids].tolist()
        self._qpos = sim.batch.bind("qpos")

    def amounts(self) -> Array:
        """Distance from the middle of the range, as a share of half of it, [N, J]."""
        return (self._qpos[:, self._places] - self._middle) / self._half

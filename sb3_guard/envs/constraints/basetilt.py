"""BaseTilt: the robot's outermost body stays upright."""

from dataclasses import dataclass

import mujoco
import numpy as np

from sb3_guard.envs.constraints.limits import RobotLimit
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation
from sb3_guard.envs.types import Array


@dataclass
class BaseTilt(RobotLimit):
    """The outermost body stays upright.

    Cost ``weight`` in each step at whose end it leans by more than ``limit`` from how it stands in
    the file.
    """

    name = "basetilt"
    unit = "rad"

    limit: float = param(0.5, "greatest tilt that is free, rad", low=0)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        root = sim.model.body(sim.robot.root).id
        upright = mujoco.MjData(sim.model)
        mujoco.mj_kinematics(sim.model, upright)
        self._up = upright.xmat[root].reshape(3, 3)[2].copy()  # the vertical, in the body's frame
        self._vertical = sim.batch.bind("xmat")[:, root, 6:9]  # the same now, [N, 3]

    def amount(self) -> Array:
        """Angle between the vertical and what it was in the body's frame, [N] rad."""
        cosine = (self._vertical * self._up).sum(axis=1)
        angle: Array = np.arccos(np.minimum(np.maximum(cosine, -1.0), 1.0))
        return angle

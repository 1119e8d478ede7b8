"""Buttons: what must not be pressed."""

from dataclasses import dataclass

import mujoco
import numpy as np

from sb3_guard.envs.constraints.obstacles import Obstacles
from sb3_guard.envs.groups import SPHERE, add_geom
from sb3_guard.envs.parameters import param
from sb3_guard.envs.types import Array


@dataclass
class Buttons(Obstacles):
    """Buttons that are all wrong to press (Ray et al. 2019).

    Cost: the number touched, including the wrong buttons of the task Button. With that task,
    ``num=0`` leaves only these.
    """

    name = "buttons"
    color = (1.0, 0.5, 0.1)
    trespassable = False
    movable = "no"
    spaces = ("planar",)
    solid = True
    usual_keepout = 0.3

    size: float = param(0.1, "radius of a button, m", above=0)
    keepout: float | None = param(
        None, "radius kept clear around a button, m; null: 0.3, or what covers it", low=0
    )

    def shape(self, body: mujoco.MjsBody) -> None:
        add_geom(body, SPHERE, (self.size,), self.color, lift=self.size)

    def amounts(self) -> Array:
        own = super().amounts()
        return np.column_stack([own, self.weight * self.sim.task.mistakes()])

    @property
    def most_cost(self) -> float:  # type: ignore[override]
        others = self.weight and self.weight * self.sim.task.most_mistakes
        return super().most_cost + (0.0 if self.indicator else others)

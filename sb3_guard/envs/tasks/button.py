"""Button: press the one that is lit."""

from dataclasses import dataclass

import mujoco
import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.groups import SPHERE, add_geom
from sb3_guard.envs.layout import Footprint
from sb3_guard.envs.observation import Compass, Observations, Scan, Values
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Painter, Simulation, Task
from sb3_guard.envs.placed import MOST, Placed
from sb3_guard.envs.types import Array, Generators

GREEN = (0.1, 0.75, 0.2)


@dataclass
class Button(Placed, Task):
    """Press the right one of several buttons (Ray et al. 2019).

    Reward: the distance gained on the lit button, times ``reward_distance``, plus ``bonus`` when it
    is touched. Then another button becomes the right one. In the next ``delay`` control steps
    pressing a button has no effect, none is lit and the lidar shows none.
    """

    name = "button"
    color = (1.0, 0.5, 0.1)
    interactive = False
    contact = True
    targets = "one"
    spaces = ("planar",)
    solid = True
    usual_keepout = 0.3
    reachable = True
    most_mistakes = 0.0

    num: int = param(4, "number of buttons", low=1, high=MOST)
    size: float = param(0.1, "radius of a button, m", above=0)
    keepout: float | None = param(
        None, "radius kept clear around a button, m; null: 0.3, or what covers it", low=0
    )
    lidar: bool = param(False, "whether a lidar of its own sees the right button")
    marker: float | None = param(
        None, "radius kept clear for a marker that begins elsewhere, m; null: there is none", low=0
    )
    again: bool = param(False, "whether the button just pressed may be the next right one")
    locked: bool = param(
        True, "whether after a press the right button is without effect for a while too"
    )
    delay: int = param(10, "control steps after a press in which no button counts", low=0)
    reward_distance: float = param(1.0, "reward per metre gained")
    reward_limit: float | None = param(
        10.0, "dense rewards are cut off at ± this; null: they are not", above=0
    )
    bonus: float = param(1.0, "reward for pressing the lit button")
    ends: bool = param(False, "whether pressing the lit button ends the episode")

    def footprints(self) -> tuple[Footprint, ...]:
        marker = () if self.marker is None else (Footprint("goal", 1, self.marker),)
        return (*super().footprints(), *marker)

    def shape(self, body: mujoco.MjsBody) -> None:
        add_geom(body, SPHERE, (self.size,), self.color, lift=self.size)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._flat = sim.robot.workspace == "planar"
        self._rows = np.arange(sim.num_envs)
        self.most_mistakes = max(self.most_mistakes, self.num - 1.0)
        self.right = sim.array("button/right", dtype=np.int64)  # [N] which button is the right one
        # [N] how many steps ahead the first is that counts; 0 during one that does
        self.wait = sim.array("button/wait", dtype=np.int64)

    def reset(self, ids: Array, rngs: Generators) -> None:
        super().reset(ids, rngs)
        self.wait[ids] = 0
        for i in ids.tolist():
            self.right[i] = rngs[i].integers(self.num)

    def before_step(self) -> None:
        np.maximum(self.wait - 1, 0, out=self.wait)

    @property
    def goal(self) -> Array:
        """Where the right button is, [N, 3] m."""
        return self.group.places[self._rows, self.right]

    @property
    def lit(self) -> Array:
        """Whether a button is lit, that is, whether the next step counts, [N] bool."""
        return self.wait <= 1

    def measure(self) -> Array:
        """Distance from the robot to the right button, [N, 1] m."""
        return geometry.distance(self.sim.robot.position, self.goal, self._flat)[:, None]

    def reward(self, before: Array, now: Array) -> Array:
        return self.reward_distance * (before[:, 0] - now[:, 0])

    def succeeded(self, now: Array) -> Array:
        pressed: Array = self.group.touched[self._rows, self.right]
        return pressed & (self.wait == 0) if self.locked else pressed

    def advance(self, ids: Array) -> Array:
        for i in ids.tolist():
            if self.again:
                self.right[i] = self.sim.rngs[i].integers(self.num)
            elif self.num > 1:
                other = self.sim.rngs[i].integers(self.num - 1)
                self.right[i] = other + (other >= self.right[i])
            self.wait[i] = self.delay + 1
        return ids[:0]

    def mistakes(self) -> Array:
        touched = self.group.touched
        wrong = touched.sum(axis=1) - touched[self._rows, self.right]
        return np.where(self.wait == 0, wrong, 0).astype(float)

    def observations(self) -> Observations:
        out: dict[str, Scan | Compass | Values] = {
            f"{self.group.name}_lidar": self.group.scan(self.lit),
            "goal_compass": Compass(self.goal, self.planar),
        }
        if self.lidar:
            out["goal_lidar"] = Scan(self.goal[:, None], self.planar, GREEN)
        return out

    def draw(self, painter: Painter, row: int) -> None:
        super().draw(painter, row)
        if self.lit[row]:
            light = self.goal[row] + [0, 0, self.size]
            painter.zone(light, 2 * self.size, 0.0, GREEN)

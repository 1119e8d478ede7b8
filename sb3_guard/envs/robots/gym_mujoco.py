"""Gymnasium's own MuJoCo robots, as its v4 environments have them.

Their files come with the gymnasium package. Starts, observations and deaths are those of
``gymnasium.make("Ant-v4")`` and its sisters, bit for bit, with the same random numbers: a row with
seed s begins as that environment does. Derived quantities, such as the place of Ant's torso, are
read as ``mj_step`` leaves them there: of the last physics step's beginning.

Two things are as with the MuJoCo that the files were written for. It took the larger margin of two
geoms, and today's adds the two, so margins are half of those in the files. And it kept quaternions
at length 1, also where an episode begins.
"""

import importlib.resources
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np

from sb3_guard.envs.arena import furnish
from sb3_guard.envs.observation import Observations, Values
from sb3_guard.envs.part import Simulation
from sb3_guard.envs.robots import mjcf
from sb3_guard.envs.robots.robot import MJCFRobot
from sb3_guard.envs.types import Array, Generators


@dataclass
class GymRobot(MJCFRobot):
    """A robot in the world of its file, which starts where the file puts it, with some noise.

    Its place is not observed: it sees qpos without the first ``hidden`` numbers, then qvel.
    """

    family = "velocity"
    timestep = None  # as its file says
    stage = mujoco.mjtStage.mjSTAGE_NONE
    scaled = False
    complete = True
    root = "torso"
    center = "torso"
    lidar_bodies = ("torso",)
    eye = ("torso", (0.0, 0.0, 0.1), (1.0, 0.0, 0.0))

    keepout: float = 0.0
    hidden: ClassVar[int] = 1  # numbers of qpos
    noise: ClassVar[float] = 0.1  # of the start
    normal: ClassVar[bool] = False  # whether speeds at the start are drawn normally, not uniformly
    fastest: ClassVar[float] = np.inf  # observed speeds are clipped to this
    # ranges of qpos[first], qpos[first + 1], ... in which it lives
    first: ClassVar[int] = 1
    alive: ClassVar[tuple[tuple[float, float], ...]] = ()

    @classmethod
    def path(cls) -> Path:
        folder = importlib.resources.files("gymnasium.envs.mujoco") / "assets"
        return Path(str(folder / cls.asset))

    def world(self) -> mujoco.MjSpec:
        """The file's world, in which the margins of two geoms add up to the larger in the file.

        Floor, light and sky look like the arena's.
        """
        spec = mjcf.load(self.path())
        for geom in spec.geoms:  # within a file, all have the same margin
            geom.margin /= 2
        return furnish(spec)

    def reset(self, ids: Array, rngs: Generators) -> None:
        for i in ids.tolist():
            start = self._start["qpos"]
            self._qpos[i] = start + rngs[i].uniform(-self.noise, self.noise, len(start))
            n = self._qvel.shape[1]
            if self.normal:
                self._qvel[i] = self.noise * rngs[i].standard_normal(n)
            else:
                self._qvel[i] = rngs[i].uniform(-self.noise, self.noise, n)
            # MuJoCo 2.3.3 normalises quaternions in place whenever it computes positions
            mujoco.mj_normalizeQuat(self.sim.model, self._qpos[i])

    @property
    def position(self) -> Array:
        """Along the ground, [N, 3] m: what velocities are measured by."""
        point = np.zeros((len(self._qpos), 3))
        point[:, : self.hidden] = self._qpos[:, : self.hidden]
        return point

    def observations(self) -> Observations:
        speeds = np.minimum(np.maximum(self._qvel, -self.fastest), self.fastest)
        return {"qpos": Values(self._qpos[:, self.hidden :]), "qvel": Values(speeds)}

    def terminated(self) -> Array:
        """Whether a coordinate is not within the range in which the robot lives, [N] bool."""
        dead = np.zeros(len(self._qpos), dtype=bool)
        for i, (low, high) in enumerate(self.alive, start=self.first):
            dead |= ~((low < self._qpos[:, i]) & (self._qpos[:, i] < high))
        return dead


@dataclass
class AntV4(GymRobot):
    """Gymnasium's Ant: eight torques; it dies below 0.2 m and above 1 m."""

    asset = "ant.xml"
    frame_skip = 5
    hidden = 2
    normal = True
    first = 2
    alive = ((np.nextafter(0.2, 0.0), np.nextafter(1.0, 2.0)),)  # the bounds themselves are alive

    @property
    def position(self) -> Array:
        return self._position


@dataclass
class HalfCheetahV4(GymRobot):
    """Gymnasium's HalfCheetah: six torques; it never dies."""

    asset = "half_cheetah.xml"
    frame_skip = 5
    normal = True


@dataclass
class HopperV4(GymRobot):
    """Gymnasium's Hopper: three torques; it dies when it is low, leans, or is very fast."""

    asset = "hopper.xml"
    frame_skip = 4
    noise = 5e-3
    fastest = 10.0
    alive = ((0.7, np.inf), (-0.2, 0.2))

    def terminated(self) -> Array:
        wild = ~(np.abs(self._qpos[:, 2:]) < 100.0).all(axis=1)
        wild |= ~(np.abs(self._qvel) < 100.0).all(axis=1)
        return super().terminated() | wild


@dataclass
class Walker2dV4(GymRobot):
    """Gymnasium's Walker2d: six torques; it dies when it is low or high, or leans."""

    asset = "walker2d.xml"
    frame_skip = 4
    noise = 5e-3
    fastest = 10.0
    alive = ((0.8, 2.0), (-1.0, 1.0))


@dataclass
class SwimmerV4(GymRobot):
    """Gymnasium's Swimmer: two torques; it never dies."""

    asset = "swimmer.xml"
    frame_skip = 4
    hidden = 2


@dataclass
class HumanoidV4(GymRobot):
    """Gymnasium's Humanoid: 17 torques; it dies below 1 m and above 2 m.

    The last 84 of its 376 numbers, ``cfrc_ext``, are forces of contacts that MuJoCo computes only
    when asked for, from what a simulation keeps outside of its fields: one after the other, for
    those that touch something.
    """

    asset = "humanoid.xml"
    frame_skip = 5
    hidden = 2
    noise = 1e-2
    first = 2
    alive = ((1.0, 2.0),)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        names = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext", "xipos", "ncon")
        fields = {name: sim.batch.bind(name) for name in names}
        self._xipos, self._touching = fields.pop("xipos"), fields.pop("ncon")
        fields.pop("cfrc_ext")
        self._fields = {name: f.reshape(len(f), -1) for name, f in fields.items()}
        self._forces = sim.array("cfrc_ext", (6 * sim.model.nbody,))
        self._computed = sim.array("cfrc_ext_step", dtype=np.int64)  # the control step of these
        self._scratch = mujoco.MjData(sim.model)

    def reset(self, ids: Array, rngs: Generators) -> None:
        super().reset(ids, rngs)
        self._forces[ids], self._computed[ids] = 0.0, 0

    @property
    def position(self) -> Array:
        """The centre of mass, [N, 3] m."""
        mass = self.sim.model.body_mass
        center = np.einsum("b,nbj->nj", mass, self._xipos) / mass.sum()
        return center

    def _contact_forces(self) -> Array:
        """The forces of contacts on each body, [N, 84], as of the last control step."""
        steps = self.sim.steps
        for i in np.flatnonzero((steps > 0) & (self._computed != steps)).tolist():
            self._forces[i] = 0.0
            if self._touching[i]:
                data = self.sim.batch.get_data(i, self._scratch)
                mujoco.mj_rnePostConstraint(self.sim.model, data)
                self._forces[i] = data.cfrc_ext.ravel()
            self._computed[i] = steps[i]
        return self._forces

    def observations(self) -> Observations:
        out = {**super().observations()}
        out.update((name, Values(values)) for name, values in self._fields.items())
        out["cfrc_ext"] = Values(self._contact_forces())
        return out

"""Groups of like objects: placed together, seen by one lidar, felt if solid, moving if they move.

What the robot can pass through is plain places, no bodies: it costs the physics nothing. Solid
objects are bodies, mocap ones where only their part moves them, free ones where the robot may.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from sb3_guard.envs import geometry, motion
from sb3_guard.envs.layout import Footprint, Rectangle
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import (
    FLOOR,
    ROBOT,
    Array,
    Generators,
    Painter,
    Part,
    Simulation,
    World,
)
from sb3_guard.envs.sensors import Compass, Scan

BOX = mujoco.mjtGeom.mjGEOM_BOX
CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE
MOST = 1000  # objects in a group: layouts compare every pair


def check_cover(label: str, keepout: float, cover: float) -> None:
    """Refuse a keep-out that lets solid objects begin inside each other.

    :param label: what the keep-out is called
    :param keepout: m
    :param cover: radius that a solid object takes up, m
    :raises ValueError: names the least that is allowed
    """
    if keepout < cover - 1e-9:  # rounding
        raise ValueError(
            f"{label} = {keepout!r} lets solid objects begin inside each other: it must be at "
            f"least {math.ceil(1000 * cover - 1e-6) / 1000:g}; or leave it out for what covers them"
        )


class Bodies:
    """Solid objects as bodies of the world, each with a sensor for the robot's touch.

    :param world: the world under construction
    :param name: what the bodies are called, followed by their number
    :param num: how many
    :param shape: adds the geoms of one body
    :param free: half height of bodies that can be pushed, m; None: they stay where they are put
    :raises ValueError: another part's bodies have this name
    """

    def __init__(
        self,
        world: World,
        name: str,
        num: int,
        shape: Callable[[mujoco.MjsBody], None],
        free: float | None = None,
    ) -> None:
        if num and world.spec.body(f"{name}/0") is not None:
            raise ValueError(
                f"two parts have bodies called {name!r}; give the constraint another name"
            )
        self.name, self.num, self.free = name, num, free is not None
        self._height = 0.0
        if free is not None:
            self._height = resting_height(shape, free, world.spec.option.timestep)
        for i in range(num):
            body = world.spec.worldbody.add_body(name=f"{name}/{i}", mocap=not self.free)
            if self.free:
                body.add_freejoint()
            shape(body)
            world.feel(f"{name}/{i}", body=f"{name}/{i}")

    def bind(self, sim: Simulation) -> None:
        """Take live views: ``positions`` [N, num, 3] m, and ``velocities``, m/s, of free bodies."""
        model, batch, k = sim.model, sim.batch, self.num
        if k == 0:
            self.positions = self.velocities = self._places = np.zeros((sim.num_envs, 0, 3))
            self._turns, self._found = np.zeros((sim.num_envs, 0, 4)), np.zeros((sim.num_envs, 0))
            return
        body = model.body(f"{self.name}/0")
        self.positions = batch.bind("xpos")[:, body.id : body.id + k]
        first = int(model.sensor(f"{self.name}/0").adr[0])
        self._found = batch.bind("sensordata")[:, first : first + k]
        if self.free:
            first = int(body.jntadr[0])
            q, v = int(model.jnt_qposadr[first]), int(model.jnt_dofadr[first])
            pose = batch.bind("qpos")[:, q : q + 7 * k].reshape(-1, k, 7)
            self._places, self._turns = pose[..., :3], pose[..., 3:]
            self.velocities = batch.bind("qvel")[:, v : v + 6 * k].reshape(-1, k, 6)[..., :3]
        else:
            first = int(model.body_mocapid[body.id])
            self._places = batch.bind("mocap_pos")[:, first : first + k]
            self._turns = batch.bind("mocap_quat")[:, first : first + k]

    @property
    def touched(self) -> Array:
        """Which bodies the robot touches, [N, num] bool."""
        return self._found > 0

    def put(self, ids: Array, places: Array, rngs: Generators) -> None:
        """Set bodies down in rows ``ids`` at [n, num, 3] m, each with a random heading."""
        self._places[ids] = places
        self._places[ids, :, 2] += self._height
        for i in ids.tolist():
            heading = rngs[i].uniform(0, 2 * math.pi, self.num)
            self._turns[i] = geometry.yaw_quaternion(heading)

    def move(self, places: Array, rows: Array | slice = slice(None)) -> None:
        """Move bodies that cannot be pushed to [n, num, 3] m, in these rows."""
        self._places[rows] = places


def resting_height(
    shape: Callable[[mujoco.MjsBody], None], half_height: float, timestep: float
) -> float:
    """Height at which a free body lies still on the floor, m.

    Contacts are soft: set down anywhere else it would bounce when an episode begins.

    :param shape: adds the geoms of the body
    :param half_height: of the body, m
    :param timestep: s; how soft depends on it
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=FLOOR, conaffinity=FLOOR
    )
    body = spec.worldbody.add_body(pos=[0, 0, half_height])
    body.add_freejoint()
    shape(body)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=1000)
    return float(data.qpos[2])


@dataclass
class Spatial(Part):
    """A part whose objects lie on the floor or hang in the air, as its ``space`` says."""

    space: str | None = param(
        None, "planar or spatial; null: the robot's workspace", choices=(None, "planar", "spatial")
    )
    height: tuple[float, float] = param((0.5, 1.5), "range of z in space, m", low=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.height[0] > self.height[1]:
            raise ValueError(f"{self.name}.height = {self.height!r} must be (low, high), in metres")

    def build(self, world: World) -> None:
        """Settle the part's space.

        :raises ValueError: heights of what lies on the floor
        """
        super().build(world)
        if self.planar and self.height != type(self).height:
            raise ValueError(
                f"{self.name}.height = {self.height!r} counts in the air only, but its space is "
                f"planar: leave it out, or set {self.name}={{'space': 'spatial', 'height': ...}}"
            )

    def check_height(self, sim: Simulation, near: float, all_of_it: bool) -> None:
        """Refuse to hang what a robot on the floor cannot get to.

        :param near: how near to the objects the robot's position has to come, m
        :param all_of_it: whether this has to be so at every height of the range, not only at one
        :raises ValueError: names the heights that are near enough
        """
        if self.planar or sim.robot.workspace != "planar":
            return
        z, (low, high) = sim.robot.altitude, self.height
        gap = max(z - low, high - z) if all_of_it else max(z - high, low - z)
        if gap >= near:
            raise ValueError(
                f"{self.name}.height = {self.height!r} is out of reach: the robot's position is "
                f"{z:.2f} m above the floor, and only heights between {max(z - near, 0.0):.2f} and "
                f"{z + near:.2f} m count; set {self.name}={{'height': [low, high]}} within these, "
                "or {'space': 'planar'}"
            )

    def check_size(self, sim: Simulation, footprint: str, size: float) -> None:
        """Refuse what would hold the robot wherever an episode began.

        :param footprint: where the objects are placed
        :param size: their radius, m
        :raises ValueError: names the size below which it does not
        """
        z, (low, high) = sim.robot.altitude, self.height
        rise = 0.0 if self.planar else max(abs(z - low), abs(z - high))
        far = math.hypot(sim.farthest(footprint, "robot") + sim.robot.aside, rise)
        if size >= far:
            raise ValueError(
                f"{self.name}.size = {size} holds the robot wherever an episode begins: it is at "
                f"most {far:.2f} m away; make size smaller, or placements larger"
            )


@dataclass
class Objects(Part):
    """Like objects, all of one size.

    A subclass says whether they are ``solid`` and, if so, gives them a ``shape``. An object that
    can be crossed is a disc on the floor or a sphere in the air.
    """

    num: int = param(8, "number of objects", low=0, high=MOST)
    size: float = param(0.3, "radius of an object, m", above=0)
    keepout: float | None = param(
        None, "radius kept clear around an object, m; null: 0.4, or what covers a solid one", low=0
    )
    locations: tuple[tuple[float, float], ...] = param((), "fixed places (x, y), m")
    placements: tuple[Rectangle, ...] = param((), "rectangles to draw from, m; empty: the arena")
    margin: float = param(0.0, "extra distance to every other object, m", low=0)

    usual_keepout: ClassVar[float] = 0.4  # m, of objects that it covers
    free: ClassVar[bool] = False  # whether solid objects can be pushed
    mover: ClassVar[bool] = False  # whether they leave their places
    reachable: ClassVar[bool] = False  # whether they lie within the robot's reach

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.solid and self.keepout is not None:
            check_cover(f"{self.name}.keepout", self.keepout, self.cover)

    @property
    def group(self) -> str:
        """What the objects are called in layouts, observations and bodies."""
        return self.name

    @property
    def cover(self) -> float:
        """Radius around its place that a solid object never leaves, m."""
        return self.size

    @property
    def clear(self) -> float:
        """Radius kept clear around an object when it is placed, m."""
        if self.keepout is not None:
            return self.keepout
        return max(self.usual_keepout, self.cover) if self.solid else self.usual_keepout

    def shape(self, body: mujoco.MjsBody) -> None:
        """Add the geoms of a solid object, whose frame is its place."""
        raise NotImplementedError(f"{self.name} cannot be solid")

    def footprints(self) -> tuple[Footprint, ...]:
        return (
            Footprint(
                self.group,
                self.num,
                self.clear,
                self.placements,
                self.locations,
                self.margin,
                height=0.0 if self.planar else self.height,
                reach=self._reach,
                mover=self.mover,
                base=self._base,
            ),
        )

    def positions(self, footprint: str) -> Array:
        return self.centers

    def build(self, world: World) -> None:
        super().build(world)
        self._reach = world.robot.reach if self.reachable else math.inf
        self._base = world.robot.base
        num, free = self.num if self.solid else 0, self.size if self.free else None
        self.bodies = Bodies(world, self.group, num, self.shape, free)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self.bodies.bind(sim)
        # where they are now, [N, num, 3] m
        self.centers = self.bodies.positions if self.solid else sim.places(self.group)

    def reset(self, ids: Array, rngs: Generators) -> None:
        if self.solid:
            self.bodies.put(ids, self.sim.places(self.group)[ids], rngs)

    def sights(self) -> dict[str, Scan | Compass]:
        return {f"{self.group}_lidar": Scan(self.centers, self.planar)}

    def draw(self, painter: Painter, row: int) -> None:
        if not self.solid:
            for center in self.centers[row]:
                painter.zone(center, self.size, 0.01 if self.planar else 0.0, self.color)

    def add_geom(
        self, body: mujoco.MjsBody, kind: mujoco.mjtGeom, size: tuple[float, ...], lift: float = 0.0
    ) -> mujoco.MjsGeom:
        """Add a geom of this part's colour, ``lift`` m above the frame of ``body``."""
        return add_geom(body, kind, size, self.color, lift, self.free)


def add_geom(
    body: mujoco.MjsBody,
    kind: mujoco.mjtGeom,
    size: tuple[float, ...],
    color: tuple[float, float, float],
    lift: float = 0.0,
    free: bool = False,
) -> mujoco.MjsGeom:
    """Add a geom that robots bump into.

    :param body: whose geom
    :param kind: its shape
    :param size: MuJoCo's sizes of this shape, m
    :param color: red, green, blue
    :param lift: height over the frame of ``body``, m
    :param free: whether it lies on the floor, too
    """
    bits = ROBOT | FLOOR if free else ROBOT
    return body.add_geom(
        type=kind,
        size=[*size, 0.0, 0.0][:3],
        pos=[0.0, 0.0, lift],
        rgba=[*color, 1.0],
        contype=bits,
        conaffinity=bits,
        condim=3,
    )


@dataclass
class Movers(Spatial, Objects):
    """Objects that chase the robot or flee from it (Zhao et al. 2024, §4).

    Speeds are metres per control step under ``speed_law="unit"`` and, with the paper's equations,
    ``"proportional"``, fractions of the distance per control step. Speeds that would jump to and
    fro across what they lead to are refused. A subclass states its :meth:`law` of motion. Their z
    stays within ``height``.
    """

    keepout: float | None = param(
        None, "radius kept clear around an object, m; null: 0.5, or what covers a solid one", low=0
    )
    solid: bool = param(False, "whether they are bodies that push; false: the robot passes through")
    speed: float = param(
        1e-3, "m per control step; what the other speeds default to multiples of", low=0
    )
    speed_law: str = param(
        "unit",
        "speeds along unit vectors, or proportional: as shares of the distance per control step",
        choices=("unit", "proportional"),
    )
    v0: float | None = param(None, "speed home from beyond r0; null: speed", low=0)
    r0: float = param(2.5, "radius around the origin that they do not leave, m", low=0)
    origin: tuple[float, float, float] = param((0.0, 0.0, 0.0), "where home is, (x, y, z) m")

    usual_keepout = 0.5
    mover = True

    def build(self, world: World) -> None:
        super().build(world)
        if self.solid and not self.planar and self.height[0] < self.size:
            raise ValueError(
                f"{self.name}.height = {self.height!r}: solid ones of size {self.size} would stick "
                f"in the floor; the lowest height must be at least {self.size}"
            )

    def law(self) -> motion.Law:
        """How they move."""
        raise NotImplementedError

    def _law(self, **speeds: float) -> motion.Law:
        """A law of motion with what all movers have in common."""
        return motion.Law(
            home=self.speed if self.v0 is None else self.v0,
            apart=self.speed,
            gap=2 * self.size,
            r0=self.r0,
            origin=self.origin,
            unit=self.speed_law == "unit",
            **speeds,
        )

    def shape(self, body: mujoco.MjsBody) -> None:
        if self.planar:
            self.add_geom(body, CYLINDER, (self.size, self.size / 2), lift=self.size / 2)
        else:
            self.add_geom(body, SPHERE, (self.size,))

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self.centers = sim.places(self.group)
        law = self.motion = self.law()
        fastest = max(abs(law.near), abs(law.far), law.settle, law.home)
        if not law.unit and fastest > 1.0:
            raise ValueError(
                f"{self.name}: under speed_law 'proportional' speeds are shares of the distance "
                f"and must be at most 1, but the fastest is {fastest:g}: lower speed, or v0, v1, v2"
            )
        # A step of up to twice the radius at which a mover stops ends within it. Where that is 0 it
        # goes to and fro over its aim, and by no more than its size still lies on it.
        aims = (
            ("the robot", law.near, 0.0),
            ("the robot", law.far, law.r1),
            ("the origin", law.settle, 0.0),
            ("the origin", law.home, law.r0),
        )
        for aim, speed, stop in aims if law.unit else ():
            most = max(2 * stop, self.size)
            if speed > most:
                raise ValueError(
                    f"{self.name}: with {speed:g} m per control step towards {aim} they would jump "
                    f"across it for ever: at most {most:g} m; lower speed, or v0, v1, v2"
                )

    def moving(self) -> tuple[motion.Moving, ...]:
        return (motion.Moving(self.centers, self.motion, self.planar),)

    def before_step(self) -> None:
        if not self.planar:
            z, (low, high) = self.centers[..., 2], self.height
            np.minimum(np.maximum(z, low), high, out=z)
        if self.solid:
            self.bodies.move(self.centers)

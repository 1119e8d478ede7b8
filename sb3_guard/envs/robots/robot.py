"""A robot from an MJCF file: everything that the other parts ask of it is read from the file.

The file holds the robot alone: no floor, no options, no light. Its conventions:

* the outermost body is called ``robot``; it either begins with a free joint or, for robots that
  move at a fixed height or not at all, with its own slides and hinges; these then hang under a
  mocap body that carries the place and heading of an episode's start;
* every sensor in the file is observed under its own name; ``jointpos`` as (sin θ, cos θ), ball
  joints as a rotation matrix; sensors whose names begin with ``_`` are not observed;
* actions in [−1, 1] are scaled linearly to the control range of the actuators, in their order;
* a keyframe named ``start`` holds the pose in which an episode begins;
* geoms that touch the floor have ``conaffinity="3"``, and ``priority="1"`` if their own friction
  shall hold on it; with MuJoCo's defaults a geom meets everything but the floor.
"""

from __future__ import annotations

import importlib.resources
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.layout import Footprint, Rectangle
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Array, Generators, Robot, Simulation, World
from sb3_guard.envs.sensors import Channel
from sb3_guard.spelling import did_you_mean

Vector = tuple[float, float, float]
PREFIX = "robot/"
_SENSOR = mujoco.mjtSensor

# unit and bounds of the sensors that a robot may carry
_CHANNELS = {
    _SENSOR.mjSENS_ACCELEROMETER: (-math.inf, math.inf, "m/s²"),
    _SENSOR.mjSENS_VELOCIMETER: (-math.inf, math.inf, "m/s"),
    _SENSOR.mjSENS_GYRO: (-math.inf, math.inf, "rad/s"),
    _SENSOR.mjSENS_MAGNETOMETER: (-math.inf, math.inf, "T"),
    _SENSOR.mjSENS_TOUCH: (0.0, math.inf, "N"),
    _SENSOR.mjSENS_JOINTVEL: (-math.inf, math.inf, "rad/s"),
    _SENSOR.mjSENS_BALLANGVEL: (-math.inf, math.inf, "rad/s"),
}


def as_slice(ids: list[int]) -> slice | list[int]:
    """Evenly spaced rising indices as a slice, which takes a view; other ones as they are."""
    step = ids[1] - ids[0] if len(ids) > 1 else 1
    even = step > 0 and len(ids) > 0 and ids == list(range(ids[0], ids[-1] + 1, step))
    return slice(ids[0], ids[-1] + 1, step) if even else ids


def _extent(model: mujoco.MjModel, root: int, center: int) -> float:
    """How far from the origin of body ``center`` any geom may reach, whatever the joints do, m.

    Joints of the root place the robot; one that lifts it has no bound.
    """
    reach = {root: 0.0}  # m, of a body's origin from the root's
    outermost = 0.0
    for body in range(root, model.nbody):
        if body != root:
            parent = int(model.body_parentid[body])
            if parent not in reach:
                continue
            reach[body] = reach[parent] + float(np.linalg.norm(model.body_pos[body]))
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
                if body == root and not model.jnt_axis[joint][2]:
                    continue
                if body == root or not model.jnt_limited[joint]:
                    return math.inf
                reach[body] += float(np.abs(model.jnt_range[joint]).max())
            elif body != root:  # the origin turns about the anchor
                reach[body] += 2 * float(np.linalg.norm(model.jnt_pos[joint]))
        first = int(model.body_geomadr[body])
        for geom in range(first, first + int(model.body_geomnum[body])):
            size = float(np.linalg.norm(model.geom_pos[geom]) + model.geom_rbound[geom])
            outermost = max(outermost, reach[body] + size)
    return outermost + reach[center]


@dataclass
class MJCFRobot(Robot):
    """A robot described by an MJCF file.

    Subclasses name their file and time step; a user's own robot is made with one line,
    ``register_robot("Crawler", xml="crawler.xml")``.
    """

    asset: ClassVar[str]
    timestep: ClassVar[float]  # s, one physics step; a control step is ten
    workspace: ClassVar[str] = "planar"
    lidar_bodies: ClassVar[tuple[str, ...]] = ("robot",)
    center: ClassVar[str] = "robot"  # the body whose origin is the robot's position

    name = "robot"
    keepout: float = param(0.4, "radius kept clear around the robot at the start, m", low=0)
    locations: tuple[tuple[float, float], ...] = param(
        (), "fixed start, one (x, y), m; empty: anywhere, of an arm the origin"
    )
    placements: tuple[Rectangle, ...] = param((), "rectangles to start in, m; empty: the arena")
    margin: float = param(0.0, "extra distance to every other object, m", low=0)
    heading: float | None = param(None, "start heading, rad; null: uniformly random")
    sensing: tuple[str, ...] | None = param(
        None, "bodies that carry lidar and compass; null: the robot's own choice"
    )

    root: ClassVar[str] = PREFIX + "robot"
    # the camera that can be observed: on which body of the world it sits, where on it, m, and which
    # way it looks, both in the body's frame, whose z axis points up in the image
    eye: ClassVar[tuple[str, Vector, Vector]] = (root, (0.0, 0.0, 0.1), (1.0, 0.0, 0.0))

    @classmethod
    def path(cls) -> Path:
        """The robot's MJCF file."""
        return Path(str(importlib.resources.files("sb3_guard.envs.robots") / "assets" / cls.asset))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sensing == ():
            raise ValueError("robot.sensing = () must name a body, or be null")
        if math.isfinite(self.reach) and self.placements:
            raise ValueError(
                f"robot.placements = {self.placements!r}: a robot of limited reach stands at a "
                "fixed place; set robot={'locations': [[x, y]]}"
            )

    @property
    def base(self) -> tuple[float, float]:
        return self.locations[0] if self.locations else (0.0, 0.0)

    def footprints(self) -> tuple[Footprint, ...]:
        places = self.locations or ((self.base,) if math.isfinite(self.reach) else ())
        return (Footprint("robot", 1, self.keepout, self.placements, places, self.margin),)

    def build(self, world: World) -> None:
        super().build(world)
        try:
            robot = mujoco.MjSpec.from_file(str(self.path()))
            robot.compile()  # attach() drops without a word what refers to something missing
        except ValueError as error:
            raise ValueError(f"{self.path()}: {' '.join(str(error).split())}") from None
        if robot.body("robot") is None:
            raise ValueError(f"{self.path()} has no body called 'robot': call its outermost so")
        known = [body.name for body in robot.bodies if body.name and body is not robot.worldbody]
        named = {
            "lidar_bodies": self.lidar_bodies if self.sensing is None else (),
            "robot.sensing": self.sensing or (),
            "center": (self.center,),
        }
        for where, names in named.items():
            for name in names:
                if name not in known:
                    raise ValueError(
                        f"{where} names no body {name!r} of the robot: {did_you_mean(name, known)}"
                    )
        joints = robot.body("robot").joints
        self._free = bool(joints) and joints[0].type == mujoco.mjtJoint.mjJNT_FREE
        if self._free:
            frame = world.spec.worldbody.add_frame()
        else:
            frame = world.spec.worldbody.add_body(name="spawn", mocap=True).add_frame()
        world.spec.attach(robot, prefix=PREFIX, frame=frame)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        model, batch = sim.model, sim.batch
        self.action_size = model.nu
        low, high = model.actuator_ctrlrange.T
        for i in np.flatnonzero(~(high > low)).tolist():
            raise ValueError(
                f"actuator {model.actuator(i).name.removeprefix(PREFIX)!r} of the robot has no "
                'ctrlrange: give it one, such as ctrlrange="-1 1"'
            )
        if not model.nu:
            raise ValueError(f"{self.path()} has no actuators: the robot could not act")
        self._center, self._half = (low + high) / 2, (high - low) / 2
        self._ctrl = batch.bind("ctrl")
        self._qpos = batch.bind("qpos")
        start = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, PREFIX + "start")
        self._start = model.key_qpos[start] if start >= 0 else model.qpos0
        center = model.body(PREFIX + self.center).id
        self._position = batch.bind("xpos")[:, center]
        pose = mujoco.MjData(model)
        pose.qpos[: len(self._start)] = self._start
        mujoco.mj_kinematics(model, pose)
        self.altitude = float(pose.xpos[center, 2])
        self.aside = math.dist(pose.xpos[center, :2], pose.qpos[:2] if self._free else (0.0, 0.0))
        self.extent = _extent(model, model.body(self.root).id, center)
        if self._free:
            body = model.body(self.root).id
            address = int(model.jnt_qposadr[model.body_jntadr[body]])
            self._place = self._qpos[:, address : address + 3]
            self._turn = self._qpos[:, address + 3 : address + 7]
            self._attitude = self._start[address + 3 : address + 7]
        else:
            spawn = int(model.body_mocapid[model.body("spawn").id])
            self._place = batch.bind("mocap_pos")[:, spawn]
            self._turn = batch.bind("mocap_quat")[:, spawn]
            self._attitude = np.array([1.0, 0.0, 0.0, 0.0])
        ids = [model.body(PREFIX + name).id for name in self.sensing or self.lidar_bodies]
        rotation = batch.bind("xmat")  # [N, nbody, 9]
        self._bodies = as_slice(ids)
        self._xpos, self._xmat = batch.bind("xpos"), rotation.reshape(*rotation.shape[:2], 3, 3)
        self._sensors = list(self._read_sensors(model))
        self._data = batch.bind("sensordata")
        kinds = {name: kind for name, kind, _ in self._sensors}
        self._balls = [name for name in kinds if kinds[name] == _SENSOR.mjSENS_BALLQUAT]
        self._hinges = [name for name in kinds if kinds[name] == _SENSOR.mjSENS_JOINTPOS]
        self._angles = as_slice([w.start for n, _, w in self._sensors if n in self._hinges])

    def _read_sensors(self, model: mujoco.MjModel) -> Any:
        """(name, type, slice of sensordata) of every observed sensor of the robot."""
        for i in range(model.nsensor):
            name = model.sensor(i).name
            if not name.startswith(PREFIX) or name.startswith(PREFIX + "_"):
                continue
            joint = int(model.sensor_objid[i])
            kind = int(model.sensor_type[i])
            slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
            if kind == int(_SENSOR.mjSENS_JOINTPOS) and int(model.jnt_type[joint]) == slide:
                raise ValueError(
                    f"sensor {name.removeprefix(PREFIX)!r} observes a slide's position as an "
                    "angle: leave it out, or begin its name with '_'"
                )
            first = int(model.sensor_adr[i])
            where = slice(first, first + int(model.sensor_dim[i]))
            yield name.removeprefix(PREFIX), _SENSOR(int(model.sensor_type[i])), where

    @property
    def position(self) -> Array:
        return self._position

    @property
    def frames(self) -> tuple[Array, Array]:
        return self._xpos[:, self._bodies], self._xmat[:, self._bodies]

    def positions(self, footprint: str) -> Array:
        stands = math.isfinite(self.reach)  # where its base is, whatever the hand does
        return self.sim.places("robot") if stands else self.position[:, None]

    def clearance(self, points: Array, planar: bool) -> Array:
        """Distance of points from the robot's origin, [N, K] m."""
        return geometry.distance(self.position[:, None], points, planar)

    def reset(self, ids: Array, rngs: Generators) -> None:
        places = self.sim.places("robot")
        self._qpos[ids, : len(self._start)] = self._start
        for i in ids.tolist():
            heading = rngs[i].uniform(0, 2 * math.pi) if self.heading is None else self.heading
            yaw = geometry.yaw_quaternion(np.asarray(heading))
            mujoco.mju_mulQuat(self._turn[i], yaw, self._attitude)
        self._place[ids, :2] = places[ids, 0, :2]
        if not self._free:
            self._place[ids, 2] = 0.0

    def act(self, actions: Array) -> None:
        self._ctrl[:] = self._center + self._half * actions

    def observe(self) -> dict[str, Array]:
        out = {name: self._data[:, where] for name, _, where in self._sensors}
        for name in self._balls:
            out[name] = geometry.rotation_matrix(out[name])
        if self._hinges:
            angles = self._data[:, self._angles]
            turns = np.empty((*angles.shape, 2))  # [N, hinges, 2]
            np.sin(angles, out=turns[..., 0])
            np.cos(angles, out=turns[..., 1])
            out.update((name, turns[:, i]) for i, name in enumerate(self._hinges))
        return out

    def channels(self) -> dict[str, Channel]:
        out = {}
        for name, kind, where in self._sensors:
            if kind == _SENSOR.mjSENS_JOINTPOS:
                out[name] = Channel(2, -1.0, 1.0, "sin, cos")
            elif kind == _SENSOR.mjSENS_BALLQUAT:
                out[name] = Channel(9, -1.0, 1.0, "rotation matrix")
            elif kind in _CHANNELS:
                low, high, unit = _CHANNELS[kind]
                out[name] = Channel(where.stop - where.start, low, high, unit)
            else:
                out[name] = Channel(where.stop - where.start)
        return out

    @classmethod
    def show(cls) -> None:
        """Open the robot in MuJoCo's viewer, or write a picture where there is no display."""
        from sb3_guard.envs.rendering import show_robot

        show_robot(cls())

"""A robot from an MJCF file: everything that the other parts ask of it is read from the file.

The file holds the robot alone, no floor; an ``<option>`` holds unless the class states the same.
Its conventions:

* the outermost body is called ``robot``; it either begins with a free joint or, for robots that
  move at a fixed height or not at all, with its own slides and hinges; these then hang under a
  mocap body that carries the place and heading of an episode's start;
* every sensor in the file is observed under its own name; ``jointpos`` of a hinge as
  (sin θ, cos θ), ball joints as a rotation matrix; sensors whose names begin with ``_`` are not
  observed;
* actions in [−1, 1] are scaled linearly to the control range of the actuators, in their order; of
  a class with ``scaled = False`` they are the controls themselves;
* a keyframe named ``start`` holds the pose in which an episode begins;
* its contact bits say which of its geoms meet each other; the world sets those for objects and
  floor. Geoms whose own friction shall hold on the floor have ``priority="1"``.

A class with ``complete = True`` has a file that is a whole world: its floor and its options are
used, names are as in the file, and the robot begins where the file puts it.
"""

import importlib.resources
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.layout import Footprint, Rectangle
from sb3_guard.envs.observation import Observations, Values
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import FRICTION, MASS, Robot, Simulation, World
from sb3_guard.envs.robots import mjcf, sensors
from sb3_guard.envs.types import Array, Generators
from sb3_guard.spelling import did_you_mean

Vector = tuple[float, float, float]
PREFIX = "robot/"
_SENSOR = mujoco.mjtSensor


def as_slice(ids: list[int]) -> slice | list[int]:
    """Evenly spaced rising indices as a slice, which takes a view; other ones as they are."""
    step = ids[1] - ids[0] if len(ids) > 1 else 1
    even = step > 0 and len(ids) > 0 and ids == list(range(ids[0], ids[-1] + 1, step))
    return slice(ids[0], ids[-1] + 1, step) if even else ids


@dataclass
class MJCFRobot(Robot):
    """A robot described by an MJCF file.

    Subclasses name their file and time step; a user's own robot is made with one line,
    ``register_robot("Crawler", xml="crawler.xml")``.
    """

    asset: ClassVar[str]
    workspace: ClassVar[str] = "planar"
    lidar_bodies: ClassVar[tuple[str, ...]] = ("robot",)
    center: ClassVar[str] = "robot"  # the body whose origin is the robot's position
    scaled: ClassVar[bool] = True  # whether actions are shares of the actuators' control ranges
    floor: ClassVar[bool] = True  # False: it slides at a fixed height and never meets the floor
    complete: ClassVar[bool] = False  # whether the file is a world: floor and options, too

    name = "robot"
    keepout: float = param(0.4, "radius kept clear around the robot at the start, m", low=0)
    locations: tuple[tuple[float, float], ...] = param(
        (), "fixed start, one (x, y), m; empty: anywhere, of an arm the origin"
    )
    placements: tuple[Rectangle, ...] = param((), "rectangles to start in, m; empty: the arena")
    margin: float = param(0.0, "extra distance to every other object, m", low=0)
    heading: float | None = param(None, "start heading, rad; null: uniformly random")
    action_noise: float = param(
        0.0, "standard deviation of Gaussian noise on every action, in units of actions", low=0
    )
    delay: int = param(
        0, "control steps that pass until an action has effect", low=0, high=100, drawn=True
    )
    mass: float = MASS
    friction: float = FRICTION
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
        placed = self.locations or self.placements or self.heading is not None
        if self.complete and placed:
            raise ValueError(
                f"robot {type(self).__name__} begins where its file puts it: leave out locations, "
                "placements and heading"
            )
        if math.isfinite(self.reach) and self.placements:
            raise ValueError(
                f"robot.placements = {self.placements!r}: a robot of limited reach stands at a "
                "fixed place; set robot={'locations': [[x, y]]}"
            )

    @property
    def base(self) -> tuple[float, float]:
        return self.locations[0] if self.locations else (0.0, 0.0)

    def footprints(self) -> tuple[Footprint, ...]:
        stands = self.complete or math.isfinite(self.reach)
        places = self.locations or ((self.base,) if stands else ())
        return (Footprint("robot", 1, self.keepout, self.placements, places, self.margin),)

    def read(self) -> mujoco.MjSpec:
        """The robot, or the whole world of a robot with ``complete = True``; a new one."""
        return mjcf.read(self.path(), self.root.removeprefix(PREFIX), self.complete)

    def first_pose(self, model: mujoco.MjModel) -> Array:
        """qpos in which an episode begins, of the robot at least."""
        prefix = "" if self.complete else PREFIX
        start = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, prefix + "start")
        pose: Array = model.key_qpos[start] if start >= 0 else model.qpos0
        return pose

    def world(self) -> mujoco.MjSpec | None:
        return self.read() if self.complete else None

    def build(self, world: World) -> None:
        super().build(world)
        robot = world.spec if self.complete else self.read()
        self._own = {sensor.name for sensor in robot.sensors if sensor.name}
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
        joints = robot.body(self.root.removeprefix(PREFIX)).joints
        self._free = bool(joints) and joints[0].type == mujoco.mjtJoint.mjJNT_FREE
        if self.complete:
            return
        mjcf.honour_options(robot.option, world.spec.option)
        mjcf.agree(robot, world.spec)
        mjcf.set_contact_bits(robot, self.floor, str(self.path()))
        if self._free:
            frame = world.spec.worldbody.add_frame()
        else:
            frame = world.spec.worldbody.add_body(name="spawn", mocap=True).add_frame()
        world.spec.attach(robot, prefix=PREFIX, frame=frame)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        model, batch = sim.model, sim.batch
        prefix = "" if self.complete else PREFIX
        self.action_size = model.nu
        low, high = model.actuator_ctrlrange.T
        for i in np.flatnonzero(~(high > low)).tolist():
            raise ValueError(
                f"actuator {model.actuator(i).name.removeprefix(prefix)!r} of the robot has no "
                'ctrlrange: give it one, such as ctrlrange="-1 1", or, if it is a position servo '
                'of a joint with a range, inheritrange="1"'
            )
        if not model.nu:
            raise ValueError(f"{self.path()} has no actuators: the robot could not act")
        self._center, self._half = (low + high) / 2, (high - low) / 2
        if not self.scaled:
            self.action_range = low, high
            self._center, self._half = np.zeros(model.nu), np.ones(model.nu)
        self._ctrl = batch.bind("ctrl")
        if self.delay:  # rings of the latest actions, by step
            self._actions = sim.array("robot/actions", (self.delay + 1, model.nu))
            self._delays = self.current("delay")
        self._qpos = batch.bind("qpos")
        self._start = self.first_pose(model)
        center = model.body(prefix + self.center).id
        self._position = batch.bind("xpos")[:, center]
        root = model.body_rootid[center]  # spatial velocities are at its subtree's centre of mass
        self._spatial, self._com = batch.bind("cvel")[:, center], batch.bind("subtree_com")[:, root]
        pose = mujoco.MjData(model)
        pose.qpos[: len(self._start)] = self._start
        mujoco.mj_kinematics(model, pose)
        self.altitude = float(pose.xpos[center, 2])
        if not self.complete:
            self._bind_place(sim)
        ids = [model.body(prefix + name).id for name in self.sensing or self.lidar_bodies]
        rotation = batch.bind("xmat")  # [N, nbody, 9]
        self._bodies = as_slice(ids)
        self._xpos, self._xmat = batch.bind("xpos"), rotation.reshape(*rotation.shape[:2], 3, 3)
        self._sensors = list(self._read_sensors(model))
        self._data = batch.bind("sensordata")
        self._balls = [(n, w) for n, kind, w in self._sensors if kind == _SENSOR.mjSENS_BALLQUAT]
        hinges = [(n, w.start) for n, _, w in self._sensors if sensors.is_angle(model, prefix + n)]
        self._hinges, self._angles = [n for n, _ in hinges], as_slice([i for _, i in hinges])
        self._live = {  # in the order of the file
            name: Values(self._data[:, where], *sensors.bounds(model, prefix + name))
            for name, _, where in self._sensors
        }

    def _bind_place(self, sim: Simulation) -> None:
        """Take views of what puts the robot somewhere: its free joint, or the body it hangs on."""
        model, batch = sim.model, sim.batch
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

    def _read_sensors(self, model: mujoco.MjModel) -> Any:
        """(name, type, slice of sensordata) of every observed sensor of the robot."""
        prefix = "" if self.complete else PREFIX
        for i in range(model.nsensor):
            name = model.sensor(i).name.removeprefix(prefix)
            if name not in self._own or name.startswith("_"):
                continue
            first = int(model.sensor_adr[i])
            where = slice(first, first + int(model.sensor_dim[i]))
            yield name, _SENSOR(int(model.sensor_type[i])), where

    @property
    def position(self) -> Array:
        return self._position

    @property
    def velocity(self) -> Array:
        turn, arm = self._spatial[:, :3], self._position - self._com
        return self._spatial[:, 3:] + np.cross(turn, arm)

    @property
    def frames(self) -> tuple[Array, Array]:
        return self._xpos[:, self._bodies], self._xmat[:, self._bodies]

    @property
    def controls(self) -> tuple[Array, Array]:
        """The controls that the lowest and the highest actions set, [action_size] each."""
        low, high = map(self.to_controls, self.action_range)
        least, most = self.sim.model.actuator_ctrlrange.T  # MuJoCo keeps controls within
        return np.maximum(low, least), np.minimum(high, most)

    def positions(self, footprint: str) -> Array:
        # an arm is where its base is, whatever the hand does
        stands = math.isfinite(self.reach)
        return self.sim.places("robot") if stands else self.position[:, None]

    def clearance(self, points: Array, planar: bool) -> Array:
        """Distance of points from the robot's origin, [N, K] m."""
        return geometry.distance(self.position[:, None], points, planar)

    def reset(self, ids: Array, rngs: Generators) -> None:
        self._qpos[ids, : len(self._start)] = self._start
        if self.delay:
            self._actions[ids] = 0.0
        if self.complete:
            return
        places = self.sim.places("robot")
        for i in ids.tolist():
            heading = rngs[i].uniform(0, 2 * math.pi) if self.heading is None else self.heading
            yaw = geometry.yaw_quaternion(np.asarray(heading))
            mujoco.mju_mulQuat(self._turn[i], yaw, self._attitude)
        self._place[ids, :2] = places[ids, 0, :2]
        if not self._free:
            self._place[ids, 2] = 0.0

    def act(self, actions: Array) -> None:
        if self.action_noise:
            noise = [rng.standard_normal(self.action_size) for rng in self.sim.rngs]
            actions = actions + self.action_noise * np.array(noise)
        if self.delay:
            actions = self._delayed(actions)
        self._ctrl[:] = self.to_controls(actions)

    def to_controls(self, actions: Array | float) -> Array:
        return self._center + self._half * actions

    def _delayed(self, actions: Array) -> Array:
        """The actions of ``delay`` steps ago, [N, action_size], keeping those of now for later."""
        rows, steps, slots = np.arange(len(actions)), self.sim.steps, self.delay + 1
        self._actions[rows, steps % slots] = actions
        return self._actions[rows, (steps - self._delays) % slots]

    def observations(self) -> Observations:
        out = dict(self._live)
        for name, where in self._balls:
            turn = geometry.rotation_matrix(self._data[:, where])
            out[name] = Values(turn, -1.0, 1.0, "rotation matrix")
        if self._hinges:
            angles = self._data[:, self._angles]
            turns = np.empty((*angles.shape, 2))  # [N, hinges, 2]
            np.sin(angles, out=turns[..., 0])
            np.cos(angles, out=turns[..., 1])
            for i, name in enumerate(self._hinges):
                out[name] = Values(turns[:, i], -1.0, 1.0, "sin, cos")
        return out

    @classmethod
    def show(cls) -> None:
        """Open the robot in MuJoCo's viewer, or write a picture where there is no display."""
        from sb3_guard.envs.rendering import show_robot

        show_robot(cls())

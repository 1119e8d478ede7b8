"""A robot from an MJCF file: everything that the other parts ask of it is read from the file.

Files of this package are written for its worlds; others may be as their makers wrote them, and
:mod:`sb3_guard.envs.robots.model_file` takes the robot out of them. In both

* the robot's root either begins with a free joint or, for robots that move at a fixed height or not
  at all, with its own slides and hinges; these then hang under a mocap body that carries the place
  and heading of an episode's start;
* every sensor in the file is observed under its own name; ``jointpos`` of a hinge as
  (sin θ, cos θ), ball joints as a rotation matrix; sensors whose names begin with ``_`` are not
  observed;
* actions in [−1, 1] are scaled linearly to the control range of the actuators, in their order; of
  a class with ``scaled = False`` they are the controls themselves;
* a keyframe named ``start`` is the state in which an episode begins;
* its contact bits say which of its geoms meet each other; the world sets those for objects and
  floor. Geoms whose own friction shall hold on the floor have ``priority="1"``.

A file that was written for a class calls its outermost body ``robot``. A class with
``complete = True`` has a file that is a whole world: its floor is used, names are as in the file,
and the robot begins where the file puts it. A class with ``aware = True`` also observes what no
sensor of the file measures; joints of the outermost body say where the robot is and are in none of
these:

* ``base_linvel``, ``base_angvel``: velocities of the outermost body in its frame;
* ``gravity``: which way is down in that frame;
* ``joint_pos``: positions of slides and of hinges with a range, relative to the start, rad, m;
* ``joint_turn``: of hinges without a range (sin θ, cos θ), of balls the rotation matrix;
* ``joint_vel``: velocities of these joints;
* ``last_action``.
"""

import importlib.resources
import math
from collections.abc import Iterator
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
from sb3_guard.envs.robots import sensors
from sb3_guard.envs.robots.model_file import BALL, FREE, HINGE, SLIDE, ModelFile, settle
from sb3_guard.envs.types import Array, Generators
from sb3_guard.fields import did_you_mean

Vector = tuple[float, float, float]
PREFIX = "robot/"
_SENSOR = mujoco.mjtSensor
# sensors of joints, and on the outermost body, that are observed in place of what is computed
_COVERING = {
    "joint_pos": (_SENSOR.mjSENS_JOINTPOS, _SENSOR.mjSENS_BALLQUAT),
    "joint_vel": (_SENSOR.mjSENS_JOINTVEL, _SENSOR.mjSENS_BALLANGVEL),
    "base_linvel": (_SENSOR.mjSENS_VELOCIMETER, _SENSOR.mjSENS_FRAMELINVEL),
    "base_angvel": (_SENSOR.mjSENS_GYRO, _SENSOR.mjSENS_FRAMEANGVEL),
    "gravity": (_SENSOR.mjSENS_FRAMEQUAT, _SENSOR.mjSENS_FRAMEZAXIS),
}


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
    scaled = True  # whether actions are shares of the actuators' control ranges
    floor: ClassVar[bool] = True  # False: it slides at a fixed height and never meets the floor
    complete: ClassVar[bool] = False  # whether the file is a world with a floor of its own
    aware: ClassVar[bool] = False  # whether it observes what no sensor of the file measures
    thickness = 0.0
    tip: ClassVar[str | None] = None  # the site at its position; None: the body ``center``

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
        self.reach_center = (*(self.locations or ((0.0, 0.0),))[0], 0.0)

    def footprints(self) -> tuple[Footprint, ...]:
        stands = self.complete or math.isfinite(self.reach)
        places = self.locations or (((0.0, 0.0),) if stands else ())
        return (Footprint("robot", 1, self.keepout, self.placements, places, self.margin),)

    @classmethod
    def model_file(cls) -> ModelFile:
        """The robot in its file."""
        root = cls.root.removeprefix(PREFIX)
        return settle(cls.path(), root, cls.complete, as_written=True)

    @property
    def _prefix(self) -> str:
        return "" if self.complete else PREFIX

    def world(self) -> mujoco.MjSpec | None:
        return self.model_file().spec.copy() if self.complete else None

    def build(self, world: World) -> None:
        super().build(world)
        file = self.model_file()
        self._base, self._posing = [joint.name for joint in file.base], file.posing
        self._start, self.stop = file.start, file.stop
        self._own = {sensor.name for sensor in file.spec.sensors if sensor.name}
        self._own |= {values["name"] for kind, values in file.on_floor if kind == "sensor"}
        bodies = [body.name for body in file.spec.bodies[1:] if body.name]
        named = {
            "lidar_bodies": self.lidar_bodies if self.sensing is None else (),
            "robot.sensing": self.sensing or (),
            "center": (self.center,),
        }
        for where, names in named.items():
            for name in names:
                if name not in bodies:
                    raise ValueError(
                        f"{where} names no body {name!r} of the robot: {did_you_mean(name, bodies)}"
                    )
        self._free = bool(file.base) and int(file.base[0].type) == FREE
        if not self.complete:
            file.enter(world.spec, PREFIX, self.floor, "spawn")

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        model, batch = sim.model, sim.batch
        prefix = self._prefix
        self.action_size = model.nu
        low, high = model.actuator_ctrlrange.T
        for i in np.flatnonzero(~(high > low) | ~np.isfinite(high - low)).tolist():
            raise ValueError(
                f"actuator {model.actuator(i).name.removeprefix(prefix)!r} of the robot has no "
                'ctrlrange: give it finite numbers, as ctrlrange="-1 1", or, if it is a position '
                'servo of a joint with a range, inheritrange="1"'
            )
        self._center, self._half = (low + high) / 2, (high - low) / 2
        if not self.scaled:
            self.action_range = low, high
            self._center, self._half = np.zeros(model.nu), np.ones(model.nu)
        self._ctrl = batch.bind("ctrl")
        if self.delay:  # rings of the latest actions, by step
            self._actions = sim.array("robot/actions", (self.delay + 1, model.nu))
            self._delays = self.current("delay")
        # what the state begins with is the robot's, which enters a world first
        self._begins = [
            (batch.bind(name), values)
            for name, values in self._start.items()
            if name == "qpos" or values.any()
        ]
        self._qpos, self._qvel = batch.bind("qpos"), batch.bind("qvel")
        center = model.body(prefix + self.center).id
        self._position = batch.bind("xpos")[:, center]
        root = model.body_rootid[center]  # spatial velocities are at its subtree's centre of mass
        self._spatial, self._com = batch.bind("cvel")[:, center], batch.bind("subtree_com")[:, root]
        pose = mujoco.MjData(model)
        pose.qpos[: len(self._start["qpos"])] = self._start["qpos"]
        mujoco.mj_kinematics(model, pose)
        self.altitude = float(pose.xpos[center, 2])
        if self.tip is not None:
            site = model.site(prefix + self.tip).id
            self._position = batch.bind("site_xpos")[:, site]
            self.altitude = float(pose.site_xpos[site, 2])
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
        self._senses: list[str] = []
        if self.aware:
            self._last = sim.array("robot/last_action", (model.nu,))
            self._senses = list(self._unmeasured(model))

    def _unmeasured(self, model: mujoco.MjModel) -> Iterator[str]:
        """Names of what is observed without a sensor; notes where the joints' numbers are."""
        root, prefix = model.body(self.root).id, self._prefix
        self._axes = self._xmat[:, root]  # [N, 3, 3], body to world
        self._spin = self.sim.batch.bind("cvel")[:, root, :3]
        ids = {name: model.sensor(prefix + name).id for name, _, _ in self._sensors}
        on_root = [kind for name, kind, _ in self._sensors
                   if root in sensors.bodies(model, ids[name])]  # fmt: skip
        base = [model.joint(prefix + name) for name in self._base]
        tilts = any(
            j.type[0] in (FREE, BALL) or (j.type[0] == HINGE and abs(j.axis[2]) < 1) for j in base
        )
        for name in ("base_linvel", "base_angvel", "gravity"):
            exists = tilts if name == "gravity" else bool(base)
            if exists and not any(kind in _COVERING[name] for kind in on_root):
                yield name
        positions, speeds = (
            {int(model.sensor_objid[ids[n]]) for n, kind, _ in self._sensors if kind in kinds}
            for kinds in (_COVERING["joint_pos"], _COVERING["joint_vel"])
        )
        # the joint of each number and where it is, in qpos or in qvel
        places: list[tuple[int, int]] = []
        turns: list[tuple[int, int]] = []
        balls: list[tuple[int, int]] = []
        moves: list[tuple[int, int]] = []
        for name in self._posing:
            joint = model.joint(prefix + name)
            kind, first = joint.type[0], int(joint.dofadr[0])
            if joint.id not in positions:
                swings = kind == SLIDE or model.jnt_limited[joint.id]
                numbers = balls if kind == BALL else places if swings else turns
                numbers.append((joint.id, int(joint.qposadr[0])))
            if joint.id not in speeds:
                moves += [(joint.id, first + k) for k in range(3 if kind == BALL else 1)]
        self._turning, self._balling = ([at for _, at in numbers] for numbers in (turns, balls))
        self._numbers = {"joint_pos": places, "joint_turn": turns + balls, "joint_vel": moves}
        self._where = {name: [at for _, at in numbers] for name, numbers in self._numbers.items()}
        self._units = {
            name: [("m" if model.jnt_type[i] == SLIDE else "rad") + over for i, _ in numbers]
            for (name, numbers), over in zip(self._numbers.items(), ("", "", "/s"), strict=True)
        }
        yield from (name for name, numbers in self._numbers.items() if numbers)
        yield "last_action"

    def _bind_place(self, sim: Simulation) -> None:
        """Take views of what puts the robot somewhere: its free joint, or the body it hangs on."""
        model, batch = sim.model, sim.batch
        if self._free:
            body = model.body(self.root).id
            address = int(model.jnt_qposadr[model.body_jntadr[body]])
            self._dof = int(model.jnt_dofadr[model.body_jntadr[body]])
            self._place = self._qpos[:, address : address + 3]
            self._turn = self._qpos[:, address + 3 : address + 7]
            self._attitude = self._start["qpos"][address + 3 : address + 7]
        else:
            spawn = int(model.body_mocapid[model.body("spawn").id])
            self._place = batch.bind("mocap_pos")[:, spawn]
            self._turn = batch.bind("mocap_quat")[:, spawn]
            self._attitude = np.array([1.0, 0.0, 0.0, 0.0])

    def _read_sensors(self, model: mujoco.MjModel) -> Any:
        """(name, type, slice of sensordata) of every observed sensor of the robot."""
        for i in range(model.nsensor):
            name = model.sensor(i).name.removeprefix(self._prefix)
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
        for field, values in self._begins:
            field[ids, : len(values)] = values
        if self.delay:
            self._actions[ids] = 0.0
        if self.aware:
            self._last[ids] = 0.0
        if self.complete:
            return
        places = self.sim.places("robot")
        for i in ids.tolist():
            heading = rngs[i].uniform(0, 2 * math.pi) if self.heading is None else self.heading
            yaw = geometry.yaw_quaternion(np.asarray(heading))
            mujoco.mju_mulQuat(self._turn[i], yaw, self._attitude)
            if self._free and self._start["qvel"].any():  # which is along the world's axes
                velocity = self._qvel[i, self._dof : self._dof + 3]
                mujoco.mju_rotVecQuat(velocity, velocity.copy(), yaw)
        self._place[ids, :2] = places[ids, 0, :2]
        if not self._free:
            self._place[ids, 2] = 0.0

    def act(self, actions: Array) -> None:
        if self.aware:
            self._last[:] = actions
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
        out.update((name, self._sense(name)) for name in self._senses if name not in out)
        return out

    def _sense(self, name: str) -> Values:
        """An observation for which the file has no sensor."""
        start, where = self._start["qpos"], self._where.get(name, [])
        match name:
            case "joint_pos":
                unit = ", ".join(dict.fromkeys(self._units[name]))
                return Values(self._qpos[:, where] - start[where], unit=unit)
            case "joint_vel":
                unit = ", ".join(dict.fromkeys(self._units[name]))
                return Values(self._qvel[:, where], unit=unit)
            case "joint_turn":
                turns = self._qpos[:, self._turning] - start[self._turning]
                columns = [np.stack([np.sin(turns), np.cos(turns)], axis=2).reshape(len(turns), -1)]
                for first in self._balling:
                    columns.append(geometry.rotation_matrix(self._qpos[:, first : first + 4]))
                return Values(np.concatenate(columns, axis=1), -1.0, 1.0, "sin, cos")
            case "base_linvel":
                return Values(np.einsum("nij,ni->nj", self._axes, self.velocity), unit="m/s")
            case "base_angvel":
                return Values(np.einsum("nij,ni->nj", self._axes, self._spin), unit="rad/s")
            case "gravity":
                return Values(-self._axes[:, 2], -1.0, 1.0, "direction")
        return Values(self._last, unit="action")

    def described(self, name: str) -> dict[str, Any]:
        """The quantity that an observation measures, for the loop around a policy.

        :return: ``sensor``, ``on`` and ``axes``; of joints ``joints``, ``first_pose``, qpos that
            positions are relative to, rad or m, and ``unit`` of each number where these differ
        """
        model = self.sim.model
        if name not in self._senses:
            return sensors.described(model, self._prefix + name, self._prefix)
        if name not in self._numbers:
            return {"axes": self.root.removeprefix(self._prefix)} if name != "last_action" else {}
        names = [model.joint(i).name.removeprefix(self._prefix) for i, _ in self._numbers[name]]
        joints: dict[str, list[Any]] = {"joints": names}
        if len(set(self._units[name])) > 1 and name != "joint_turn":
            joints["unit"] = self._units[name]
        if name == "joint_vel" or (name == "joint_turn" and self._balling):
            return joints  # a ball's rotation is as it is
        return joints | {"first_pose": self._start["qpos"][self._where[name]].tolist()}

"""A robot from anybody's MJCF file: what the file does not say of it is worked out from the file.

:class:`MJCFRobot` reads files that were written for it, this one a file as its maker wrote it.
:func:`sb3_guard.envs.registry.register_robot` lists what may be stated, and
:mod:`sb3_guard.envs.robots.model_file` finds the robot in the file. Besides the file's sensors it
observes what they do not cover:

* ``joint_pos``: positions of slides and of hinges with a range, relative to the first pose, rad, m;
* ``joint_turn``: of hinges without a range (sin θ, cos θ), of balls the rotation matrix;
* ``joint_vel``: velocities of these joints;
* ``base_linvel``, ``base_angvel``: velocities of the outermost body in its frame;
* ``gravity``: which way is down in that frame;
* ``last_action``.

Joints of the outermost body say where the robot is and are in none of these.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.observation import Observations, Values
from sb3_guard.envs.part import Simulation
from sb3_guard.envs.robots.model_file import BALL, FREE, HINGE, SLIDE, ModelFile
from sb3_guard.envs.robots.robot import PREFIX, MJCFRobot
from sb3_guard.envs.types import Array, Generators
from sb3_guard.spelling import did_you_mean

_SENSOR = mujoco.mjtSensor
# sensors on the outermost body that are observed in place of what is computed
_COVERING = {
    "base_linvel": (_SENSOR.mjSENS_VELOCIMETER, _SENSOR.mjSENS_FRAMELINVEL),
    "base_angvel": (_SENSOR.mjSENS_GYRO, _SENSOR.mjSENS_FRAMEANGVEL),
    "gravity": (_SENSOR.mjSENS_FRAMEQUAT, _SENSOR.mjSENS_FRAMEZAXIS),
}
# controls that are the servo's target itself, not its rate
_DYN = mujoco.mjtDyn
_DIRECT = [int(kind) for kind in (_DYN.mjDYN_NONE, _DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT)]
_OF_JOINTS = {
    "pos": (_SENSOR.mjSENS_JOINTPOS, _SENSOR.mjSENS_BALLQUAT),
    "vel": (_SENSOR.mjSENS_JOINTVEL, _SENSOR.mjSENS_BALLANGVEL),
}


@dataclass
class FileRobot(MJCFRobot):
    """A robot that was taken out of a file."""

    file: ClassVar[ModelFile]
    tip: ClassVar[str | None] = None  # the site whose place is the robot's position
    action: ClassVar[str] = "range"
    action_scale: ClassVar[float] = 0.25  # rad or m, of actions that are offsets from the pose
    observe: ClassVar[tuple[str, ...] | None] = None  # names; None: sensors and what they lack

    def read(self) -> mujoco.MjSpec:
        return self.file.spec.copy()

    def first_pose(self, model: mujoco.MjModel) -> Array:
        return self.file.pose(model, self._prefix)

    @property
    def _prefix(self) -> str:
        return "" if self.complete else PREFIX

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        model, batch = sim.model, sim.batch
        pose = mujoco.MjData(model)
        pose.qpos[:] = self._start
        mujoco.mj_forward(model, pose)
        if self.tip is not None:
            site = model.site(self._prefix + self.tip).id
            self._position = batch.bind("site_xpos")[:, site]
            self.altitude = float(pose.site_xpos[site, 2])
        servos = self._servos(model)
        # the length of an actuator is what its servo compares the control with
        low, high = model.actuator_ctrlrange.T
        self._hold = np.where(servos, np.clip(pose.actuator_length, low, high), 0.0)
        if self.action == "offset":
            for i in np.flatnonzero(~servos).tolist():
                raise ValueError(
                    "action = 'offset' needs position servos, and actuator "
                    f"{model.actuator(i).name.removeprefix(self._prefix)!r} is none: use "
                    "action='range'"
                )
            self._center = pose.actuator_length.copy()
            self._half = np.full(model.nu, float(self.action_scale))
        self._last = sim.array("robot/last_action", (model.nu,))
        self._qvel = batch.bind("qvel")
        root = model.body(self.root).id
        self._axes = self._xmat[:, root]  # [N, 3, 3], body to world
        self._spin = batch.bind("cvel")[:, root, :3]
        self._wanted = self._choose(model)
        self._unit_of = {
            name: ", ".join(dict.fromkeys(self._units(name))) for name in ("joint_pos", "joint_vel")
        }
        if not self.file.base:
            self._bind_links(model)

    @staticmethod
    def _servos(model: mujoco.MjModel) -> Array:
        """Whether each actuator is a position servo, whose control is its target, [nu] bool."""
        gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1]
        servos: Array = (gain > 0) & (bias == -gain) & np.isin(model.actuator_dyntype, _DIRECT)
        return servos

    def _choose(self, model: mujoco.MjModel) -> tuple[str, ...]:
        """The names of what is observed; notes where the joints' numbers are.

        :raises ValueError: a name is none that can be observed
        """
        sensors = [name for name, _, _ in self._sensors]
        covered = self.observe is None
        seen = {key: self._sensed(model, kinds) if covered else set()
                for key, kinds in _OF_JOINTS.items()}  # fmt: skip
        posing = [model.joint(self._prefix + name) for name in self.file.posing]
        self._places: list[int] = []
        self._hinged: list[int] = []
        self._round: list[int] = []
        self._speeds: list[int] = []
        for joint in posing:
            kind, first = joint.type[0], int(joint.qposadr[0])
            if joint.id not in seen["pos"]:
                swings = kind == SLIDE or model.jnt_limited[joint.id]
                places = self._places if swings else self._hinged
                (self._round if kind == BALL else places).append(first)
            if joint.id not in seen["vel"]:
                first = int(joint.dofadr[0])
                self._speeds += range(first, first + (3 if kind == BALL else 1))
        computed = [*self._computed(model, covered)]
        names = [*sensors, *(name for name in computed if name not in sensors)]
        for name in self.observe or ():
            if name not in names:
                raise ValueError(
                    f"observe names no observation {name!r}: {did_you_mean(name, names)}"
                )
        return tuple(names if self.observe is None else self.observe)

    def _computed(self, model: mujoco.MjModel, covered: bool) -> Iterator[str]:
        """Names of what can be observed without a sensor, unless one covers it."""
        root = model.body(self.root).id
        on_root = [] if not covered else [
            kind for name, kind, _ in self._sensors
            if root in self._bodies_of(model, model.sensor(self._prefix + name).id)
        ]  # fmt: skip
        base = [model.joint(self._prefix + joint.name) for joint in self.file.base]
        tilts = any(
            j.type[0] in (FREE, BALL) or (j.type[0] == HINGE and abs(j.axis[2]) < 1) for j in base
        )
        for name, kinds in _COVERING.items():
            exists = tilts if name == "gravity" else bool(base)
            if exists and not any(kind in kinds for kind in on_root):
                yield name
        if self._places:
            yield "joint_pos"
        if self._hinged or self._round:
            yield "joint_turn"
        if self._speeds:
            yield "joint_vel"
        yield "last_action"

    def _sensed(self, model: mujoco.MjModel, kinds: tuple[mujoco.mjtSensor, ...]) -> set[int]:
        """The joints that observed sensors of these kinds are on."""
        return {
            int(model.sensor_objid[model.sensor(self._prefix + name).id])
            for name, kind, _ in self._sensors
            if kind in kinds
        }

    @staticmethod
    def _bodies_of(model: mujoco.MjModel, sensor: int) -> set[int]:
        """The bodies that a sensor is on or relates something to."""
        bodies = set()
        for kind, i in (
            (model.sensor_objtype[sensor], int(model.sensor_objid[sensor])),
            (model.sensor_reftype[sensor], int(model.sensor_refid[sensor])),
        ):
            if kind in (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY):
                bodies.add(i)
            elif kind == mujoco.mjtObj.mjOBJ_SITE:
                bodies.add(int(model.site_bodyid[i]))
        return bodies

    def _bind_links(self, model: mujoco.MjModel) -> None:
        """Note the capsules around an arm's geoms, from which its clearance is measured."""
        meets = (model.geom_contype | model.geom_conaffinity) != 0
        geoms = np.flatnonzero(np.isin(model.geom_bodyid, self.bodies(model)) & meets)
        middle, half = model.geom_aabb[geoms, :3], model.geom_aabb[geoms, 3:]
        longest = half.argmax(axis=1)
        rows = np.arange(len(geoms))
        radii = np.sort(half, axis=1)[:, 1]
        ends = np.zeros_like(half)
        ends[rows, longest] = half[rows, longest] - radii
        self._links, self._radii = geoms, radii[:, None, None]
        self._ends = middle - ends, middle + ends  # [L, 3] m each, in the geoms' frames

    def clearance(self, points: Array, planar: bool) -> Array:
        """Distance of points from the robot's position, or from an arm's nearest link, [N, K] m."""
        if self.file.base:
            return super().clearance(points, planar)
        size = 2 if planar else 3
        batch = self.sim.batch
        places = batch.bind("geom_xpos")[:, self._links]  # [N, L, 3]
        axes = batch.bind("geom_xmat")[:, self._links].reshape(*places.shape, 3)
        start, end = (
            geometry.by_coordinate(places + np.einsum("nlij,lj->nli", axes, e))[:size]
            for e in self._ends
        )
        gap = geometry.segment_distance(start, end, geometry.by_coordinate(points)[:size])
        nearest: Array = (gap - self._radii).min(axis=0).T.copy()  # of [L, K, N]
        return nearest

    def reset(self, ids: Array, rngs: Generators) -> None:
        super().reset(ids, rngs)
        self._last[ids] = 0.0
        self._ctrl[ids] = self._hold  # until the first action, servos keep the pose

    def act(self, actions: Array) -> None:
        self._last[:] = actions
        super().act(actions)

    def observations(self) -> Observations:
        out: dict[str, Any] = dict(super().observations())
        for name in self._wanted:
            if name not in out:
                out[name] = getattr(self, f"_{name}")()
        return {name: out[name] for name in self._wanted}

    def joints_of(self, name: str) -> dict[str, list[Any]]:
        """The joints of a computed observation in its order, for the loop around a policy.

        :param name: of the observation
        :return: ``joints``, of positions ``first_pose``, qpos that they are relative to, rad or m,
            and of hinges with slides ``unit``, that of each number; empty of other observations
        """
        first = {"joint_pos": self._places, "joint_turn": [*self._hinged, *self._round]}
        if name not in (*first, "joint_vel") or name in {sensor for sensor, _, _ in self._sensors}:
            return {}
        model, ids = self.sim.model, self._joints(name)
        joints = {"joints": [model.joint(i).name.removeprefix(self._prefix) for i in ids]}
        units = self._units(name)
        if len(set(units)) > 1:
            joints["unit"] = units
        # a ball's rotation is as it is
        relative = name in first and not (name == "joint_turn" and self._round)
        return joints | ({"first_pose": self._start[first[name]].tolist()} if relative else {})

    def _joints(self, name: str) -> list[int]:
        """The joint of each number of ``joint_pos`` or ``joint_vel``; those of ``joint_turn``."""
        model = self.sim.model
        if name == "joint_vel":
            return [int(model.dof_jntid[dof]) for dof in self._speeds]
        first = self._places if name == "joint_pos" else [*self._hinged, *self._round]
        return [model.jnt_qposadr.tolist().index(place) for place in first]

    def _units(self, name: str) -> list[str]:
        """Of each number of ``joint_pos`` or ``joint_vel``."""
        if name == "joint_turn":
            return []
        slides = [self.sim.model.jnt_type[joint] == SLIDE for joint in self._joints(name)]
        over = "/s" if name == "joint_vel" else ""
        return [("m" if slide else "rad") + over for slide in slides]

    def _joint_pos(self) -> Values:
        positions = self._qpos[:, self._places] - self._start[self._places]
        return Values(positions, unit=self._unit_of["joint_pos"])

    def _joint_turn(self) -> Values:
        turns = self._qpos[:, self._hinged] - self._start[self._hinged]
        columns = [np.stack([np.sin(turns), np.cos(turns)], axis=2).reshape(len(turns), -1)]
        for first in self._round:
            columns.append(geometry.rotation_matrix(self._qpos[:, first : first + 4]))
        return Values(np.concatenate(columns, axis=1), -1.0, 1.0, "sin, cos")

    def _joint_vel(self) -> Values:
        return Values(self._qvel[:, self._speeds], unit=self._unit_of["joint_vel"])

    def _base_linvel(self) -> Values:
        return Values(np.einsum("nij,ni->nj", self._axes, self.velocity), unit="m/s")

    def _base_angvel(self) -> Values:
        return Values(np.einsum("nij,ni->nj", self._axes, self._spin), unit="rad/s")

    def _gravity(self) -> Values:
        return Values(-self._axes[:, 2], -1.0, 1.0, "direction")

    def _last_action(self) -> Values:
        return Values(self._last, unit="action")

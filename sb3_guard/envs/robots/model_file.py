"""A robot that was taken out of an MJCF file, as its maker wrote it: :func:`settle`."""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sb3_guard.envs.robots import mjcf
from sb3_guard.envs.robots.measure import lowest
from sb3_guard.envs.types import FLOOR, ROBOT, Array
from sb3_guard.fields import did_you_mean

FREE, BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
SHIFT = 2  # a robot's own contact bits begin after ROBOT and FLOOR
SUNK = 0.05  # share of a robot's extent by which a keyframe may have it in the floor
NEAR = 1e-6  # m: geoms whose height is fixed meet the floor if they are as near
CONTACT = (  # a floor's share in its contacts
    "condim", "priority", "friction", "solmix", "solref", "solimp", "margin", "gap", "adhesion",
    "surfacevel",
)  # fmt: skip
_NAMES = ("name", "geomname1", "geomname2", "objname", "refname")
STATE = ("qpos", "qvel", "act", "ctrl", "mocap_pos", "mocap_quat")  # what a keyframe holds
_PLANE, _HFIELD = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD
_PLAIN = (  # types of attributes that are copied from one element to another
    int, float, str, np.ndarray, mujoco.mjtSensor, mujoco.mjtObj, mujoco.mjtDataType,
    mujoco.mjtStage,
)  # fmt: skip
_DYN = mujoco.mjtDyn
# controls that are the servo's target itself, not its rate
_DIRECT = [int(kind) for kind in (_DYN.mjDYN_NONE, _DYN.mjDYN_FILTER, _DYN.mjDYN_FILTEREXACT)]
STOP = "stop"  # the keyframe whose controls stop the robot where it is deployed
SERVOS = "docs/robot_files.md adds servos in three lines of MjSpec"


@dataclass(frozen=True)
class ModelFile:
    """A robot that was taken out of a file.

    :param label: what to call the file in messages
    :param spec: the robot alone, without lights and keyframes; of a whole world, all of it
    :param root: name of its outermost body
    :param start: fields of MjData when an episode begins, by name, as the robot alone has them
    :param left_out: what of the file is not in ``spec``, in words
    :param floors: the geoms that it stood on, in whose place is the arena's floor: attributes
    :param on_floor: pairs and sensors that refer to them: kind and attributes
    :param stop: the controls of the keyframe ``stop``, by actuator; empty: there is none
    """

    label: str
    spec: mujoco.MjSpec
    root: str
    start: Mapping[str, Array]
    left_out: tuple[str, ...] = ()
    floors: tuple[Mapping[str, Any], ...] = ()
    on_floor: tuple[tuple[str, Mapping[str, Any]], ...] = ()
    stop: Mapping[str, float] = field(default_factory=dict)

    @property
    def base(self) -> list[mujoco.MjsJoint]:
        """The joints that move the outermost body; none if it is fixed."""
        return list(self.spec.body(self.root).joints)

    @property
    def posing(self) -> list[str]:
        """The robot's joints but those of the outermost body."""
        base = {joint.name for joint in self.base}
        joints = self.spec.body(self.root).find_all("joint")
        return [joint.name for joint in joints if joint.name not in base]

    def standing(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """The robot alone, as it stands when an episode begins."""
        model = self.spec.compile()
        data = mujoco.MjData(model)
        for name, values in self.start.items():
            getattr(data, name)[:] = values
        mujoco.mj_forward(model, data)
        return model, data

    def paired(self, model: mujoco.MjModel) -> Array:
        """Whether each geom meets a floor of the file by a pair, [ngeom] bool."""
        pairs = [values for kind, values in self.on_floor if kind == "pair"]
        names = {values[end] for values in pairs for end in ("geomname1", "geomname2")}
        return np.array([model.geom(i).name in names for i in range(model.ngeom)], dtype=bool)

    def meeting(self, model: mujoco.MjModel) -> Array:
        """Whether each geom's contact bits let it meet the floor, [ngeom] bool.

        As in the file, if it has a floor; else a geom that meets anything does.
        """
        meets = (model.geom_contype | model.geom_conaffinity) != 0
        if self.floors:
            meets &= np.logical_or.reduce([
                (model.geom_contype & floor["conaffinity"])
                | (model.geom_conaffinity & floor["contype"])
                for floor in self.floors
            ])  # fmt: skip
        return meets

    def enter(self, world: mujoco.MjSpec, prefix: str, floor: bool, spawn: str) -> None:
        """Put the robot into a world; the world's floor has the part that the file's had.

        :param world: whose options become the file's
        :param prefix: of the robot's names in the world
        :param floor: whether it meets the floor at all
        :param spawn: name of the mocap body that carries a robot which is not free
        :raises ValueError: it would fall for ever
        """
        spec = self.spec.copy()
        mjcf.copy_options(spec.option, world.option)
        mjcf.agree(spec, world)
        self._set_contact_bits(spec, floor)
        free = [joint.type for joint in spec.body(self.root).joints][:1] == [FREE]
        place = world.worldbody if free else world.worldbody.add_body(name=spawn, mocap=True)
        world.attach(spec, prefix=prefix, frame=place.add_frame())
        if not floor or not self.floors:
            return
        ours = world.geom("floor")
        for name in CONTACT:
            setattr(ours, name, self.floors[0][name])
        floors = {values["name"] for values in self.floors}
        for kind, values in self.on_floor:
            names = {
                key: "floor" if value in floors else prefix + value
                for key, value in values.items()
                if key in _NAMES and value
            }
            getattr(world, f"add_{kind}")(**{**values, **names})

    def _set_contact_bits(self, spec: mujoco.MjSpec, floor: bool) -> None:
        """Let a robot's geoms meet a world's objects, and its floor where they can come near it.

        The bits of the file keep saying which of its geoms meet each other. A geom without bits
        meets nothing, but by pairs. The floor is left out by geoms that slide at a fixed height
        above it: each pair of a planar robot with the floor costs time.

        :raises ValueError: the robot would fall for ever
        """
        model, data = self.standing()
        low = lowest(model, data) - model.geom_margin
        meets = self.meeting(model) & (mjcf.rising(model, data) | (low <= NEAR)) & floor
        for geom in spec.geoms:
            if not geom.contype and not geom.conaffinity:
                continue
            if max(geom.contype, geom.conaffinity) >= 1 << (31 - SHIFT):
                raise ValueError(
                    f"{self.label}: contact bits of geom {geom.name!r} must be below 2^29"
                )
            geom.contype <<= SHIFT
            bits = ROBOT | (FLOOR if meets[geom.id] else 0)
            geom.conaffinity = geom.conaffinity << SHIFT | bits
        supported = meets | (self.paired(model) & floor)
        if FREE in model.jnt_type and not supported.any():
            raise ValueError(
                f"{self.label} has a free joint, but no geom that meets the floor: it would fall "
                'forever; give one contype="1" conaffinity="1", or the robot other joints'
            )


def settle(
    source: Path | mujoco.MjSpec,
    root: str | None = None,
    complete: bool = False,
    grounded: bool = True,
    keyframe: str | None = None,
    as_written: bool = False,
) -> ModelFile:
    """Take the robot out of a file.

    :param source: MJCF file, or an MjSpec, which is not changed
    :param root: its outermost body; None: the only one with joints
    :param complete: whether the world around the robot is kept
    :param grounded: whether a robot on a free joint is put on the floor, unless a keyframe has it
        higher
    :param keyframe: in which it begins; None: ``start``, ``home`` or the only one beside ``stop``,
        if there is one
    :param as_written: whether the file was written for our worlds: it begins as the file says, even
        out of a joint's range or above the floor, and with controls of 0
    :raises ValueError: there is no such robot in the file, in one line
    """
    spec, label = mjcf.load(source), mjcf.label_of(source)
    _name_all(spec)
    root = _find_root(spec, label, root)
    if not spec.actuators:
        raise ValueError(f"{label} has no actuators: {SERVOS}")
    key = _keyframe(spec, label, keyframe)
    before = mujoco.MjData(whole := spec.compile())
    if key is not None:
        mujoco.mj_resetDataKeyframe(whole, before, whole.key(key).id)
    elif not as_written:
        _into_ranges(spec, root, whole, before)
    left_out = tuple(f"keyframe {k.name}" for k in spec.keys if k.name not in (key, STOP))
    names = [actuator.name for actuator in spec.actuators]
    stops = [whole.key(frame.name).ctrl.tolist() for frame in spec.keys if frame.name == STOP]
    stop = dict(zip(names, stops[0], strict=True)) if stops else {}
    for frame in spec.keys:
        spec.delete(frame)
    spec.nkey = 0  # MuJoCo would fill up to it
    floors: tuple[Mapping[str, Any], ...] = ()
    on_floor: tuple[tuple[str, Mapping[str, Any]], ...] = ()
    height = 0.0
    if not complete:
        mujoco.mj_kinematics(whole, before)
        found = _floors(spec, whole, before, root)
        height = min((float(before.geom_xpos[geom.id, 2]) for geom in found), default=0.0)
        floors = tuple(_attributes(geom) for geom in found)
        on_floor = tuple(_on_floor(spec, root, {values["name"] for values in floors}))
        alone = _alone(spec, root, whole)
        kept = _elements(alone) | {
            f"pair {v['geomname1']} {v['geomname2']}" if kind == "pair" else f"sensor {v['name']}"
            for kind, v in on_floor
        }
        left_out += _left_out(spec, root, kept)
        spec = alone
    model = spec.compile()
    data = _carried(whole, before, model)
    file = ModelFile(label, spec, root, {}, left_out, floors, on_floor)
    free = bool(file.base) and int(file.base[0].type) == FREE
    place = data.joint(file.base[0].name).qpos[2:3] if free else spec.body(root).pos[2:3]
    place -= height
    if grounded and free and not (complete or as_written):
        mujoco.mj_kinematics(model, data)
        touching = file.meeting(model) | file.paired(model)
        if touching.any():
            low = float(lowest(model, data)[touching].min())
            # a keyframe may hold it higher, or as deep as soft contacts let it sink
            if key is None or low < -SUNK * model.stat.extent:
                place -= low
    if key is None and not as_written:
        _hold(model, data)
    start = {name: getattr(data, name).copy() for name in STATE}
    return ModelFile(label, spec, root, start, left_out, floors, on_floor, stop)


def servos(model: mujoco.MjModel) -> Array:
    """Whether each actuator is a position servo, whose control is its target, [nu] bool."""
    targets: Array = _targets(model) & np.isin(model.actuator_dyntype, _DIRECT)
    return targets


def holding(model: mujoco.MjModel) -> Array:
    """Whether the robot stays where it is while each actuator keeps its control, [nu] bool.

    These are servos of a position, filtered ones and those with other units of control (the gripper
    of a Panda) included; motors, velocity servos and those whose control is a rate stop at 0.
    """
    affine = model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    pulls = affine & (model.actuator_biasprm[:, 1] != 0)
    kept: Array = pulls & np.isin(model.actuator_dyntype, _DIRECT)
    return kept


def _targets(model: mujoco.MjModel) -> Array:
    """Whether each actuator pulls towards a length: its control or its activation, [nu] bool."""
    gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1]
    pulls: Array = (gain > 0) & (bias == -gain)
    return pulls


def _hold(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Let position servos hold the robot as it is, by their controls and activations."""
    mujoco.mj_forward(model, data)
    direct, lengths = servos(model), data.actuator_length  # what a servo compares its target with
    limited = np.clip(lengths, *model.actuator_ctrlrange.T)
    targets = np.where(direct & (model.actuator_ctrllimited != 0), limited, lengths)
    data.ctrl[:] = np.where(direct, targets, 0.0)
    for i in np.flatnonzero(_targets(model) & (model.actuator_actnum == 1)).tolist():
        low, high = model.actuator_actrange[i]
        held = np.clip(targets[i], low, high) if model.actuator_actlimited[i] else targets[i]
        data.act[model.actuator_actadr[i]] = held


def _carried(old: mujoco.MjModel, before: mujoco.MjData, model: mujoco.MjModel) -> mujoco.MjData:
    """The state of what is left in a model, by the names of joints and actuators."""
    data = mujoco.MjData(model)
    if (old.nq, old.nu, old.nmocap) == (model.nq, model.nu, model.nmocap):
        for name in STATE:
            getattr(data, name)[:] = getattr(before, name)
        return data
    for i in range(model.njnt):
        joint, former = data.joint(i), before.joint(model.joint(i).name)
        joint.qpos, joint.qvel = former.qpos, former.qvel
    for i in range(model.nu):
        name, count = model.actuator(i).name, int(model.actuator_actnum[i])
        data.ctrl[i] = before.actuator(name).ctrl[0]
        first, at = int(model.actuator_actadr[i]), int(old.actuator_actadr[old.actuator(name).id])
        if count:
            data.act[first : first + count] = before.act[at : at + count]
    return data


def _name_all(spec: mujoco.MjSpec) -> None:
    """Give names to outermost bodies, joints and actuators without."""
    for kind, elements in (
        ("body", spec.worldbody.bodies),
        ("joint", spec.joints),
        ("actuator", spec.actuators),
    ):
        taken = {element.name for element in elements}
        for i, element in enumerate(elements):
            if not element.name:
                name = getattr(element, "target", "") or f"{kind}_{i}"
                element.name = name if name not in taken else f"{name}_{i}"
                taken.add(element.name)


def _find_root(spec: mujoco.MjSpec, label: str, root: str | None) -> str:
    """The robot's outermost body.

    :raises ValueError: there is none, or several
    """
    outer = [body.name for body in spec.worldbody.bodies]
    moved = [b.name for b in spec.worldbody.bodies if not b.mocap and b.find_all("joint")]
    if root is not None:
        if root in outer:
            return root
        if spec.body(root) is None:
            raise ValueError(f"{label} has no body {root!r}: {did_you_mean(root, outer)}")
        raise ValueError(f"{label}: body {root!r} is not an outermost one: root may be {outer}")
    if "robot" in outer or len(moved) == 1:
        return "robot" if "robot" in outer else moved[0]
    if not moved:
        raise ValueError(f"{label} has no body with joints: a robot needs joints to move by")
    moved.sort(key=lambda name: -len(spec.body(name).find_all("joint")))
    raise ValueError(
        f"{label} has {len(moved)} outermost bodies with joints, {', '.join(map(repr, moved))}: "
        f"say which is the robot, root={moved[0]!r}"
    )


def _keyframe(spec: mujoco.MjSpec, label: str, keyframe: str | None) -> str | None:
    """The name of the keyframe in which the robot begins.

    :raises ValueError: there is no such keyframe
    """
    for i, key in enumerate(spec.keys):
        key.name = key.name or f"keyframe_{i}"
    names = [key.name for key in spec.keys]
    if keyframe is not None and keyframe not in names:
        raise ValueError(f"{label} has no keyframe {keyframe!r}: {did_you_mean(keyframe, names)}")
    usual = [name for name in ("start", "home") if name in names]
    only = [name for name in names if name != STOP]
    only = only if len(only) == 1 else []
    return keyframe or next(iter([*usual, *only]), None)


def _into_ranges(
    spec: mujoco.MjSpec, root: str, model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    """Put joints that are out of their ranges into their middles."""
    for joint in spec.body(root).find_all("joint"):
        limited = model.joint(joint.name)
        if int(joint.type) in (HINGE, SLIDE) and model.jnt_limited[limited.id]:
            low, high = limited.range
            at = data.joint(joint.name).qpos
            if not low <= at[0] <= high:
                at[0] = (low + high) / 2


def _floors(
    spec: mujoco.MjSpec, model: mujoco.MjModel, data: mujoco.MjData, root: str
) -> list[mujoco.MjsGeom]:
    """What the robot stands on in its file: level planes and height fields that do not move."""
    own = {geom.id for geom in spec.body(root).find_all("geom")}
    floors = []
    for geom in spec.geoms:
        still = model.body_weldid[model.geom_bodyid[geom.id]] == 0
        level = data.geom_xmat[geom.id, 8] > math.cos(0.1)
        if geom.type in (_PLANE, _HFIELD) and still and level and geom.id not in own:
            geom.name = geom.name or f"floor_{geom.id}"
            floors.append(geom)
    return floors


def _on_floor(
    spec: mujoco.MjSpec, root: str, floors: Collection[str]
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Pairs and sensors of the robot with what it stands on: kind and attributes."""
    kinds, body = mujoco.mjtObj, spec.body(root)
    bodies = {root, *(other.name for other in body.find_all("body"))}
    own = {
        kinds.mjOBJ_GEOM: {geom.name for geom in body.find_all("geom")},
        kinds.mjOBJ_SITE: {site.name for site in body.find_all("site")},
        kinds.mjOBJ_BODY: bodies,
        kinds.mjOBJ_XBODY: bodies,
        kinds.mjOBJ_UNKNOWN: {""},
    }
    for pair in spec.pairs:
        names = {pair.geomname1, pair.geomname2}
        if names & set(floors) and names & own[kinds.mjOBJ_GEOM]:
            yield "pair", _attributes(pair)
    for sensor in spec.sensors:
        ends = [(sensor.objtype, sensor.objname), (sensor.reftype, sensor.refname)]
        others = [end for end in ends if end[0] != kinds.mjOBJ_GEOM or end[1] not in floors]
        if len(others) == 1 and others[0][1] in own.get(others[0][0], ()):
            yield "sensor", _attributes(sensor)


def _attributes(element: Any) -> dict[str, Any]:
    """The attributes of an element of an MjSpec, with which another like it is made."""
    values = {name: getattr(element, name) for name in dir(element) if not name.startswith("_")}
    return {
        name: np.copy(value) if isinstance(value, np.ndarray) else value
        for name, value in values.items()
        if isinstance(value, _PLAIN) and name not in ("id", "info", "signature")
    }


def _alone(spec: mujoco.MjSpec, root: str, whole: mujoco.MjModel) -> mujoco.MjSpec:
    """The robot without its world: floor, lights and others belong to the arena."""
    alone = mujoco.MjSpec()
    mjcf.copy_options(spec.option, alone.option)
    copied = spec.copy()
    for light in copied.lights:
        copied.delete(light)
    # MuJoCo drops what refers to bodies, geoms, sites or tendons that stay behind, and warns of
    # names without a prefix, which only matter where several robots meet
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    body = alone.worldbody.add_frame().attach_body(copied.body(root), "", "")
    mujoco.set_mju_user_warning(handler)
    if spec.body(root).frame is not None:  # which stays behind, too
        body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        body.pos, body.quat = whole.body(root).pos, whole.body(root).quat
    body.pos[:2] = 0.0  # the layout says where it is
    return alone.copy()  # which does not repeat the warning when it compiles


def _left_out(spec: mujoco.MjSpec, root: str, kept: Collection[str]) -> tuple[str, ...]:
    """What of a file is not in the robot, in words."""
    world = spec.worldbody
    others = [f"body {body.name}" for body in world.bodies if body.name != root]
    for kind, things in (("geom", world.geoms), ("site", world.sites), ("camera", world.cameras)):
        others += [f"{kind} {thing.name}".strip() for thing in things]
    return (*others, *sorted(_elements(spec) - set(kept)))


def _elements(spec: mujoco.MjSpec) -> set[str]:
    """What refers to bodies, in words."""
    kinds = {
        "actuator": spec.actuators, "sensor": spec.sensors, "equality": spec.equalities,
        "tendon": spec.tendons,
    }  # fmt: skip
    pairs = {f"pair {pair.geomname1} {pair.geomname2}" for pair in spec.pairs}
    return pairs | {f"{kind} {element.name}" for kind, of in kinds.items() for element in of}

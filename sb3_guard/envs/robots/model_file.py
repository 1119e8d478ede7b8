"""A robot's MJCF file as its maker wrote it: the robot in it, how it stands, what moves it.

:func:`settle` takes the robot out of its world, gives its joints servos where the file has no
actuators, and says in which pose an episode begins.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import mujoco

from sb3_guard.envs.robots import mjcf
from sb3_guard.envs.robots.measure import lowest
from sb3_guard.envs.robots.references import drop_references
from sb3_guard.envs.types import Array
from sb3_guard.spelling import did_you_mean, matching

FREE, BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
ROUNDED = 1e-3  # rad or m by which a keyframe may be out of a joint's range
GAINS = {"kp": 35, "kd": 1}  # of the examples in messages, N m / rad and N m s / rad


class NoActuators(ValueError):
    """Nothing in a file moves the robot, and no gains were given."""


@dataclass(frozen=True)
class ModelFile:
    """A robot that was taken out of a file.

    :param path: the file
    :param spec: the robot alone, without lights and keyframes; of a whole world, all of it
    :param root: name of its outermost body
    :param start: qpos of each joint, by name, when an episode begins
    :param left_out: what of the file is not in ``spec``, in words
    """

    path: Path
    spec: mujoco.MjSpec
    root: str
    start: Mapping[str, Array]
    left_out: tuple[str, ...]

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

    def pose(self, model: mujoco.MjModel, prefix: str = "") -> Array:
        """qpos of a model with this robot when an episode begins, [nq].

        :param prefix: of the names of its joints in the model
        """
        qpos: Array = model.qpos0.copy()
        for name, values in self.start.items():
            first = int(model.jnt_qposadr[model.joint(prefix + name).id])
            qpos[first : first + len(values)] = values
        return qpos

    def standing(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """The robot alone, as it stands when an episode begins."""
        model = self.spec.compile()
        data = mujoco.MjData(model)
        data.qpos[:] = self.pose(model)
        mujoco.mj_forward(model, data)
        return model, data


def settle(
    path: Path,
    root: str | None = None,
    complete: bool = False,
    grounded: bool = True,
    keyframe: str | None = None,
    pose: Mapping[str, float] | None = None,
    actuators: Mapping[str, Any] | None = None,
) -> ModelFile:
    """Make a robot of a file that knows nothing of our worlds.

    :param path: MJCF file
    :param root: its outermost body; None: the only one with joints
    :param complete: whether the world around the robot is kept
    :param grounded: whether a robot on a free joint is put on the floor, unless a keyframe has it
        higher
    :param keyframe: in which it begins; None: ``start``, ``home`` or the only one, if there is one
    :param pose: positions of hinges and slides, rad and m, by names or patterns of joints
    :param actuators: gains ``{"kp": N m / rad, "kd": N m s / rad, "force": N m}`` of position
        servos, or a mapping of joints' names or patterns to such gains; ``force`` may be left out
    :raises ValueError: there is no such robot in the file, in one line
    """
    if path.suffix == ".urdf" or re.search(r"<robot\b", path.read_text(errors="replace")):
        raise ValueError(
            f"{path} is URDF, not MJCF: convert it once with mujoco.MjSpec.from_file({path.name!r})"
            ".to_file('robot.xml'), and give its outermost body <freejoint/> if it can go anywhere"
        )
    spec = mjcf.load(path)
    _name_all(spec)
    root = _find_root(spec, path, root)
    if actuators is None:
        _check_commanded(spec, path, root)
    key = _keyframe(spec, path, keyframe)
    model, names = spec.compile(), [joint.name for joint in spec.body(root).find_all("joint")]
    limits = _limits(model, names)
    start = _start(model, names, limits, path, key, {} if pose is None else pose)
    left_out = tuple(f"keyframe {frame.name}" for frame in spec.keys if frame.name != key)
    for frame in spec.keys:
        spec.delete(frame)
    spec.nkey = 0  # MuJoCo would fill up to it
    left_out += () if complete else _take_out(spec, path, root)
    if complete:
        for i in range(model.njnt):
            joint = model.joint(i)
            start.setdefault(joint.name, _slice(model, i, _qpos(model, key)))
    if actuators is not None:
        _add_servos(spec, path, limits, start, actuators)
    file = ModelFile(path, spec, root, start, left_out)
    base = file.base
    if grounded and not complete and base and int(base[0].type) == FREE:
        height = lowest(*file.standing())  # a keyframe may hold it above the floor, not in it
        start[base[0].name][2] -= height if key is None else min(height, 0.0)
    return file


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


def _find_root(spec: mujoco.MjSpec, path: Path, root: str | None) -> str:
    """The robot's outermost body.

    :raises ValueError: there is none, or several
    """
    outer = [body.name for body in spec.worldbody.bodies]
    moved = [b.name for b in spec.worldbody.bodies if not b.mocap and b.find_all("joint")]
    if root is not None:
        if root in outer:
            return root
        if spec.body(root) is None:
            raise ValueError(f"{path} has no body {root!r}: {did_you_mean(root, outer)}")
        raise ValueError(f"{path}: body {root!r} is not an outermost one: root may be {outer}")
    if "robot" in outer or len(moved) == 1:
        return "robot" if "robot" in outer else moved[0]
    if not moved:
        raise ValueError(f"{path} has no body with joints: a robot needs joints to move by")
    moved.sort(key=lambda name: -len(spec.body(name).find_all("joint")))
    raise ValueError(
        f"{path} has {len(moved)} outermost bodies with joints, {', '.join(map(repr, moved))}: say "
        f"which is the robot, root={moved[0]!r}"
    )


def _check_commanded(spec: mujoco.MjSpec, path: Path, root: str) -> None:
    """
    :raises ValueError: nothing acts on the robot, or a mocap body does
    """
    names = {body.name for body in spec.body(root).find_all("body")} | {root}
    mocap = {body.name for body in spec.bodies if body.mocap}
    servos = f"give its joints position servos, actuators={GAINS}"
    for weld in spec.equalities:
        ends = {weld.name1, weld.name2}
        if weld.type == mujoco.mjtEq.mjEQ_WELD and ends & mocap and ends & names:
            raise ValueError(
                f"{path} moves the robot by a weld to mocap body {(ends & mocap).pop()!r}, which "
                f"no action commands: take the weld out and {servos}"
            )
    if not spec.actuators:
        raise NoActuators(f"{path} has no actuators: {servos}")


def _keyframe(spec: mujoco.MjSpec, path: Path, keyframe: str | None) -> str | None:
    """The name of the keyframe in which the robot begins.

    :raises ValueError: there is no such keyframe
    """
    for i, key in enumerate(spec.keys):
        key.name = key.name or f"keyframe_{i}"
    names = [key.name for key in spec.keys]
    if keyframe is not None and keyframe not in names:
        hint = did_you_mean(keyframe, names) if names else "it has none; pose={...} sets joints"
        raise ValueError(f"{path} has no keyframe {keyframe!r}: {hint}")
    usual = [name for name in ("start", "home") if name in names]
    only = names if len(names) == 1 else []
    return keyframe or next(iter([*usual, *only]), None)


def _qpos(model: mujoco.MjModel, key: str | None) -> Array:
    qpos: Array = model.qpos0 if key is None else model.key(key).qpos
    return qpos


def _slice(model: mujoco.MjModel, joint: int, qpos: Array) -> Array:
    """A joint's numbers in qpos, a copy."""
    size = {FREE: 7, BALL: 4}.get(int(model.jnt_type[joint]), 1)
    first = int(model.jnt_qposadr[joint])
    return qpos[first : first + size].copy()


def _limits(model: mujoco.MjModel, names: list[str]) -> dict[str, tuple[float, float]]:
    """Least and greatest position of each hinge and slide, rad or m."""
    limits = {}
    for joint in map(model.joint, names):
        if joint.type[0] in (HINGE, SLIDE):
            low, high = joint.range if model.jnt_limited[joint.id] else (-math.inf, math.inf)
            limits[joint.name] = float(low), float(high)
    return limits


def _start(
    model: mujoco.MjModel,
    names: list[str],
    limits: Mapping[str, tuple[float, float]],
    path: Path,
    key: str | None,
    pose: Mapping[str, float],
) -> dict[str, Array]:
    """qpos of the robot's joints when an episode begins.

    :raises ValueError: the pose names no joint, or it or the keyframe is out of a joint's range
    """
    start = {name: _slice(model, model.joint(name).id, _qpos(model, key)) for name in names}
    for name, (low, high) in limits.items() if key is None else ():
        if not low <= start[name][0] <= high:
            start[name][0] = (low + high) / 2
    if not isinstance(pose, Mapping):
        raise ValueError(f"pose = {pose!r} must be a mapping of joints to rad or m")
    for pattern, value in pose.items():
        if isinstance(value, bool) or not isinstance(value, Real):
            raise ValueError(f"pose[{pattern!r}] = {value!r} must be a number, rad or m")
        for name in matching(f"pose of {path.name}", pattern, limits):
            low, high = limits[name]
            if not low <= value <= high:
                raise ValueError(
                    f"pose[{pattern!r}] = {value!r} is out of the range of joint {name!r}: allowed "
                    f"are {low:g} to {high:g}"
                )
            start[name][0] = value
    for name, (low, high) in limits.items():
        if not low - ROUNDED <= start[name][0] <= high + ROUNDED:
            raise ValueError(
                f"keyframe {key!r} of {path} puts joint {name!r} at {start[name][0]:g}, out of its "
                f"range, {low:g} to {high:g}: set it with pose={{{name!r}: ...}}"
            )
    return start


def _take_out(spec: mujoco.MjSpec, path: Path, root: str) -> tuple[str, ...]:
    """Leave nothing but the robot in a file: floor, lights and others belong to the arena.

    :return: what was left out, in words
    """

    def names() -> set[str]:
        kinds: dict[str, Any] = {
            "actuator": spec.actuators, "sensor": spec.sensors, "equality": spec.equalities,
            "tendon": spec.tendons,
        }  # fmt: skip
        return {f"{kind} {element.name}" for kind, of in kinds.items() for element in of}

    before, world, left_out = names(), spec.worldbody, []
    drop_references(spec)
    for body in world.bodies:
        if body.name != root:
            left_out.append(f"body {body.name}")
            spec.delete(body)
    for kind, elements in (("geom", world.geoms), ("site", world.sites), ("camera", world.cameras)):
        for element in elements:
            left_out.append(f"{kind} {element.name}".strip())
            spec.delete(element)
    for light in spec.lights:
        spec.delete(light)
    body = spec.body(root)
    body.pos[:2] = 0.0  # the layout says where it is
    try:
        spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path} needs more than body {root!r}: {reason}") from None
    return (*left_out, *sorted(before - names()))


def _add_servos(
    spec: mujoco.MjSpec,
    path: Path,
    limits: Mapping[str, tuple[float, float]],
    start: Mapping[str, Array],
    gains: Mapping[str, Any],
) -> None:
    """Give joints position servos.

    :param limits: of the robot's hinges and slides
    :raises ValueError: no such joint, or no such gains
    """
    if spec.actuators:
        raise ValueError(
            f"{path} has {len(spec.actuators)} actuators of its own: leave out actuators={{...}}"
        )
    if not isinstance(gains, Mapping) or not gains:
        raise ValueError(f"actuators = {gains!r} must be gains such as {GAINS}")
    if not limits:
        raise ValueError(f"{path} has no hinges or slides, which position servos need")
    common = any(key in gains for key in ("kp", "kd", "force"))
    chosen: dict[str, Mapping[str, float]] = {}
    for pattern, values in ({"*": gains} if common else gains).items():
        label = "actuators" if common else f"actuators[{pattern!r}]"
        _check_gains(label, values)
        for name in matching(f"actuators of {path.name}", pattern, limits):
            chosen[name] = values
    for name in limits:  # in the order of the joints
        if name in chosen:
            _add_servo(spec, name, limits[name], float(start[name][0]), chosen[name])


def _check_gains(label: str, gains: Any) -> None:
    """
    :raises ValueError: they are no gains
    """
    if not isinstance(gains, Mapping):
        raise ValueError(f"{label} = {gains!r} must be gains such as {GAINS}")
    for key in gains:
        if key not in ("kp", "kd", "force"):
            hint = did_you_mean(key, ["kp", "kd", "force"])
            raise ValueError(f"{label} has no gain {key!r}: {hint}")
    for key in ("kp", "kd"):
        if key not in gains:
            raise ValueError(f"{label} = {dict(gains)!r} lacks {key!r}: gains are {GAINS}")
    for key, value in gains.items():
        real = isinstance(value, Real) and not isinstance(value, bool)
        if not real or not 0 <= value < math.inf or (value == 0 and key != "kd"):
            least = "at least 0" if key == "kd" else "greater than 0"
            raise ValueError(f"{label}[{key!r}] = {value!r} must be a number {least}")


def _add_servo(
    spec: mujoco.MjSpec,
    name: str,
    limits: tuple[float, float],
    rest: float,
    gains: Mapping[str, float],
) -> None:
    """A position servo within the joint's range; half a turn either way of a hinge without."""
    low, high = limits
    if low == -math.inf:
        if int(spec.joint(name).type) == SLIDE:
            raise ValueError(
                f"slide {name!r} has no range, which a position servo needs: give it one, or name "
                "the joints that have servos, actuators={'...': {...}}"
            )
        low, high = rest - math.pi, rest + math.pi
    servo = spec.add_actuator(
        name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, ctrlrange=[low, high]
    )
    servo.set_to_position(kp=gains["kp"], kv=gains["kd"])
    servo.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
    if "force" in gains:
        servo.forcerange = [-gains["force"], gains["force"]]
        servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE

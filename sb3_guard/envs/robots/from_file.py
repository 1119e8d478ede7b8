"""The class of a robot that is made of a file and what its user states of it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from sb3_guard.envs.parameters import param
from sb3_guard.envs.robots.arm import FileArm
from sb3_guard.envs.robots.measure import chain, radius, reached
from sb3_guard.envs.robots.model_file import ModelFile, settle
from sb3_guard.envs.robots.robot import PREFIX, MJCFRobot
from sb3_guard.envs.types import Array
from sb3_guard.fields import did_you_mean, fit

OF_FILE = ("root", "complete", "keyframe")  # what settle() is told
#: What a user may state: what holds if it is not stated, what it is, and what it may be, see
#: :func:`~sb3_guard.fields.fit`.
ATTRIBUTES: dict[str, tuple[str, str, tuple[Any, ...]]] = {
    "root": ("the only one with joints", "the robot's outermost body", (str | None,)),
    "complete": ("False", "True: the file's world is kept: its floor, options and names are used, "
        "and the robot begins where the file puts it", (bool,)),
    "keyframe": ("start, home or the only one", "the keyframe in which it starts", (str | None,)),
    "center": ("the outermost body", "the body or site whose place is the robot's position: of an "
        "arm, its end effector", (str | None,)),
    "reach": ("infinite; of an arm, measured", "how far an arm reaches from its first joint, m; "
        "goals are drawn within", (float, 0)),
    "keepout": ("what covers the robot", "radius kept clear around it at the start, m",
        (float, 0, math.inf, "[)")),
    "defaults": ("for arms, sizes that suit their reach; for large robots, a larger arena",
        'parameters of tasks, constraints and arena with this robot: {"goal": {"size": 0.05}}',
        (dict[str, dict[str, Any]],)),
    "workspace": ('"planar"; of an arm "spatial"', '"spatial" for robots that leave the plane: '
        "tasks and constraints are then in the air", (Literal["planar", "spatial"],)),
    "lidar_bodies": ("the body of center", "bodies that carry lidar and compass", (list[str],)),
    "timestep": ("the file's", "of one physics step, s", (float | None, 0)),
    "integrator": ("the file's", '"Euler", "RK4", "implicit" or "implicitfast"',
        (Literal["Euler", "RK4", "implicit", "implicitfast"] | None,)),
    "frame_skip": ("10", "physics steps in a control step", (int, 1, 1000, "[]")),
}  # fmt: skip


def robot_class(
    name: str, source: Path | mujoco.MjSpec, stated: Mapping[str, Any]
) -> type[MJCFRobot]:
    """A robot from an MJCF file or an MjSpec; what is not stated follows from it.

    :param name: of the class
    :param source: the file, or the MjSpec
    :param stated: attributes, by name
    :raises ValueError: an attribute is unknown or bad, or the file has no such robot
    """
    for key, value in stated.items():
        if key not in ATTRIBUTES:
            raise ValueError(f"robot {name!r} has no {key!r}: {did_you_mean(key, ATTRIBUTES)}")
        fit(f"robot {name!r}: {key}", value, *ATTRIBUTES[key][2])
    grounded = stated.get("workspace", "planar") == "planar"
    file = settle(
        source, grounded=grounded, **{key: stated[key] for key in OF_FILE if key in stated}
    )
    model, data = file.standing()
    complete = stated.get("complete", False)
    prefix = "" if complete else PREFIX
    center = stated.get("center") or file.root
    body, tip = _center(model, file, center)
    size = radius(model, data, file.root)
    attributes: dict[str, Any] = {
        "__doc__": f"The robot of {Path(file.label).name}.",
        "path": classmethod(lambda cls: Path(file.label)),
        "model_file": classmethod(lambda cls: file),
        "aware": True,
        "lidar_bodies": (body,),
        "eye": (prefix + body, (0.0, 0.0, 0.1), (1.0, 0.0, 0.0)),
        "keepout": math.ceil(100 * size) / 100,
        "defaults": {"arena": {"size": max(2.0, round(5 * size, 1))}},
    }
    arm = not file.base and not complete
    if arm:
        shoulder = data.xanchor[chain(model, model.body(body).id)[0]]
        places = reached(model, body, tip)
        attributes |= _arm(f"{file.label}: {center!r}", places, shoulder, stated.get("reach"))
    defaults = {key: {**params} for key, params in attributes["defaults"].items()}
    for key, params in stated.get("defaults", {}).items():
        defaults[key] = {**defaults.get(key, {}), **params}
    attributes |= {k: v for k, v in stated.items() if k not in OF_FILE or k == "complete"}
    attributes |= {"root": prefix + file.root, "center": body, "tip": tip, "defaults": defaults}
    keepout = param(
        attributes["keepout"], "radius kept clear around the robot at the start, m", low=0
    )
    attributes |= {"keepout": keepout, "__annotations__": {"keepout": float}}
    return dataclass(type(name, (FileArm if arm else MJCFRobot,), attributes))


def _center(model: mujoco.MjModel, file: ModelFile, center: str) -> tuple[str, str | None]:
    """The body at the robot's position, and the site on it if it is a site.

    :raises ValueError: there is none of this name, or it cannot move
    """
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    sites = [model.site(i).name for i in range(model.nsite)]
    names = [name for name in (*bodies, *sites) if name]
    if center not in names:
        raise ValueError(
            f"center names no body or site {center!r} of {Path(file.label).name}: "
            f"{did_you_mean(center, names)}"
        )
    tip = None if center in bodies else center
    body = model.body(center).id if tip is None else int(model.site(center).bodyid[0])
    if model.body_weldid[body] == 0:
        places = {n: int(model.site(n).bodyid[0]) for n in sites if n}
        places |= {n: model.body(n).id for n in bodies[::-1] if n}
        end = max(places, key=lambda name: len(chain(model, places[name])))
        raise ValueError(
            f"{file.label} stands on a fixed base, and {center!r}, whose place is the robot's "
            f"position, cannot move: name its end effector, a body or site, center={end!r}"
        )
    return str(model.body(body).name), tip


def _arm(end: str, places: Array, shoulder: Array, reach: float | None) -> dict[str, Any]:
    """Attributes by an arm's first joint and the places of its end effector, [n, 3] m.

    :param reach: None: measured
    :raises ValueError: its end effector, ``end``, is never above the floor
    """
    away = np.linalg.norm(places - shoulder, axis=1)
    reach = reach or float(max(0.9 * away.max(), np.median(away)))  # all alike: of one joint
    places = places[(away <= reach) & (places[:, 2] >= 0.001)]
    if not len(places):
        raise ValueError(
            f"{end} is never above the floor, z = 0, within reach={reach:.3g} m: raise its "
            "outermost body by pos, or name another end effector, center="
        )
    low, high = np.quantile(places[:, 2], [0.2, 0.8]).tolist()
    size = round(0.1 * reach, 3)
    near = {"size": size, "keepout": size, "height": [round(low, 3), round(high, 3)]}
    return {
        "workspace": "spatial",
        "reach": round(reach, 3),
        "shoulder": shoulder.round(3),
        "places": places,
        "keepout": size,
        "defaults": dict.fromkeys(FileArm.near, near),
    }

"""What refers to the world of a robot's file: it has no meaning where the robot is alone."""

from collections.abc import Callable, Sequence
from typing import Any

import mujoco

_KINDS, _SITES = mujoco.mjtObj, (mujoco.mjtWrap.mjWRAP_SITE,)
Ends = set[tuple[Any, str]]  # kinds and names of what an element refers to


def drop_references(spec: mujoco.MjSpec) -> None:
    """Delete what refers to geoms, sites and cameras of the world, as MuJoCo does for bodies.

    Actuators, sensors and equalities of a tendon that is deleted go with it.
    """
    world = spec.worldbody
    gone: Ends = {(_KINDS.mjOBJ_GEOM, geom.name) for geom in world.geoms}
    gone |= {(_KINDS.mjOBJ_SITE, site.name) for site in world.sites}
    gone |= {(_KINDS.mjOBJ_CAMERA, camera.name) for camera in world.cameras}
    # tendons and actuators come before what refers to them
    order: list[tuple[Sequence[Any], Callable[[Any], Ends], Any]] = [
        (spec.tendons, _of_tendon, _KINDS.mjOBJ_TENDON),
        (spec.actuators, _of_actuator, _KINDS.mjOBJ_ACTUATOR),
        (spec.sensors, _of_sensor, _KINDS.mjOBJ_SENSOR),
        (spec.pairs, _of_pair, _KINDS.mjOBJ_UNKNOWN),
        (spec.equalities, _of_equality, _KINDS.mjOBJ_EQUALITY),
    ]
    for elements, ends_of, kind in order:
        for element in elements:
            if any(end in gone for end in ends_of(element) if end[1]):
                gone.add((kind, element.name))
                spec.delete(element)


def _of_tendon(tendon: mujoco.MjsTendon) -> Ends:
    wraps = [wrap for wrap in tendon.path if wrap.target is not None]
    return {
        (_KINDS.mjOBJ_SITE if wrap.type in _SITES else _KINDS.mjOBJ_GEOM, wrap.target.name)
        for wrap in wraps
    } | {(_KINDS.mjOBJ_SITE, wrap.sidesite.name) for wrap in wraps if wrap.sidesite is not None}


def _of_actuator(actuator: mujoco.MjsActuator) -> Ends:
    if actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON:
        return {(_KINDS.mjOBJ_TENDON, actuator.target)}
    on_sites = mujoco.mjtTrn.mjTRN_SITE, mujoco.mjtTrn.mjTRN_SLIDERCRANK
    names = [actuator.refsite, actuator.slidersite]
    names += [actuator.target] if actuator.trntype in on_sites else []
    return {(_KINDS.mjOBJ_SITE, name) for name in names}


def _of_sensor(sensor: mujoco.MjsSensor) -> Ends:
    return {(sensor.objtype, sensor.objname), (sensor.reftype, sensor.refname)}


def _of_pair(pair: mujoco.MjsPair) -> Ends:
    return {(_KINDS.mjOBJ_GEOM, name) for name in (pair.geomname1, pair.geomname2)}


def _of_equality(equality: mujoco.MjsEquality) -> Ends:
    tendons = equality.type == mujoco.mjtEq.mjEQ_TENDON
    kind = _KINDS.mjOBJ_TENDON if tendons else equality.objtype
    return {(kind, name) for name in (equality.name1, equality.name2)}

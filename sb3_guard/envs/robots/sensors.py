"""Bounds and units of sensors, by type and by what they are on."""

import math

import mujoco

_SENSOR = mujoco.mjtSensor
_UNITS = {
    _SENSOR.mjSENS_TOUCH: "N",
    _SENSOR.mjSENS_ACCELEROMETER: "m/s²",
    _SENSOR.mjSENS_VELOCIMETER: "m/s",
    _SENSOR.mjSENS_GYRO: "rad/s",
    _SENSOR.mjSENS_FORCE: "N",
    _SENSOR.mjSENS_TORQUE: "N·m",
    _SENSOR.mjSENS_MAGNETOMETER: "T",
    _SENSOR.mjSENS_RANGEFINDER: "m",
    _SENSOR.mjSENS_BALLANGVEL: "rad/s",
    _SENSOR.mjSENS_FRAMEPOS: "m",
    _SENSOR.mjSENS_FRAMEQUAT: "quaternion (w, x, y, z)",
    _SENSOR.mjSENS_FRAMEXAXIS: "direction",
    _SENSOR.mjSENS_FRAMEYAXIS: "direction",
    _SENSOR.mjSENS_FRAMEZAXIS: "direction",
    _SENSOR.mjSENS_FRAMELINVEL: "m/s",
    _SENSOR.mjSENS_FRAMEANGVEL: "rad/s",
    _SENSOR.mjSENS_FRAMELINACC: "m/s²",
    _SENSOR.mjSENS_FRAMEANGACC: "rad/s²",
    _SENSOR.mjSENS_SUBTREECOM: "m",
    _SENSOR.mjSENS_SUBTREELINVEL: "m/s",
    _SENSOR.mjSENS_SUBTREEANGMOM: "kg·m²/s",
    _SENSOR.mjSENS_GEOMDIST: "m",
    _SENSOR.mjSENS_CLOCK: "s",
}
# of a hinge, of a slide
_OF_JOINTS = {
    _SENSOR.mjSENS_JOINTPOS: ("rad", "m"),
    _SENSOR.mjSENS_JOINTVEL: ("rad/s", "m/s"),
    _SENSOR.mjSENS_JOINTACTFRC: ("N·m", "N"),
}


def _on_slide(model: mujoco.MjModel, sensor: int) -> bool:
    return bool(model.jnt_type[model.sensor_objid[sensor]] == mujoco.mjtJoint.mjJNT_SLIDE)


def is_angle(model: mujoco.MjModel, name: str) -> bool:
    """Whether a sensor gives the position of a hinge, not of a slide, nor anything else."""
    sensor = model.sensor(name).id
    is_position = model.sensor_type[sensor] == _SENSOR.mjSENS_JOINTPOS
    return bool(is_position and not _on_slide(model, sensor))


def bounds(model: mujoco.MjModel, name: str) -> tuple[float, float, str]:
    """Least and greatest value of a sensor and their unit; "" if it depends on the mechanism."""
    sensor = model.sensor(name).id
    kind = _SENSOR(int(model.sensor_type[sensor]))
    if kind in _OF_JOINTS:
        unit = _OF_JOINTS[kind][_on_slide(model, sensor)]
    else:
        unit = _UNITS.get(kind, "")
    return 0.0 if kind == _SENSOR.mjSENS_TOUCH else -math.inf, math.inf, unit


def described(model: mujoco.MjModel, name: str, prefix: str) -> dict[str, str]:
    """Type of a sensor, what it is on, and along whose axes it measures, by these names."""
    if (i := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)) < 0:
        return {}
    it = model.sensor(i)
    on, axes = (
        (mujoco.mj_id2name(model, kind[0], number[0]) or "world").removeprefix(prefix)
        for kind, number in ((it.objtype, it.objid), (it.reftype, it.refid))
    )
    kind = _SENSOR(int(model.sensor_type[i])).name[7:].lower()
    return {"sensor": kind, "on": on, "axes": axes if kind[:5] in ("frame", "subtr") else on}


def bodies(model: mujoco.MjModel, sensor: int) -> set[int]:
    """The bodies that a sensor is on or relates something to."""
    found = set()
    for kind, i in (
        (model.sensor_objtype[sensor], int(model.sensor_objid[sensor])),
        (model.sensor_reftype[sensor], int(model.sensor_refid[sensor])),
    ):
        if kind in (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY):
            found.add(i)
        elif kind == mujoco.mjtObj.mjOBJ_SITE:
            found.add(int(model.site_bodyid[i]))
    return found

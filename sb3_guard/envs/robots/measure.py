"""How large a robot is, how low it stands and how far it reaches, from its compiled file."""

import math

import mujoco
import numpy as np

from sb3_guard.envs.types import Array

SAMPLES = 2000  # random poses of an arm, from which its reach is measured


def radius(model: mujoco.MjModel, data: mujoco.MjData, root: str) -> float:
    """Of the upright cylinder around body ``root`` that the robot is in, m."""
    solid = model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
    away = data.geom_xpos[solid, :2] - data.body(root).xpos[:2]
    return float((np.hypot(*away.T) + model.geom_rbound[solid]).max(initial=0.0))


def reached(model: mujoco.MjModel, body: str, site: str | None) -> Array:
    """Where an arm's end effector, a body or a site on it, is in random poses, [SAMPLES, 3] m."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    low, high = np.where(model.jnt_limited, model.jnt_range.T, [[-math.pi], [math.pi]])
    single = np.isin(model.jnt_type, [mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE])
    where = model.jnt_qposadr[single]
    address, start = model.jnt_qposadr, model.qpos0
    places = np.empty((SAMPLES, 3))
    for place in places:
        data.qpos[where] = rng.uniform(low, high)[single]
        for i in np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & model.eq_active0):
            joint, other = address[model.eq_obj1id[i]], address[model.eq_obj2id[i]]
            away = (data.qpos[other] - start[other]) * (model.eq_obj2id[i] >= 0)
            data.qpos[joint] = start[joint] + np.polyval(model.eq_data[i, 4::-1], away)
        mujoco.mj_kinematics(model, data)
        place[:] = data.body(body).xpos if site is None else data.site(site).xpos
    return places


def chain(model: mujoco.MjModel, body: int) -> list[int]:
    """The joints that move a body, the first one first."""
    joints: list[int] = []
    while body:
        first = model.body_jntadr[body]
        joints = [*range(first, first + model.body_jntnum[body]), *joints]
        body = model.body_parentid[body]
    return joints


def lowest(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Height of each geom's lowest point, [ngeom] m."""
    kinds, heights = mujoco.mjtGeom, np.empty(model.ngeom)
    for i in range(model.ngeom):
        up, size = data.geom_xmat[i].reshape(3, 3)[2], model.geom_size[i]
        match int(model.geom_type[i]):
            case kinds.mjGEOM_SPHERE:
                sunk = size[0]
            case kinds.mjGEOM_CAPSULE:
                sunk = size[0] + size[1] * abs(up[2])
            case kinds.mjGEOM_CYLINDER:
                sunk = size[0] * math.hypot(up[0], up[1]) + size[1] * abs(up[2])
            case kinds.mjGEOM_ELLIPSOID:
                sunk = float(np.linalg.norm(up * size))
            case kinds.mjGEOM_MESH:
                mesh = int(model.geom_dataid[i])
                first = int(model.mesh_vertadr[mesh])
                points = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
                sunk = -float((points * up).sum(axis=1).min())
            case _:
                sunk = float(np.abs(up) @ size)
        heights[i] = data.geom_xpos[i, 2] - sunk
    return heights

"""A robot's MJCF file on its way into a world: read, looked over, given its contact bits."""

from pathlib import Path

import mujoco
import numpy as np

from sb3_guard.envs.types import FLOOR, ROBOT

SHIFT = 2  # a robot's own contact bits begin after ROBOT and FLOOR
NEAR = 1e-6  # m: geoms whose height is fixed meet the floor if they are as near
_PLANE = mujoco.mjtGeom.mjGEOM_PLANE
_FREE, _SLIDE = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_SLIDE


def load(path: Path) -> mujoco.MjSpec:
    """An MJCF file that compiles: attach() silently drops what refers to something missing.

    :raises ValueError: it cannot be read, or is URDF
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if spec.compiler.settotalmass > 0:
            _state_masses(spec)
        spec.compile()
    except ValueError as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from None
    shapes = (*spec.meshes, *spec.hfields, *spec.skins)
    for asset in (*shapes, *spec.textures):  # a world forgets the folder of a file it takes in
        if asset.file:
            folder = spec.texturedir if isinstance(asset, mujoco.MjsTexture) else spec.meshdir
            asset.file = str(path.parent.resolve() / folder / asset.file)
    return spec


def read(path: Path, root: str, complete: bool) -> mujoco.MjSpec:
    """A robot's file.

    :param root: name of the robot's outermost body
    :param complete: whether the file is a whole world
    :raises ValueError: it cannot be read, has no such body, or has a floor that it must not have
    """
    spec = load(path)
    if spec.body(root) is None:
        raise ValueError(f"{path} has no body called {root!r}: give its outermost body this name")
    floors = [geom.name for geom in spec.worldbody.geoms if geom.type == _PLANE]
    if floors and not complete:
        raise ValueError(
            f"{path} has a floor, geom {floors[0]!r}, and the arena has one: remove it, or keep "
            f"the file's own world with complete=True, root={root!r}"
        )
    return spec


def _state_masses(spec: mujoco.MjSpec) -> None:
    """Write the masses that ``settotalmass`` asks for into the bodies: MuJoCo is to drop it."""
    total, spec.compiler.settotalmass = spec.compiler.settotalmass, -1.0
    model = spec.compile()
    mujoco.mj_setTotalmass(model, total)
    for body in spec.bodies[1:]:
        body.explicitinertial = True
        body.mass, body.inertia = model.body_mass[body.id], model.body_inertia[body.id]
        body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE


def honour_options(option: mujoco.MjOption, world: mujoco.MjOption) -> None:
    """Set in ``world`` what the ``<option>`` of a file sets to something else than its default."""
    usual = mujoco.MjSpec().option
    for name in dir(usual):
        value = getattr(usual, name)
        if not name.startswith("_") and not callable(value):
            own = getattr(option, name)
            if not np.array_equal(own, value):
                setattr(world, name, own)


def agree(spec: mujoco.MjSpec, world: mujoco.MjSpec) -> None:
    """State the sizes and looks that a world states: it keeps its own, and MuJoCo would warn."""
    for name in dir(world):
        if name.startswith(("nuser", "njmax", "nconmax", "memory")):
            setattr(spec, name, getattr(world, name))
    for group in ("global_", "quality", "headlight", "map", "scale", "rgba"):
        ours, theirs = getattr(world.visual, group), getattr(spec.visual, group)
        for name in dir(ours):
            if not name.startswith("_"):
                setattr(theirs, name, getattr(ours, name))


def set_contact_bits(spec: mujoco.MjSpec, floor: bool, label: str) -> None:
    """Let a robot's geoms meet the objects of a world, and its floor where they can come near it.

    The bits of the file keep saying which of its geoms meet each other. A geom without bits meets
    nothing. The floor is left out by geoms that slide at a fixed height above it: each pair of a
    planar robot with the floor costs time.

    :param spec: the robot
    :param floor: whether it meets the floor at all
    :param label: what to call the robot in messages
    :raises ValueError: the robot would fall forever
    """
    model = spec.compile()
    data = mujoco.MjData(model)
    if model.nkey:
        data.qpos[:] = model.key_qpos[0]
    mujoco.mj_kinematics(model, data)
    low = _lowest(model, data)
    supported = False
    for i, geom in enumerate(sorted(spec.geoms, key=lambda g: g.id)):
        if not geom.contype and not geom.conaffinity:
            continue
        meets = floor and (_rises(model, data, int(model.geom_bodyid[i])) or low[i] <= NEAR)
        supported |= meets
        if max(geom.contype, geom.conaffinity) >= 1 << (31 - SHIFT):
            raise ValueError(f"{label}: contact bits of geom {geom.name!r} must be below 2^29")
        geom.contype <<= SHIFT
        geom.conaffinity = geom.conaffinity << SHIFT | ROBOT | (FLOOR if meets else 0)
    if not supported and _FREE in model.jnt_type:
        raise ValueError(
            f"{label} has a free joint, but no geom that meets the floor: it would fall forever; "
            'give one contype="1" conaffinity="1", or the robot other joints'
        )


def _lowest(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Height of each geom's lowest point, with its margin, or less, [ngeom] m."""
    rotation = data.geom_xmat.reshape(-1, 3, 3)
    middle = np.einsum("gij,gj->gi", rotation, model.geom_aabb[:, :3]) + data.geom_xpos
    sunk = np.einsum("gj,gj->g", np.abs(rotation[:, 2]), model.geom_aabb[:, 3:])
    round_ones = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    sunk[round_ones] = model.geom_size[round_ones, 0]
    lowest: np.ndarray = middle[:, 2] - sunk - model.geom_margin
    return lowest


def _rises(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> bool:
    """Whether a joint may change the height of a body's points."""
    while body:
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            level = abs(data.xaxis[joint, 2])
            kind = model.jnt_type[joint]
            if kind == _SLIDE and level > 1e-9:
                return True
            if kind != _SLIDE and (kind != mujoco.mjtJoint.mjJNT_HINGE or level < 1 - 1e-9):
                return True
        body = int(model.body_parentid[body])
    return False

"""Reading an MJCF file, and what a world takes over from it: options, contact bits."""

from pathlib import Path

import mujoco
import numpy as np

from sb3_guard.envs.types import Array

_FREE, _SLIDE = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_SLIDE


def label_of(source: Path | mujoco.MjSpec) -> str:
    """What to call a file, or an MjSpec, in messages."""
    return str(source) if isinstance(source, Path) else f"MjSpec {source.modelname!r}"


def load(source: Path | mujoco.MjSpec) -> mujoco.MjSpec:
    """A file, or a copy of an MjSpec, that compiles: attach() drops what refers to nothing.

    :raises ValueError: it cannot be read, or is URDF
    """
    label = label_of(source)
    try:
        if isinstance(source, Path):
            if source.suffix == ".urdf" or "<robot" in source.read_text(errors="replace"):
                raise ValueError(
                    "it is URDF, not MJCF: convert it once with mujoco.MjSpec.from_file("
                    f"{source.name!r}).to_file('robot.xml'), and give its outermost body "
                    "<freejoint/> if it can go anywhere"
                )
            spec = mujoco.MjSpec.from_file(str(source))
        else:
            spec = source.copy()
        if spec.compiler.settotalmass > 0:
            _state_masses(spec)
        _state_paths(spec, spec.compile())
    except ValueError as error:
        raise ValueError(f"{label}: {' '.join(str(error).split())}") from None
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


def _state_paths(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Write out where MuJoCo found the files: a world strips no paths and is written elsewhere."""
    if spec.strippath:
        for texture in spec.textures:
            texture.cubefiles = [Path(name).name for name in texture.cubefiles]
    for assets, addresses in (
        (spec.meshes, model.mesh_pathadr),
        (spec.hfields, model.hfield_pathadr),
        (spec.textures, model.tex_pathadr),
        (spec.skins, model.skin_pathadr),
    ):
        for asset in assets:
            first = int(addresses[asset.id]) if 0 <= asset.id < len(addresses) else -1
            path = model.paths[first:].partition(b"\0")[0].decode() if first >= 0 else ""
            if asset.file and Path(path).name == Path(asset.file).name:
                asset.file = path
    spec.strippath = False


def copy_options(option: mujoco.MjOption, world: mujoco.MjOption) -> None:
    """Set every ``<option>`` of a world to what a file compiles with."""
    for name in dir(option):
        if not name.startswith("_") and not callable(getattr(option, name)):
            setattr(world, name, getattr(option, name))


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


def rising(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Whether a joint may change the height of each geom, [ngeom] bool."""
    level = np.abs(data.xaxis[:, 2])
    slides = model.jnt_type == _SLIDE
    upright = slides | (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    lifts = np.where(slides, level > 1e-9, ~upright | (level < 1 - 1e-9))
    rises = np.zeros(model.nbody, dtype=bool)
    for body in range(1, model.nbody):  # parents come before their children
        joints = lifts[model.jnt_bodyid == body]
        rises[body] = rises[model.body_parentid[body]] or joints.any()
    risen: Array = rises[model.geom_bodyid]
    return risen

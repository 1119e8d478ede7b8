"""Pictures of one simulation: its bodies, and what is not a body drawn over them.

Zones, goals, lidar halos and the tint of a cost are not in the physics model. They are added to the
abstract scene of each frame, so that drawing costs nothing when nobody looks and never changes the
physics: a frame is made from a copy of one row's state.
"""

from __future__ import annotations

import functools
import importlib
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from sb3_guard.envs.layout import ARENA

if TYPE_CHECKING:
    from sb3_guard.envs.engine import Engine
    from sb3_guard.envs.part import Robot

Array = np.ndarray
CAMERAS = ("fixed", "track", "top")
COST_COLOR = (1.0, 0.1, 0.1)
HALO, HALO_STEP = 0.15, 0.06  # m, radius of the first halo, and how much wider each other one is
BEAD = 0.02  # m, radius
_FRUSTUM = [f"frustum_{side}" for side in ("near", "far", "width", "center", "bottom", "top")]
_SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE
_CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER


class RenderingError(RuntimeError):
    """No OpenGL backend works."""


def _has_display() -> bool:
    return sys.platform != "linux" or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


def _window_opens() -> bool:
    """Whether there is a display; tried in a process of its own, which GLFW may end."""
    if not _has_display():
        return False
    probe = "import glfw, sys; sys.exit(0 if glfw.init() else 1)"
    return subprocess.run([sys.executable, "-c", probe], capture_output=True).returncode == 0


@functools.cache
def gl_backend() -> str:
    """The OpenGL backend that works: glfw, egl or osmesa.

    ``MUJOCO_GL`` decides if it is set. Each candidate is tried in a process of its own, since a
    failed GLFW followed by EGL in one process aborts Python.

    :raises RenderingError: none works
    """
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted in ("glfw", "egl", "osmesa", "cgl"):
        candidates = [wanted]
    elif sys.platform == "linux":
        candidates = ["glfw", "egl", "osmesa"] if _has_display() else ["egl", "osmesa"]
    else:
        candidates = ["glfw"]
    reasons = []
    for name in candidates:
        probe = (
            f"import mujoco, mujoco.{name} as gl; c = gl.GLContext(8, 8); c.make_current(); "
            "mujoco.MjrContext(mujoco.MjModel.from_xml_string('<mujoco/>'), 100)"
        )
        run = subprocess.run(
            [sys.executable, "-c", probe],
            env={**os.environ, "MUJOCO_GL": name},
            capture_output=True,
            text=True,
            check=False,
        )
        if run.returncode == 0:
            return name
        lines = run.stderr.strip().splitlines()
        reasons.append(f"{name} ({lines[-1] if lines else f'exit status {run.returncode}'})")
    raise RenderingError(
        f"no OpenGL backend works, tried {', '.join(reasons)}; install EGL (Debian: libegl1 "
        "and libegl-mesa0) or OSMesa (libosmesa6), or set MUJOCO_GL to one that works"
    )


class ScenePainter:
    """Adds see-through shapes to a scene, for :meth:`sb3_guard.envs.part.Part.draw`.

    :param scene: what they are added to
    :param engine: whose parts draw
    :param data: one row's state
    :param row: which row
    """

    def __init__(
        self,
        scene: mujoco.MjvScene,
        engine: Engine,
        data: mujoco.MjData,
        row: int,
    ) -> None:
        self._scene, self._engine, self._data, self._row = scene, engine, data, row
        self._halos = 0

    def zone(
        self, center: Array, radius: float, half_height: float, color: tuple[float, ...]
    ) -> None:
        """A cylinder, or a sphere if ``half_height`` is 0, at ``center``, [3] m."""
        kind = _CYLINDER if half_height else _SPHERE
        self._add(
            kind, (radius, half_height or radius, half_height or radius), center, (*color, 0.3)
        )

    @functools.cached_property
    def _first_halo(self) -> tuple[Array, Array, Array]:
        """Its centers [B, 3] m, the rotations [B, 3, 3] of the lidar bodies, its radii [B] m."""
        robot, model = self._engine.robot, self._engine.model
        origin, rotation = robot.frames
        # above robots on the floor, where it can be seen
        centers = origin[self._row] + [0.0, 0.0, 0.25 if robot.workspace == "planar" else 0.0]
        thick = _thickness(model, self._data, _geoms_below(model, robot.root), centers)
        return centers, rotation[self._row], np.maximum(HALO, thick + 1.5 * BEAD)

    def halo(self, closeness: Array, azimuth: int, color: tuple[float, ...]) -> None:
        """Beads around each lidar body, the more solid the closer what they show.

        The first halo has a radius of 15 cm, or more where the robot itself would hide it; each
        other one is 6 cm wider.

        :param closeness: [bodies · azimuth · elevation]
        :param azimuth: bins around
        :param color: red, green, blue
        """
        centers, rotations, radii = self._first_halo
        radii = radii + HALO_STEP * self._halos
        self._halos += 1
        beads = np.asarray(closeness).reshape(len(radii), azimuth, -1)
        for b, a, e in np.ndindex(*beads.shape):
            turn = (a + 0.5) * 2 * math.pi / azimuth
            rise = (e + 0.5) * math.pi / beads.shape[2] - math.pi / 2
            ray = np.array(
                [math.cos(turn) * math.cos(rise), math.sin(turn) * math.cos(rise), math.sin(rise)]
            )
            at = centers[b] + rotations[b] @ (radii[b] * ray)
            self._add(_SPHERE, (BEAD,) * 3, at, (*color, 0.08 + 0.92 * float(beads[b, a, e])))

    def glow(self, center: Array) -> None:
        """The tint of a robot that pays a cost."""
        self._add(_SPHERE, (0.25,) * 3, center, (*COST_COLOR, 0.5))

    def _add(
        self, kind: Any, size: tuple[float, ...], center: Array, rgba: tuple[float, ...]
    ) -> None:
        scene = self._scene
        if scene.ngeom >= scene.maxgeom:
            return
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom],
            kind,
            np.asarray(size, dtype=float),
            np.asarray(center, dtype=float),
            np.eye(3).reshape(-1),
            np.asarray(rgba, dtype=np.float32),
        )
        scene.ngeom += 1


class Renderer:
    """Draws rows of an engine, off screen or in MuJoCo's viewer.

    :param engine: whose rows to draw
    :param width: pixels
    :param height: pixels
    :param camera: ``"fixed"``, ``"track"`` (follows the robot) or ``"top"``, of which the first and
        the last show the arena and all placements and locations; or a camera of the model by name,
        which sees what is in the world: neither halos nor the tint of a cost
    :param mode: ``"rgb_array"`` or ``"human"``
    :raises RenderingError: no OpenGL backend works, or there is no display for ``"human"``
    """

    def __init__(
        self,
        engine: Engine,
        width: int = 480,
        height: int = 480,
        camera: str = "fixed",
        mode: str = "rgb_array",
    ) -> None:
        self._engine = engine
        self._data = mujoco.MjData(engine.model)
        self._human = mode == "human"
        self._camera = mujoco.MjvCamera()
        self._follows = camera == "track"
        self._explain = camera in CAMERAS
        self._whole = self._explain and not self._follows  # shows the whole arena
        self._center, self._scale = _arena(engine)
        if self._follows:
            self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
            self._camera.azimuth, self._camera.elevation = 90.0, -30.0
            self._geoms = _geoms_below(engine.model, engine.robot.root)
        else:
            self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
            self._camera.fixedcamid = engine.model.camera(camera).id
        if self._human:
            if not _window_opens():
                raise RenderingError(
                    f"render_mode 'human' needs a display, and none opens (DISPLAY is "
                    f"{os.environ.get('DISPLAY') or 'not set'}); use render_mode='rgb_array', or "
                    "record a video"
                )
            from mujoco import viewer

            self._viewer = viewer.launch_passive(
                engine.model, self._data, show_left_ui=False, show_right_ui=False
            )
            eye = self._viewer.cam  # the whole arena at first; the mouse moves it
            eye.lookat[:], eye.distance = self._center, 6.5 * self._scale
            eye.azimuth, eye.elevation = 90.0, -42.0
            return
        self._option = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(engine.model, maxgeom=4000)
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._pixels = np.zeros((height, width, 3), dtype=np.uint8)
        gl = importlib.import_module(f"mujoco.{gl_backend()}")
        self._gl = gl.GLContext(width, height)
        self._gl.make_current()
        visual = engine.model.vis.global_
        largest = visual.offwidth, visual.offheight
        visual.offwidth, visual.offheight = width, height  # no larger buffers than these are needed
        self._context = mujoco.MjrContext(engine.model, mujoco.mjtFontScale.mjFONTSCALE_150)
        visual.offwidth, visual.offheight = largest
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    def render(self, row: int) -> Array | None:
        """Draw one row: a frame [height, width, 3] uint8, or None when shown in a window."""
        if not self._human:
            return self.frame(row)
        self._engine.batch.get_data(row, self._data)
        with self._viewer.lock():
            self._viewer.user_scn.ngeom = 0
            self._paint(self._viewer.user_scn, row)
        self._viewer.sync()
        return None

    def frame(self, row: int) -> Array:
        """A picture of one row, [height, width, 3] uint8."""
        engine = self._engine
        engine.batch.get_data(row, self._data)
        if self._follows:
            places = self._data.geom_xpos[self._geoms]
            low, high = places.min(axis=0), places.max(axis=0)
            self._camera.lookat[:] = (low + high) / 2
            self._camera.distance = 1.6 + 1.2 * float(np.linalg.norm(high - low))
        elif self._whole:
            camera = self._camera.fixedcamid
            self._data.cam_xpos[camera] = self._center + self._scale * engine.model.cam_pos[camera]
        self._gl.make_current()
        mujoco.mjv_updateScene(
            engine.model,
            self._data,
            self._option,
            None,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )
        if self._whole:  # depth is seen as finely, for its distance, as in the default arena
            for view in self._scene.camera:
                for side in _FRUSTUM:
                    setattr(view, side, self._scale * getattr(view, side))
        self._paint(self._scene, row)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(self._pixels, None, self._rect, self._context)
        return self._pixels[::-1].copy()

    def _paint(self, scene: mujoco.MjvScene, row: int) -> None:
        painter = ScenePainter(scene, self._engine, self._data, row)
        for part in self._engine.parts:
            part.draw(painter, row)
        if not self._explain:  # halos and tint are no things in the world
            return
        for halo in self._engine.halos(row):
            painter.halo(*halo)
        if any(c.cost()[row] > 0 for c in self._engine.constraints):
            painter.glow(self._engine.robot.position[row])

    def close(self) -> None:
        """Free the window or the OpenGL context."""
        if self._human:
            self._viewer.close()
        else:
            self._gl.make_current()
            self._context.free()
            self._gl.free()


def _geoms_below(model: mujoco.MjModel, body: str) -> list[int]:
    """The geoms of a body and of all that hangs on it."""
    below = {model.body(body).id}
    for child in range(model.nbody):  # parents come before their children
        if int(model.body_parentid[child]) in below:
            below.add(child)
    return [geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) in below]


def _thickness(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: list[int], points: Array
) -> Array:
    """How thick the geoms around each point are, by the thickest; 0 where there is none, [B] m.

    :param points: [B, 3] m
    """
    rotation = data.geom_xmat[geoms].reshape(-1, 3, 3)
    offset = points[:, None] - data.geom_xpos[geoms]  # [B, G, 3]
    middle, half = model.geom_aabb[geoms, :3], model.geom_aabb[geoms, 3:]  # in the geoms' frames
    inside = np.abs(np.einsum("gij,bgi->bgj", rotation, offset) - middle) <= half
    thick: Array = np.where(inside.all(axis=2), half.min(axis=1), 0.0).max(axis=1, initial=0.0)
    return thick


def _arena(engine: Engine) -> tuple[Array, float]:
    """Middle, [3] m, and size, in default arenas, of what holds all placements and locations.

    The default arena belongs to it: movers and arms are at home at the origin.
    """
    boxes = list(ARENA)
    for footprint in engine.footprints.values():
        boxes += footprint.placements
        boxes += [(x, y, x, y) for x, y in footprint.locations]
    low, high = np.min(boxes, axis=0)[:2], np.max(boxes, axis=0)[2:]
    side = ARENA[0][2] - ARENA[0][0]
    return np.append((low + high) / 2, 0.0), float((high - low).max() / side)


def show_robot(robot: Robot) -> None:
    """Open a robot in MuJoCo's viewer, or write ``<robot>.png`` where there is no display."""
    from sb3_guard.envs.engine import Engine
    from sb3_guard.envs.tasks.goal import Goal

    engine = Engine(robot, Goal())
    engine.reset(np.zeros(1, dtype=np.int32))
    if _has_display():
        from mujoco import viewer

        viewer.launch(engine.model, engine.batch.get_data(0))
        return
    renderer = Renderer(engine, camera="track")
    path = Path(f"{type(robot).__name__.lower()}.png")
    frame = renderer.frame(0)
    from matplotlib import image

    image.imsave(path, frame)
    renderer.close()
    print(f"no display: wrote {path}")

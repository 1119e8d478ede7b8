"""Pictures of one simulation, off screen or in MuJoCo's viewer.

A frame is made from a copy of one row's state, so looking never changes the physics;
:mod:`sb3_guard.envs.scene` adds to it what is not a body.
"""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context

from sb3_guard.envs.scene import COST_COLOR, ScenePainter, arena, frame_all, has_arena, robot_geoms
from sb3_guard.envs.types import Array
from sb3_guard.errors import WorldError

if TYPE_CHECKING:
    from sb3_guard.envs.engine import Engine

CAMERAS = ("fixed", "track", "top")
ELEVATION = {"fixed": 58.0, "track": 55.0, "top": 90.0}  # degrees
RUNNING = 25.0  # degrees, elevation from which a robot is followed where there is no arena
LINE = 24  # pixels, height of a line of text


class RenderingError(WorldError, RuntimeError):
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


class Renderer:
    """Draws rows of an engine, off screen or in MuJoCo's viewer.

    :param engine: whose rows to draw
    :param width: pixels
    :param height: pixels
    :param camera: ``"fixed"``, ``"track"`` (follows the robot) or ``"top"``, of which the first and
        the last show the arena and all placements and locations; or a camera of the model by name,
        which sees what is in the world: neither lidar rings nor the tint of a cost
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
        self._explain = camera in CAMERAS
        self._follows = camera == "track"
        self._aspect = width / height
        self._line = LINE / height
        self._middle, self._half = arena(engine)
        self._has_arena = has_arena(engine)
        self._geoms = robot_geoms(engine.model, engine.robot)
        if self._explain:
            self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
            low = self._follows and not self._has_arena
            self._camera.azimuth = 90.0
            self._camera.elevation = -(RUNNING if low else ELEVATION[camera])
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
            self._open_window()
            return
        # What MUJOCO_GL says is read when MuJoCo is imported, and need not work.
        gl_context.GLContext = importlib.import_module(f"mujoco.{gl_backend()}").GLContext
        visual = engine.model.vis.global_
        largest = visual.offwidth, visual.offheight
        visual.offwidth, visual.offheight = width, height  # no larger buffers than these are needed
        self._screen = mujoco.Renderer(engine.model, height, width, max_geom=4000)
        visual.offwidth, visual.offheight = largest

    def _open_window(self) -> None:
        """Open MuJoCo's viewer, in which the mouse moves the camera."""
        from mujoco import viewer

        # Forces of contacts (F) are seen: an arrow of 1 m is the weight of all there is.
        model = self._engine.model
        shown = model.vis
        shown.map.force = model.stat.meanmass / (9.81 * model.body_mass.sum())
        shown.rgba.contactforce = [0.8, 0.1, 0.4, 1.0]
        shown.scale.forcewidth = 0.03 / model.stat.meansize
        self._paused, self._pace = False, (0.0, 0.0)
        others = set(threading.enumerate())
        self._viewer = viewer.launch_passive(
            model,
            self._data,
            key_callback=self._key,
            show_left_ui=False,
            show_right_ui=False,
        )
        self._threads = set(threading.enumerate()) - others
        self._look_at(self._viewer.cam, self._data)  # at first; the mouse moves it

    def render(self, row: int, words: Mapping[str, str] | None = None) -> Array | None:
        """Draw one row: a frame [height, width, 3] uint8, or None when shown in a window.

        A window shows it no faster than it happens, and waits while Space has paused it.

        :param words: what stands in a window's corner
        :raises KeyboardInterrupt: the window was closed
        """
        if not self._human:
            return self.frame(row)
        window = self._viewer
        words = {**(words or {}), **self._words(row)}
        self._engine.batch.get_data(row, self._data)
        with window.lock():
            window.user_scn.ngeom = 0
            self._paint(window.user_scn, row)
        window.set_texts((None, None, "\n".join(words), "\n".join(words.values())))
        window.sync()
        began, since = self._pace
        ahead = self._data.time - began - (time.monotonic() - since)  # s
        if ahead > 0:
            time.sleep(ahead)
        else:  # an episode has begun, or the machine is slow
            self._pace = self._data.time, time.monotonic()
        while self._paused and window.is_running():
            time.sleep(0.02)
        if not window.is_running():
            raise KeyboardInterrupt("the window was closed")
        return None

    def _key(self, code: int) -> None:
        if code == ord(" "):
            self._paused = not self._paused

    def frame(self, row: int) -> Array:
        """A picture of one row, [height, width, 3] uint8."""
        self._engine.batch.get_data(row, self._data)
        if self._explain:
            self._look_at(self._camera, self._data)
        self._screen.update_scene(self._data, self._camera)
        self._paint(self._screen.scene, row)
        return self._screen.render()

    def _look_at(self, camera: mujoco.MjvCamera, data: mujoco.MjData) -> None:
        """Turn a free camera to the robot, or to the whole arena and the robot near it."""
        body = data.geom_xpos[self._geoms]
        low, high = body.min(axis=0), body.max(axis=0)
        if self._follows:
            camera.lookat[:] = (low + high) / 2
            free = 2.0 if self._has_arena else 1.3  # m
            camera.distance = free + 1.2 * float(np.linalg.norm(high - low))
            return
        wide = 2.0 * self._half.max()
        corners = [
            self._middle + self._half * side for side in ((-1, -1), (-1, 1), (1, -1), (1, 1))
        ]
        near = np.clip([low, high], [*(self._middle - wide), 0.0], [*(self._middle + wide), wide])
        tall = 0.3 if self._engine.robot.workspace == "planar" else 1.5  # m
        points = [[*corner, z] for corner in corners for z in (0.0, tall)]
        fovy = float(self._engine.model.vis.global_.fovy)
        elevation = -float(camera.elevation)
        at, distance = frame_all(np.array([*points, *near]), elevation, self._aspect, fovy)
        camera.lookat[:], camera.distance = at, distance

    def _paint(self, scene: mujoco.MjvScene, row: int) -> None:
        engine = self._engine
        painter = ScenePainter(scene, engine, self._data, row)
        if self._explain and not self._human:
            painter.shadows()
        for part in engine.parts:
            part.draw(painter, row)
        if not self._explain:  # the rest is not in the world
            return
        for lidar in engine.observer.readings(row):
            painter.ring(*lidar)
        painter.heading()
        pays = any(c.cost()[row] > 0 for c in engine.constraints)
        if pays:
            painter.glow(engine.robot.position[row])
        if self._has_arena:
            painter.border(self._middle, self._half, COST_COLOR if pays else (0.45, 0.5, 0.56))
        if not self._human:
            painter.say(self._words(row), self._aspect, self._line)

    def _words(self, row: int) -> dict[str, str]:
        """What a picture says in its corner, by name."""
        return {name: text for part in self._engine.parts for name, text in part.words(row).items()}

    def close(self) -> None:
        """Free the window or the OpenGL context."""
        if self._human:
            self._viewer.close()
            for thread in self._threads:  # it must not draw while Python ends
                thread.join(timeout=5.0)
        else:
            self._screen.close()

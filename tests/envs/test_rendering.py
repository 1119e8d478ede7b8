"""Pictures show what is there, and looking changes nothing."""

import os
import threading
import time
from dataclasses import dataclass

import gymnasium
import mujoco
import numpy as np
import pytest
from robot_models import DOG, add_servos
from typed import require_rendering
from worlds import own_parts

from sb3_guard import make_vec_env
from sb3_guard.envs import (
    GuardEnv,
    GuardVectorEnv,
    env_ids,
    register_robot,
    registry,
    rendering,
)
from sb3_guard.envs import scene as scene_module
from sb3_guard.envs.constraints import Hazards
from sb3_guard.envs.engine import Engine
from sb3_guard.envs.extras import EYE, Extras
from sb3_guard.envs.robots.guard import Point
from sb3_guard.envs.tasks import Goal

BLUE, GREEN, RED = (0.0, 0.4, 0.85), (0.0, 0.65, 0.45), (0.85, 0.1, 0.1)


def amount(frame, colour):
    """How many pixels lean towards a colour: it dominates the other channels as there."""
    strong, weak = int(np.argmax(colour)), int(np.argmin(colour))
    pixels = frame.astype(int)
    return int((pixels[..., strong] - pixels[..., weak] > 60).sum())


@pytest.fixture(autouse=True, scope="module")
def _needs_opengl():
    require_rendering()


@pytest.mark.parametrize("camera", ["track", "top"])
def test_zones_and_goal_are_drawn(camera):
    env = gymnasium.make(
        "Goal_Point_8Hazards-v0", render_mode="rgb_array", camera=camera, width=200, height=150
    )
    env.reset(seed=3)
    frame = env.render()
    assert frame.shape == (150, 200, 3) and frame.dtype == np.uint8
    assert amount(frame, BLUE) > 100
    assert amount(frame, GREEN) > 50
    env.close()


def test_the_cost_is_seen_as_a_tint():
    env = GuardVectorEnv(1, "Goal_Point_1Hazards", render_mode="rgb_array", camera="track")
    env.reset(seed=0)
    calm = env.render()[0]
    env.engine.places("hazards")[0, 0, :2] = env.engine.robot.position[0, :2]
    env.step(np.zeros((1, 2)))
    assert amount(env.render()[0], RED) > amount(calm, RED) + 500
    env.close()


@pytest.mark.parametrize(
    ("robot", "sensing", "radius"),
    [
        ("Swimmer", None, 0.15),
        ("Arm3", ["link_2"], 0.23),  # begins in the sphere of link_1
        ("Arm6", ["link_1", "link_3"], 0.23),
    ],
)
def test_no_joint_hides_a_halo(robot, sensing, radius):
    engine = GuardEnv(f"Goal_{robot}_1Hazards", robot={"sensing": sensing}).engine
    engine.reset(np.zeros(1, dtype=np.int32))
    model, data = engine.model, engine.batch.get_data(0)
    scene = mujoco.MjvScene(model, maxgeom=1000)
    painter = scene_module.ScenePainter(scene, engine, data, 0)
    origin = engine.robot.frames[0][0]
    lift = [0, 0, 0.25] if robot == "Swimmer" else [0, 0, 0]
    spheres = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    for wider in (0.0, 0.06):
        scene.ngeom = 0
        painter.ring(np.ones(len(origin) * 60), 10, BLUE)
        beads = np.array([geom.pos for geom in scene.geoms[: scene.ngeom]])
        around = beads.reshape(len(origin), 60, 3) - (origin + lift)[:, None]
        np.testing.assert_allclose(np.linalg.norm(around, axis=2), radius + wider, atol=1e-6)
        gaps = np.linalg.norm(beads[:, None] - data.geom_xpos[spheres], axis=2)
        assert (gaps > model.geom_size[spheres, 0] + scene_module.BEAD).all()


@pytest.mark.parametrize("task", ["Push", "Button"])
def test_halos_show_the_lidars_that_are_observed(task):
    options = {"Goal": {"lidar": True}, "Push": {"lidar": True, "object_lidar": True}}
    env = GuardEnv(f"{task}_Point_2Hazards", task=options.get(task, {}), ghosts={"num": 2})
    env.reset(seed=0)
    if task == "Button":
        env.engine.task.wait[:] = 5  # none is lit
    obs = env.engine.observe()[0]
    shown = [tuple(closeness) for closeness, _, _ in env.engine.observer.readings(0)]
    layout = env.observation_layout
    expected = [obs[where] for name, where in layout.items() if name.endswith("_lidar")]
    np.testing.assert_allclose(sorted(shown), sorted(map(tuple, expected)), 1e-6)


def test_cameras_show_an_arena_of_any_size_and_place():
    env = GuardEnv(
        "Goal_Point_0Hazards",
        layout={"placements": [[-6.0, -6.0, 6.0, 6.0], [6.0, 0.0, 14.0, 6.0]]},
        robot={"locations": [[-8.0, 4.0]]},
        render_mode="rgb_array",
        camera="fixed",
        width=120,
        height=120,
    )
    env.reset(seed=0)
    goal, seen = env.engine.places("goal")[0, 0], []
    for goal[:2] in ((-8, -6), (14, 6), (-8, 6), (14, -6), (100, 100)):
        seen.append(amount(env.render(), GREEN))
    env.close()
    assert min(seen[:4]) > 5 and seen[4] == 0


@pytest.mark.parametrize("env_id", env_ids("guard")[:1])
def test_looking_changes_nothing(env_id):
    small = {"width": 64, "height": 48}
    seen, blind = (gymnasium.make(env_id, render_mode=m, **small) for m in ("rgb_array", None))
    a, b = seen.reset(seed=0)[0], blind.reset(seed=0)[0]
    rng = np.random.default_rng(0)
    for _ in range(5):
        seen.render()
        seen.render()
        action = rng.uniform(-1, 1, seen.action_space.shape)
        a, b = seen.step(action)[0], blind.step(action)[0]
        np.testing.assert_array_equal(a, b)
    seen.close()


def test_rows_of_a_batch_are_rendered_apart():
    env = make_vec_env(
        "Goal_Point_8Hazards",
        2,
        seed=0,
        render_mode="rgb_array",
        env_kwargs={"width": 64, "height": 64},
    )
    env.reset()
    first, second = env.get_images()
    assert first.shape == (64, 64, 3) and not np.array_equal(first, second)
    assert env.render(mode="rgb_array").size == 2 * first.size  # tiled by Stable-Baselines3
    env.close()


def test_a_window_needs_a_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    env = gymnasium.make("Goal_Point_8Hazards-v0", render_mode="human")
    with pytest.raises(rendering.RenderingError, match=r"needs a display.*not set"):
        env.reset(seed=0)
    monkeypatch.setenv("DISPLAY", ":4077")  # there, but it does not open
    with pytest.raises(rendering.RenderingError, match=r"needs a display.*:4077"):
        env.reset(seed=0)


@pytest.mark.skipif(not os.environ.get("DISPLAY"), reason="there is no display")
def test_a_window_says_return_and_cost_and_can_be_paused_and_closed(monkeypatch):
    env = gymnasium.make("Goal_Point_8Hazards-v0", render_mode="human")
    env.reset(seed=0)
    renderer, told = env.unwrapped._renderer, []
    monkeypatch.setattr(renderer._viewer, "set_texts", told.append)
    _, reward, *_, info = env.step(np.ones(2))
    assert told[0][2:] == ("return\ncost", f"{reward:.2f}\n{info['cost']:.2f}")
    renderer._key(ord(" "))
    began = time.monotonic()
    threading.Timer(0.5, renderer._key, [ord(" ")]).start()
    env.step(np.ones(2))
    assert time.monotonic() - began >= 0.5
    renderer._viewer.close()
    with pytest.raises(KeyboardInterrupt):
        env.step(np.ones(2))
    env.close()


def test_no_backend_is_a_clear_error(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("PYTHONPATH", "/nonexistent")
    monkeypatch.setattr(rendering.sys, "executable", "/bin/false")
    with pytest.raises(rendering.RenderingError, match=r"tried osmesa .*install EGL"):
        rendering.gl_backend.__wrapped__()


def test_cameras_of_a_robots_file_are_chosen_by_their_names(tmp_path):
    file = tmp_path / "dog.xml"
    camera = '<camera name="nose" pos="0.4 0 0" xyaxes="0 -1 0 0 0 1"/><site name="imu"/>'
    file.write_text(DOG.format(keys="").replace('<site name="imu"/>', camera))
    with own_parts():
        spec = add_servos(mujoco.MjSpec.from_file(str(file)))
        register_robot("Dog", xml=spec, root="trunk")
        frames = []
        for camera in ("nose", "fixed"):
            size = {"width": 64, "height": 48}
            env = GuardEnv("Goal_Dog_2Hazards", render_mode="rgb_array", camera=camera, **size)
            env.reset(seed=0)
            frames.append(env.render())
            env.close()
        assert not np.array_equal(*frames)
        with pytest.raises(ValueError, match="camera 'noes': did you mean 'nose'"):
            GuardEnv("Goal_Dog_2Hazards", render_mode="rgb_array", camera="noes")


def test_the_robots_own_camera_can_be_observed():
    options = {"flatten": False, "observe": {"camera": [32, 24]}}
    env = gymnasium.make("Goal_Point_8Hazards-v0", max_episode_steps=2, **options)
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    assert obs["camera"].shape == (24, 32, 3) and obs["camera"].std() > 1
    batch = make_vec_env("Goal_Point_8Hazards", 2, seed=0, max_episode_steps=2, env_kwargs=options)
    np.testing.assert_array_equal(batch.reset()["camera"][0], obs["camera"])
    action = np.array([[0.5, 1.0], [0.5, 1.0]])
    for _ in range(2):
        obs, *_ = env.step(action[0])
        after, _, dones, infos = batch.step(action)
    assert dones.all()
    np.testing.assert_array_equal(infos[0]["terminal_observation"]["camera"], obs["camera"])
    assert not np.array_equal(after["camera"][0], obs["camera"])
    with pytest.raises(ValueError, match="needs flatten=False"):
        gymnasium.make("Goal_Point_8Hazards-v0", observe={"camera": [32, 24]})
    env.close()
    batch.close()


def put_the_goal_ahead(env, metres):
    """Put it straight before the robot, or an arm's hand, and return its middle, [3] m."""
    engine = env.engine
    axis = 1 if type(engine.robot).__name__ in ("Car", "Arm3", "Arm6") else 0  # of the body
    origin, rotation = (frame[0, -1] for frame in engine.robot.frames)
    middle = origin + metres * rotation[:, axis]
    engine.places("goal")[0, 0] = middle - [0, 0, 0.25 if engine.task.planar else 0.0]
    return middle


@pytest.mark.parametrize("robot", registry.guard(registry.ROBOTS))
def test_the_robots_own_camera_looks_ahead(robot):
    env = GuardEnv(f"Goal_{robot}_0Hazards", flatten=False, observe={"camera": [8, 8]})
    env.engine.seed(0, np.random.default_rng(0))
    env.engine.reset(np.zeros(1, dtype=np.int32))
    model, data = env.engine.model, env.engine.batch.get_data(0)
    eye = model.camera(EYE).id
    way = put_the_goal_ahead(env, 1.0) - data.cam_xpos[eye]
    right, up, back = data.cam_xmat[eye].reshape(3, 3).T @ way
    assert back < -0.5 and abs(right) < 0.01 and abs(up) < 0.15
    hit, body = np.zeros(1, dtype=np.int32), model.cam_bodyid[eye]
    gap = mujoco.mj_ray(model, data, data.cam_xpos[eye], way, None, 1, body, hit)
    assert gap < 0 or gap > 1, f"{model.geom(hit[0]).name} is in the way"


@dataclass
class Selfie(Point):
    """A robot that sees itself from behind."""

    eye = (Point.root, (-1.0, 0.0, 0.1), (1.0, 0.0, 0.0))


def test_the_robots_own_camera_sees_neither_halo_nor_tint(monkeypatch):
    robot = Selfie(locations=((0.0, 0.0),), heading=0.0)
    hazards = Hazards(num=2, locations=((1.0, 0.0),))
    engine = Engine(robot, Goal(), [hazards], extras=Extras(camera=(48, 48)))
    engine.reset(np.zeros(1, dtype=np.int32))
    engine.places("hazards")[0, 1] = 0.0  # under the robot
    renderer = rendering.Renderer(engine, 48, 48, EYE)
    paying = renderer.frame(0)
    assert hazards.cost() > 0
    assert amount(paying, BLUE) > 20  # zones are seen
    hazards.weight = 0.0
    monkeypatch.setattr(engine.observer, "readings", lambda row: [])
    np.testing.assert_array_equal(renderer.frame(0), paying)
    renderer.close()


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["glfw", "osmesa"])
def test_a_forced_backend_that_does_not_work_is_one_line(backend, tmp_path):
    import os
    import subprocess
    import sys

    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    code = (
        "from sb3_guard.envs import make\n"
        "env = make('Goal_Point_8Hazards', render_mode='rgb_array')\n"
        "env.reset(seed=0); env.render()"
    )
    run = subprocess.run(
        [sys.executable, "-c", code],
        env={**environment, "MUJOCO_GL": backend},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    if run.returncode == 0:
        pytest.skip(f"{backend} works here")
    last = run.stderr.strip().splitlines()[-1]
    assert "MUJOCO_GL" in last and ("RenderingError" in last or "ImportError" in last), last


@pytest.mark.parametrize("elevation", [50.0, 90.0])
@pytest.mark.parametrize("aspect", [0.5, 4 / 3])
def test_a_camera_frames_all_points_and_little_else(elevation, aspect):
    points = np.random.default_rng(0).uniform((-3, -1, 0), (5, 2, 1), (50, 3))
    at, distance = scene_module.frame_all(points, elevation, aspect, fovy=45.0)
    tilt = np.radians(elevation)
    ahead, up = np.array([[0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    offset = points - (at - distance * ahead)
    reach = np.tan(np.radians(22.5)) * (offset @ ahead)
    x, y = offset[:, 0] / (aspect * reach), offset @ up / reach
    assert max(abs(x).max(), abs(y).max()) <= 1.0  # all in the picture
    assert max(np.ptp(x), np.ptp(y)) > 1.8  # which they fill


def test_bodies_throw_shadows_and_zones_do_not():
    env = GuardEnv("Goal_Drone_8Hazards")
    env.reset(seed=0)
    engine = env.engine
    data = engine.batch.get_data(0)
    painted = mujoco.MjvScene(engine.model, maxgeom=1000)
    look = mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(engine.model, data, mujoco.MjvOption(), None, *look, painted)
    bodies = painted.ngeom
    scene_module.ScenePainter(painted, engine, data, 0).shadows()
    shadows = list(painted.geoms[bodies : painted.ngeom])
    assert len(shadows) == bodies - 1  # the floor throws none
    height = data.body("robot/robot").xpos[2]
    for body, shadow in zip(list(painted.geoms[1:bodies]), shadows, strict=True):
        assert shadow.pos[2] < 0.01 < height
        assert np.linalg.norm(shadow.pos[:2] - body.pos[:2]) < body.pos[2]

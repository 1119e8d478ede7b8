"""Pictures show what is there, and looking changes nothing."""

import gymnasium
import numpy as np
import pytest

from sb3_guard import make_vec_env
from sb3_guard.envs import GuardVectorEnv, env_ids, rendering

BLUE, GREEN, RED = (0.1, 0.3, 0.95), (0.1, 0.75, 0.2), (1.0, 0.1, 0.1)


def amount(frame, colour):
    """How many pixels lean towards a colour: it dominates the other channels as there."""
    strong, weak = int(np.argmax(colour)), int(np.argmin(colour))
    pixels = frame.astype(int)
    return int((pixels[..., strong] - pixels[..., weak] > 60).sum())


@pytest.fixture(autouse=True, scope="module")
def _needs_opengl():
    try:
        rendering.gl_backend()
    except rendering.RenderingError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("camera", rendering.CAMERAS)
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


def test_the_halo_follows_the_lidar():
    frames = []
    for gain in (0.01, 50.0):  # every object near, every object far
        env = GuardVectorEnv(
            1, "Goal_Point_8Hazards", render_mode="rgb_array", camera="track", lidar={"gain": gain}
        )
        env.reset(seed=0)
        frames.append(env.render()[0].astype(int))
        env.close()
    assert np.abs(frames[0] - frames[1]).max() > 40


@pytest.mark.parametrize("env_id", env_ids()[:1])
def test_looking_changes_nothing(env_id):
    seen, blind = (gymnasium.make(env_id, render_mode=m) for m in ("rgb_array", None))
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
    monkeypatch.setenv("DISPLAY", ":77")  # there, but it does not open
    with pytest.raises(rendering.RenderingError, match=r"needs a display.*:77"):
        env.reset(seed=0)


def test_no_backend_is_a_clear_error(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setenv("PYTHONPATH", "/nonexistent")
    monkeypatch.setattr(rendering.sys, "executable", "/bin/false")
    with pytest.raises(rendering.RenderingError, match=r"tried osmesa .*install EGL"):
        rendering.gl_backend.__wrapped__()


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


@pytest.mark.parametrize("backend", ["glfw", "foo", "osmesa"])
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

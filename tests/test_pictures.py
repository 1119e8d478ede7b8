"""Pictures tell the truth: what hides the robot, where it looks, what costs, how fast it is."""

import mujoco
import numpy as np
import pytest

import sb3_guard
from sb3_guard.envs import GuardEnv, rendering
from sb3_guard.envs import scene as scene_module
from sb3_guard.envs.extras import EYE

ROW = np.zeros(1, dtype=np.int32)


@pytest.fixture(autouse=True, scope="module")
def _needs_opengl():
    try:
        rendering.gl_backend()
    except rendering.RenderingError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("robot", ["Swimmer", "Walker", "Arm3", "Arm6"])
def test_nothing_is_translucent_where_nothing_hides_the_robot(robot, monkeypatch):
    env = GuardEnv(
        f"Goal_{robot}_0Hazards", render_mode="rgb_array", width=64, height=48, camera="track"
    )
    rng = np.random.default_rng(0)
    for seed in range(4):  # which differ in heading, and by some random steps
        env.reset(seed=seed)
        for _ in range(2 * seed):
            env.step(rng.uniform(-1, 1, env.action_space.shape))
        shown = env.render()
        with monkeypatch.context() as solid:
            solid.setattr(rendering.Renderer, "_reveal", lambda *_: None)
            np.testing.assert_allclose(env.render(), shown.astype(int), atol=3)
    env.close()


def test_what_begins_to_hide_the_robot_fades():
    env = sb3_guard.make(
        "Goal_Doggo_1Pillars",
        render_mode="rgb_array",
        camera="track",
        width=160,
        height=120,
        layout={"overlap": True},
        robot={"keepout": 0.2, "locations": [(0, 0)], "heading": 0.0},
        pillars={"keepout": 0.2, "locations": [(0, -0.6)]},
    )
    env.reset(seed=0)
    engine = env.unwrapped.engine
    pillar = engine.batch.bind("mocap_pos")[0, 0]
    frames = []
    for pillar[0] in np.arange(-1.2, 1.2, 0.02):  # it passes before the robot
        engine.batch.forward(ROW)
        frames.append(env.render().astype(int))
    env.close()
    changes = np.abs(np.diff(frames, axis=0)).mean(axis=(1, 2, 3))
    assert changes.max() < 2 * np.median(changes)  # none of them is a jump


def ahead(env):
    """Where the robot's eye looks and where the dart on the floor points, [3] each."""
    engine = env.unwrapped.engine
    model, data = engine.model, engine.batch.get_data(0)
    scene = mujoco.MjvScene(model, maxgeom=100)
    scene_module.ScenePainter(scene, engine, data, 0).heading()
    (dart,) = scene.geoms[: scene.ngeom]
    return -data.cam_xmat[model.camera(EYE).id].reshape(3, 3)[:, 2], dart.mat[:, 2]


@pytest.mark.parametrize(("robot", "action"), [("Point", (1.0, 0.0)), ("Car", (1.0, 1.0))])
def test_safety_gymnasiums_robots_look_where_they_drive(robot, action):
    env = sb3_guard.make(
        f"Safety{robot}Run0-v0", flatten=False, observe={"components": None, "camera": [8, 8]}
    )
    env.reset(seed=1)
    eye, dart = ahead(env)
    position = env.unwrapped.engine.robot.position
    start = position[0].copy()
    for _ in range(20):
        env.step(np.array(action))
    way = (position[0] - start)[:2]
    env.close()
    for direction in (eye, dart):
        assert direction[:2] @ way / np.linalg.norm(way) > 0.999


def test_safety_ant_looks_along_its_y_axis():
    env = sb3_guard.make(
        "SafetyAntRun0-v0", flatten=False, observe={"components": None, "camera": [8, 8]}
    )
    env.reset(seed=1)
    y = env.unwrapped.engine.robot.frames[1][0, 0, :, 1]
    for direction in ahead(env):
        assert direction @ y > 0.99
    env.close()

"""Pictures tell the truth: what hides the robot, where it looks, what costs, how fast it is."""

import mujoco
import numpy as np
import pytest
from typed import require_rendering

import sb3_guard
from sb3_guard.envs import scene as scene_module
from sb3_guard.envs.extras import EYE

ROW = np.zeros(1, dtype=np.int32)


@pytest.fixture(autouse=True, scope="module")
def _needs_opengl():
    require_rendering()


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


@pytest.mark.parametrize(
    ("task", "limits"),
    [
        ("Circle1", (1.125, np.inf)),
        ("Circle2", (1.125, 1.125)),
    ],
)
def test_walls_are_drawn_where_it_begins_to_cost(task, limits):
    env = sb3_guard.make(f"SafetyPoint{task}-v0")
    env.reset(seed=0)
    engine = env.unwrapped.engine
    scene = mujoco.MjvScene(engine.model, maxgeom=100)
    painter = scene_module.ScenePainter(scene, engine, engine.batch.get_data(0), 0)
    engine.constraints[0].draw(painter, 0)
    walls = list(scene.geoms[: scene.ngeom])
    ends = np.array(
        [wall.pos + s * wall.size[0] * wall.mat[:, 0] for wall in walls for s in (-1, 1)]
    )
    middles = np.array([wall.pos for wall in walls])
    assert len(walls) == 2 * np.isfinite(limits).sum()
    for points in (ends, middles):
        x, y = np.abs(points[:, :2]).T
        on_x, on_y = np.isclose(x, limits[0], atol=1e-5), np.isclose(y, limits[1], atol=1e-5)
        assert (on_x | on_y).all() and (x < limits[0] + 1e-5).all() and (y < limits[1] + 1e-5).all()
    if not np.isfinite(limits[1]):  # as far as anybody sees, and as the robot runs
        assert (
            np.ptp(ends[:, 1]) > 90 and abs(middles[:, 1] - engine.robot.position[0, 1]).max() < 1
        )


@pytest.mark.parametrize("env_id", ["SafetyPointRun0-v0", "SafetyAntVelocity-v1"])
def test_pictures_of_a_run_are_bright_near_and_without_a_border(env_id, monkeypatch):
    monkeypatch.delattr(scene_module.ScenePainter, "border")
    env = sb3_guard.make(env_id, render_mode="rgb_array", width=200, height=150)
    env.reset(seed=0)
    frame = env.render().astype(int)
    assert frame.mean() > 150 and (frame.max(axis=2) < 60).mean() < 0.1
    engine = env.unwrapped.engine
    batch_x = engine.batch.bind("qpos" if engine.model.nmocap == 0 else "mocap_pos")
    batch_x[0].flat[0] += 7.0  # it has run on by seven squares of the floor, and stays in sight
    engine.batch.forward(ROW)
    colored = np.ptp(env.render().astype(int), axis=2) > 40
    env.close()
    middle = colored[30:120, 50:150]
    assert middle.sum() > 300


def test_a_picture_says_the_speed_and_its_limit(monkeypatch):
    env = sb3_guard.make("SafetyHopperVelocity-v1", render_mode="rgb_array", width=360, height=300)
    env.reset(seed=0)
    speed = env.unwrapped.engine.constraints[0]
    assert speed.words(0) == {"speed": "0.00 m/s, limit 0.74"}
    robot, duration = env.unwrapped.engine.robot, 0.008
    for _ in range(3):
        before = robot.position[0, 0]
        env.step(np.ones(3))
    fast = (robot.position[0, 0] - before) / duration
    assert abs(fast) > 0.01
    assert speed.words(0) == {"speed": f"{fast:.2f} m/s, limit 0.74"}
    said = env.render().astype(int)
    monkeypatch.setattr(type(speed), "words", lambda *_: {})
    rows, columns = np.nonzero(np.abs(env.render() - said).sum(axis=2) > 100)
    env.close()
    assert len(rows) > 300 and rows.max() < 40 and columns.max() < 300

"""``sb3-guard show``: a robot's file before it is registered; and the model as MJCF."""

import re

import mujoco
import numpy as np
import pytest
from robot_models import ARM, DOG, add_servos
from worlds import own_parts

from sb3_guard import show
from sb3_guard.envs import GuardEnv, env_spec


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, text in (("my_dog.xml", DOG.format(keys="")), ("crane.xml", ARM)):
        spec = add_servos(mujoco.MjSpec.from_string(text))
        spec.compile()
        spec.to_file(str(tmp_path / name))
    (tmp_path / "still.xml").write_text(ARM)
    (tmp_path / "dog.urdf").write_text('<robot name="dog"/>')

    def call(*words):
        with own_parts():
            try:
                status = show.main([*words, "-o", "picture.png"])
            except SystemExit as end:
                status = end.code
        out, err = capsys.readouterr()
        return status, out, err

    return call


def test_it_prints_what_was_taken_from_the_file_and_draws_it(run, tmp_path):
    status, out, _ = run("my_dog.xml", "--robot-kwargs", "root:'trunk'", "frame_skip:5")
    assert status == 0 and (tmp_path / "picture.png").is_file()
    assert "sb3_guard.register_robot('Mydog', xml='my_dog.xml', root='trunk', frame_skip=5" in out
    assert "Left out of the file: body ball, geom ground, sensor to_ball\n" in out
    assert "| 1      | front_calf  | [-1, 1] | [-2.61799, -0.523599]" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["crane.xml"], "crane.xml stands on a fixed base, .* name its end effector, .*='hand'"),
        (["dog.urdf"], "dog.urdf: it is URDF, not MJCF: convert it once with"),
        (["none.xml"], "there is no file 'none.xml'"),
        (["Goal_Ant_8Hazards", "--robot-kwargs", "frame_skip:5"], "goes with a robot's file"),
    ],
)
def test_a_file_that_is_no_robot_yet_is_answered_in_a_line(run, words, message):
    status, _, err = run(*words)
    assert status not in (0, None)
    assert re.search(message, err) and len(err.strip().splitlines()) == 1


@pytest.mark.parametrize("env_id", ["SafetyPointPush1-v0", "Goal_Ant_4Pillars-v0"])
def test_the_model_as_a_file_moves_as_the_environment_does(env_id):
    env = GuardEnv(**env_spec(env_id).kwargs)
    model = mujoco.MjModel.from_xml_string(env.engine.spec.to_xml())
    env.reset(seed=0)
    batch, data = env.engine.batch, mujoco.MjData(model)
    for name in ("qpos", "qvel", "mocap_pos", "mocap_quat"):
        field = getattr(data, name)
        field[:] = batch.bind(name)[0].reshape(field.shape)
    rng = np.random.default_rng(0)
    for _ in range(3):
        env.step(rng.uniform(-1, 1, env.action_space.shape))
        data.ctrl[:] = batch.bind("ctrl")[0]
        mujoco.mj_step(model, data, batch.frame_skip)
    moved = np.abs(data.qpos - model.qpos0).max()
    assert moved > 0.01
    np.testing.assert_allclose(data.qpos, batch.bind("qpos")[0], atol=1e-4)

"""What every id promises, on Safety-Gymnasium's: each task once, each robot, a velocity task."""

import json
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from killed import SMALL, assert_equal, crash, outcome, runs_of, tensors

from sb3_guard import cli, train
from sb3_guard.envs import GuardVectorEnv

IDS = [
    "SafetyPointGoal1-v0",
    "SafetyCarButton1-v0",
    "SafetyPointPush1-v0",
    "SafetyDoggoCircle1-v0",
    "SafetyAntRun0-v0",
    "SafetyHopperVelocity-v1",
]
SLEEPERS = [i for i in IDS if "Goal" in i or "Push" in i]


@pytest.mark.parametrize("env_id", IDS)
def test_rows_of_the_vector_environment_are_lone_environments(env_id):
    flatten = "Goal" not in env_id
    options = {"max_episode_steps": 40, "flatten": flatten}
    ours = gymnasium.make_vec(env_id, num_envs=3, **options)
    theirs = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.make(env_id, **options)] * 3, autoreset_mode=AutoresetMode.SAME_STEP
    )
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    seen, slept = [env.reset(seed=5)[0] for env in (ours, theirs)], False
    ours.action_space.seed(0)
    for step in range(60):
        parts = [{"all": obs} if flatten else obs for obs in seen]
        assert set(parts[0]) == set(parts[1])
        for name, values in parts[0].items():
            np.testing.assert_array_equal(values, parts[1][name], err_msg=f"{name}, {step}")
        action = ours.action_space.sample()
        (*a, info), (*b, their_info) = ours.step(action), theirs.step(action)
        seen = [a[0], b[0]]
        for x, y in zip(a[1:], b[1:], strict=True):
            np.testing.assert_array_equal(x, y)
        infos = [i.get("final_info", i) for i in (info, their_info)]
        keys = [{key for key in i if key.startswith("cost")} for i in infos]
        assert keys[0] == keys[1] >= {"cost"}
        for key in keys[0]:
            np.testing.assert_array_equal(infos[0][key], infos[1][key])
        if env_id in SLEEPERS:
            slept |= bool((ours.unwrapped.engine.batch.tree_asleep >= 0).any())
    assert slept or env_id not in SLEEPERS


@pytest.mark.parametrize("env_id", IDS)
def test_saving_changes_nothing_and_what_is_restored_continues_bit_for_bit(env_id):
    """By ``state``, pickle and another number of threads, in mid-episode and where things sleep."""
    ours, left_alone, restored = (GuardVectorEnv(3, env_id, num_threads=t) for t in (1, 1, 2))
    ours.reset(seed=0)
    left_alone.reset(seed=0)
    rng = np.random.default_rng(0)
    space = ours.single_action_space
    slept = False
    for step in range(90):
        if step % 9 == 4:
            restored.restore(pickle.loads(pickle.dumps(ours.state())))
        if step == 50:
            restored = pickle.loads(pickle.dumps(ours))
        if env_id in SLEEPERS:
            slept |= bool((ours.engine.batch.tree_asleep >= 0).any())
        action = rng.uniform(space.low, space.high, ours.action_space.shape).astype(np.float32)
        outcomes = [env.step(action) for env in (ours, left_alone)]
        if step >= 4:
            outcomes.append(restored.step(action))
        for other in outcomes[1:]:
            for x, y in zip(outcomes[0][:4], other[:4], strict=True):
                np.testing.assert_array_equal(x, y, err_msg=str(step))
    assert slept or env_id not in SLEEPERS


def test_customized_like_every_other_scenario(capsys, tmp_path, monkeypatch):
    env = gymnasium.make("SafetyPointGoal1-v0", hazards={"num": 4, "size": 0.3})
    hazards = env.unwrapped.scenario.constraints["hazards"]
    assert (hazards["num"], hazards["size"], hazards["keepout"]) == (4, 0.3, 0.18)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert json.loads(env.spec.to_json())["max_episode_steps"] == 1000
    np.testing.assert_array_equal(env.reset(seed=0)[0], again.reset(seed=0)[0])
    with pytest.raises(ValueError, match="hazards"):
        gymnasium.make("SafetyPointGoal1-v0", hazards={"number": 4})
    monkeypatch.chdir(tmp_path)  # where the picture goes
    show = ["show", "SafetyPointGoal1-v0", "--env-kwargs", "hazards:{'num': 4}"]
    assert cli.main(show) == 0
    assert "  hazards:\n    size: 0.2\n    num: 4\n" in capsys.readouterr().out


def test_what_is_added_is_observed_and_what_is_removed_is_not():
    plain = gymnasium.make("SafetyPointGoal1-v0").unwrapped.observation_layout
    changes = {"hazards": None, "gremlins": {"num": 2}, "slow": {"type": "speed", "limit": 1.0}}
    layout = gymnasium.make("SafetyPointGoal1-v0", **changes).unwrapped.observation_layout
    names = [name for name in plain if name != "hazards_lidar"]
    assert list(layout) == [*names, "gremlins_lidar"]
    asked = gymnasium.make("SafetyPointGoal1-v0", hazards=None, observe={"components": ["gyro"]})
    assert list(asked.unwrapped.observation_layout) == ["gyro"]


@pytest.mark.parametrize(
    "env_id",
    [
        "SafetyPointGoal1-v0",
    ],
)
def test_a_training_that_was_killed_is_the_undisturbed_one(env_id, tmp_path, monkeypatch):
    arguments = ["--env", env_id, *SMALL, "-n", "180", "--eval-freq", "-1"]
    arguments += ["--env-kwargs", "hazards:{'num': 4}", "max_episode_steps:50"]
    assert train.main([*arguments, "-f", str(tmp_path / "whole")]) == 0
    crash(monkeypatch, [*arguments, "-f", str(tmp_path / "cut")], 150)
    assert train.main(["-i", str(runs_of(tmp_path / "cut"))]) == 0
    one, other = runs_of(tmp_path / "whole"), runs_of(tmp_path / "cut")
    assert_equal(tensors(one / f"{env_id}.zip"), tensors(other / f"{env_id}.zip"))
    assert outcome(one) == outcome(other)

"""The native vector environment of Stable-Baselines3, against one environment after the other."""

import os
import pickle
import warnings
import weakref

import gymnasium
import numpy as np
import pytest
from cost_envs import CostPoint
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from worlds import own_parts

from sb3_guard import CostMonitor, Scenario, make_vec_env, train
from sb3_guard.common.native import GuardVecEnv
from sb3_guard.common.sources import find
from sb3_guard.envs import registry
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.run import Run


@pytest.mark.parametrize(
    ("vec_env", "flatten"),
    [
        ("dummy", True),
        ("dummy", False),
        pytest.param("subproc", False, marks=pytest.mark.slow),
    ],
)
def test_native_equals_one_by_one(vec_env, flatten):
    kwargs = {"seed": 3, "max_episode_steps": 30, "env_kwargs": {"flatten": flatten}}
    native = make_vec_env("Goal_Point_8Hazards-v0", 2, **kwargs)
    other = make_vec_env("Goal_Point_8Hazards-v0", 2, vec_env=vec_env, **kwargs)
    assert isinstance(native, CostMonitor) and isinstance(native.unwrapped, GuardVecEnv)
    rng = np.random.default_rng(0)
    pick = (lambda o: o) if flatten else (lambda o: np.concatenate(list(o.values()), axis=-1))
    np.testing.assert_array_equal(pick(native.reset()), pick(other.reset()))
    for _ in range(70):
        action = rng.uniform(-1, 1, (2, 2)).astype(np.float32)
        a, b = native.step(action), other.step(action)
        np.testing.assert_array_equal(pick(a[0]), pick(b[0]))
        np.testing.assert_array_equal(a[1], b[1].astype(np.float32))
        np.testing.assert_array_equal(a[2], b[2])
        for i, j in zip(a[3], b[3], strict=True):
            assert {k for k in i} - {"TimeLimit.truncated"} == {k for k in j} - {
                "TimeLimit.truncated"
            }
            assert i["cost"] == j["cost"] and i["cost_hazards"] == j["cost_hazards"]
            if "terminal_observation" in i:
                np.testing.assert_array_equal(
                    pick(i["terminal_observation"]), pick(j["terminal_observation"])
                )
                assert i["TimeLimit.truncated"] is j["TimeLimit.truncated"] is True
                for key in "rlc":  # the subprocess one sums rewards of double precision
                    assert i["episode"][key] == pytest.approx(j["episode"][key], abs=1e-6)
    native.close()
    other.close()


@pytest.mark.parametrize(
    ("name", "full"),
    [
        ("SafetyHopperVelocity", "SafetyHopperVelocity-v1"),
        ("SafetyHopperVelocity-v0", "SafetyHopperVelocity-v0"),
        ("SafetyPointGoal1", "SafetyPointGoal1-v0"),
        ("Goal_Ant_3Ghosts", "Goal_Ant_3Ghosts-v0"),
        ("CartPole", "CartPole-v1"),
        ("Humanoid", "Humanoid-v5"),
    ],
)
def test_a_missing_version_is_the_latest_everywhere(name, full):
    """In Python, in Gymnasium, in commands and in the entries of hyperparameter files."""
    assert find(name).env_id == full
    assert Run.check(RunFlags(algo="ppo", env=name)).flags.env == full
    if name in gymnasium.registry or full in gymnasium.registry:
        assert make_vec_env(name).get_attr("spec")[0].id == full
        with warnings.catch_warnings(action="ignore"):
            assert gymnasium.make(name).spec.id == full


@pytest.mark.parametrize("make", [CostPoint, lambda **arguments: CostPoint(**arguments)])
def test_a_class_or_a_function_makes_environments(make):
    """As Stable-Baselines3's function of this name has it."""
    env = make_vec_env(make, 2, seed=0, env_kwargs={"episode_length": 50}, max_episode_steps=3)
    env.reset()
    for _ in range(3):
        _, _, dones, infos = env.step(np.zeros((2, *env.action_space.shape)))
    assert dones.all() and all(info["episode"]["l"] == 3 for info in infos)
    with pytest.raises(ValueError, match="is not an sb3_guard environment"):
        make_vec_env(make, vec_env="native")


def test_wrappers_and_normalisation_work():
    env = make_vec_env(
        "Goal_Point_8Hazards", 2, wrapper_class=gymnasium.wrappers.ClipAction, seed=0
    )
    assert env.env_is_wrapped(gymnasium.wrappers.ClipAction) == [True, True]
    native: VecEnv = VecNormalize(make_vec_env("Goal_Point_8Hazards", 2, seed=0))
    native.reset()
    assert native.env_is_wrapped(gymnasium.wrappers.ClipReward) == [False, False]
    costs = [info["cost"] for _ in range(50) for info in native.step(np.ones((2, 2)))[3]]
    assert np.isfinite(costs).all()
    assert native.get_attr("spec")[1].max_episode_steps == 1000
    assert native.get_attr("scenario", 0) == [Scenario.parse("Goal_Point_8Hazards")]


@pytest.mark.parametrize(
    ("env_id", "kwargs", "message"),
    [
        ("CartPole-v2", {}, "unknown environment 'CartPole-v2': did you mean 'CartPole-v"),
        ("Goal_Point_8Hazard", {}, "unknown constraint 'Hazard'"),
        ("Goal_Point_8Hazards-v3", {}, "did you mean 'Goal_Point_8Hazards-v0'"),
        ("CartPole-v1", {"vec_env": "native"}, "not an sb3_guard environment"),
        ("CartPole-v1", {"vec_env": "sub"}, "unknown vec_env 'sub': did you mean 'subproc'"),
        ("Goal_Point_8Hazards", {"n_envs": 0}, "n_envs = 0 must be"),
        (
            "Goal_Point_8Hazards",
            {"num_threads": 0},
            "num_threads = 0 must be",
        ),
        (
            "Goal_Point_8Hazards",
            {"vec_env": "native", "wrapper_class": gymnasium.wrappers.ClipReward},
            "wrapper_class, or env_wrapper",
        ),
        ("Goal_Point_8Hazards", {"env_kwargs": {"hazards": {"num": -1}}}, "must be at least 0"),
    ],
)
def test_bad_requests_are_refused_in_one_line(env_id, kwargs, message):
    with pytest.raises(ValueError, match=message) as caught:
        make_vec_env(env_id, **kwargs)
    assert "\n" not in str(caught.value)


def test_parts_that_other_processes_do_not_have_are_named_in_a_line(capfd):
    with own_parts():
        registry.ROBOTS["Mine"] = registry.ROBOTS["Point"]
        words = "unknown robot 'Mine' .* what is under if __name__ == '__main__': register parts"
        with pytest.raises(ValueError, match=words) as caught:
            make_vec_env("Goal_Mine_2Hazards", 1, vec_env="subproc")
    assert "\n" not in str(caught.value) and capfd.readouterr()[1] == ""


@pytest.mark.slow
def test_processes_import_what_the_command_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = "from sb3_guard.envs.registry import ROBOTS", "ROBOTS['Mine'] = ROBOTS['Point']"
    (tmp_path / "mine.py").write_text("\n".join(lines))
    words = "--env Goal_Mine_2Hazards --gym-packages mine --vec-env subproc -n 20 --eval-freq -1"
    params = ["-params", "n_envs:1", "n_steps:10", "cost_limit:2"]
    with own_parts():
        assert train.main([*words.split(), *params, "-f", "logs"]) == 0


def test_diverged_episodes_are_counted():
    env = make_vec_env("Goal_Point_8Hazards", 3, seed=0)
    env.reset()
    env.step(np.zeros((3, 2)))
    assert env.physics_errors == 0
    env.unwrapped.envs.engine.batch.bind("qvel")[1] = 1e12
    _, _, dones, infos = env.step(np.zeros((3, 2)))
    assert dones.tolist() == [False, True, False] and infos[1]["physics_error"]
    assert infos[1]["TimeLimit.truncated"] is False and np.isfinite(infos[1]["episode"]["r"])
    assert env.physics_errors == 1 and env.state()["physics_errors"] == 1


def test_everything_that_a_registration_says_is_honoured():
    gymnasium.register(
        "Registered-v0",
        entry_point="sb3_guard.envs.gym_env:GuardEnv",
        max_episode_steps=7,
        kwargs={"scenario": "Goal_Point_8Hazards", "hazards": {"num": 2}, "flatten": False},
    )
    try:
        native = make_vec_env("Registered-v0", 1)
        assert native.get_attr("scenario")[0].constraints == {"hazards": {"num": 2}}
        assert native.get_attr("max_episode_steps") == [7]
        assert isinstance(native.observation_space, gymnasium.spaces.Dict)
        assert native.unwrapped.spec.id == "Registered-v0"
        assert make_vec_env("Registered-v0", 1, max_episode_steps=9).get_attr(
            "max_episode_steps"
        ) == [9]
        assert gymnasium.spec("Registered-v0").max_episode_steps == 7
    finally:
        del gymnasium.registry["Registered-v0"]


def test_native_environments_can_be_copied():
    env = make_vec_env("Goal_Point_8Hazards", 2, seed=0)
    env.reset()
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(3):
        np.testing.assert_array_equal(env.step(np.ones((2, 2)))[0], twin.step(np.ones((2, 2)))[0])


def test_a_closed_environment_is_over_and_leaves_nothing():
    env = GuardVecEnv("Goal_Point_8Hazards", 2, num_threads=2)
    env.reset()
    env.close()
    for name, arguments in (("reset", []), ("step", [np.zeros((2, 2))])):
        with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="was closed"):
            getattr(env, name)(*arguments)
    simulations = weakref.ref(env.envs.engine.batch)
    del env
    assert simulations() is None  # without waiting for the garbage collector


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork")
@pytest.mark.parametrize("threads", [1, 2])
def test_a_fork_has_no_threads_to_step_what_it_inherits(threads):
    env = GuardVecEnv("Goal_Point_8Hazards", 2, num_threads=threads)
    env.reset()
    if (child := os.fork()) == 0:
        try:
            env.step(np.zeros((2, 2)))
            os._exit(1)
        except RuntimeError as error:
            os._exit(2 if "forked" in str(error) else 3)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == threads


def test_a_step_before_the_first_reset_is_refused():
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        GuardVecEnv("Goal_Point_8Hazards", 2).step(np.zeros((2, 2)))

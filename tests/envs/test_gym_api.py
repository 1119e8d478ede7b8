"""What Gymnasium and Stable-Baselines3 ask of an environment."""

import copy
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.env_checker import check_env as sb3_check
from suites import CASES

import sb3_guard
from sb3_guard.envs import GuardEnv, GuardVectorEnv, env_spec, make, register

INFINITE = {"minimum value is -infinity", "maximum value is infinity"}


@pytest.mark.parametrize("env_id", CASES)
@pytest.mark.parametrize("flatten", [True, False])
def test_both_checkers_find_nothing_but_infinite_bounds(env_id, flatten):
    env = make(env_id, flatten=flatten)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        gymnasium_check(env.unwrapped, skip_render_check=True)
        sb3_check(env)
    texts = [str(w.message) for w in caught]
    assert all(any(known in text for known in INFINITE) for text in texts), texts


@pytest.mark.parametrize("env_id", CASES)
def test_bounds_are_true_and_finite_where_they_can_be(env_id):
    env = gymnasium.make_vec(env_spec(env_id), num_envs=2).unwrapped
    space, layout = env.single_observation_space, env.observation_layout
    for name, where in layout.items():
        low, high = space.low[where], space.high[where]
        if name.endswith("_lidar"):
            assert (low == 0).all() and (high == 1).all()
        elif name.endswith("_compass") or name.startswith("jointpos"):
            assert (low == -1).all() and (high == 1).all()
        elif name.startswith("touch"):
            assert (low == 0).all() and (high == np.inf).all()
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(50):
        obs, *_ = env.step(rng.uniform(-1, 1, env.action_space.shape))
        assert obs.dtype == np.float32
        assert env.observation_space.contains(obs)


@pytest.mark.parametrize("env_id", CASES)
def test_pickled_and_copied_environments_continue_bit_for_bit(env_id):
    env = make(env_id).unwrapped
    env.reset(seed=0)
    env.step(env.action_space.sample())
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    for _ in range(3):
        action = env.action_space.sample()
        obs, reward, *_ = env.step(action)
        for twin in twins:
            o, r, *_ = twin.step(action)
            np.testing.assert_array_equal(o, obs)
            assert r == reward
    obs, _ = env.reset()
    for twin in twins:
        np.testing.assert_array_equal(twin.reset()[0], obs)


@pytest.mark.parametrize(
    ("env_id", "params"),
    [
        ("SafetyHopperVelocity-v1", {}),  # falls
        ("SafetyPointButton1-v0", {"robot": {"action_noise": 0.1}}),  # every step draws numbers
    ],
)
@pytest.mark.parametrize("mode", AutoresetMode)
def test_the_vector_environment_follows_gymnasiums_own(mode, env_id, params):
    params = {"max_episode_steps": 7, **params}
    ours = gymnasium.make_vec(env_id, num_envs=3, autoreset_mode=mode, **params)
    theirs = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.make(env_id, **params)] * 3, autoreset_mode=mode
    )
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is mode
    np.testing.assert_array_equal(ours.reset(seed=5)[0], theirs.reset(seed=5)[0])
    ours.action_space.seed(0)
    ends = set()
    for step in range(40):
        action = ours.action_space.sample()
        a, b = ours.step(action), theirs.step(action)
        for x, y in zip(a[:4], b[:4], strict=True):
            np.testing.assert_array_equal(x, y)
        done = a[2] | a[3]
        ends.add(tuple(done))
        if mode is not AutoresetMode.SAME_STEP:
            for name in ("cost", "_cost"):
                np.testing.assert_array_equal(a[4][name], b[4].get(name, np.zeros(3)))
        assert ("final_obs" in a[4]) == ("final_obs" in b[4]) == ("final_info" in a[4])
        if "final_obs" in b[4]:
            for x, y in zip(a[4]["final_obs"], b[4]["final_obs"], strict=True):
                np.testing.assert_array_equal(x, y)
            np.testing.assert_array_equal(a[4]["final_info"]["cost"], b[4]["final_info"]["cost"])
        rows = done & (mode is AutoresetMode.DISABLED) | np.array([step == 2, False, False])
        if rows.any():
            begun = [env.reset(options={"reset_mask": rows.copy()})[0] for env in (ours, theirs)]
            np.testing.assert_array_equal(*begun)
    assert len(ends) > 2


def test_a_row_that_has_ended_waits_for_its_reset():
    ours, restored = (
        gymnasium.make_vec(
            "Goal_Point_8Hazards-v0", num_envs=2, max_episode_steps=1, autoreset_mode="Disabled"
        )
        for _ in range(2)
    )
    ours.reset(seed=0)
    ours.step(np.zeros((2, 2)))
    ours.reset(options={"reset_mask": np.array([True, False])})
    restored.restore(ours.state())
    for env in (ours, restored):
        with pytest.raises(gymnasium.error.ResetNeeded, match=r"rows \[1\] have ended"):
            env.step(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="must be 2 truth values"):
        ours.reset(options={"reset_mask": np.array([1, 0])})
    with pytest.raises(ValueError, match="autoreset_mode = 'NextStap': did you mean 'Next"):
        gymnasium.make_vec("Goal_Point_8Hazards-v0", num_envs=2, autoreset_mode="NextStap")


def test_gymnasiums_vector_wrappers_go_around():
    envs = gymnasium.make_vec(
        "Goal_Point_8Hazards-v0", num_envs=2, max_episode_steps=3, flatten=False,
        autoreset_mode="NextStep",
    )  # fmt: skip
    for wrapper in ("FlattenObservation", "NormalizeObservation", "RecordEpisodeStatistics"):
        envs = getattr(gymnasium.wrappers.vector, wrapper)(envs)
    obs, _ = envs.reset(seed=0)
    assert obs.shape == envs.observation_space.shape
    infos = [envs.step(np.zeros((2, 2)))[4] for _ in range(8)]
    lengths = [info["episode"]["l"].tolist() for info in infos if "episode" in info]
    assert lengths == [[3, 3], [3, 3]]


def test_dict_observations_hold_the_components_by_name():
    flat = gymnasium.make("Goal_Point_8Hazards-v0")
    named = gymnasium.make("Goal_Point_8Hazards-v0", flatten=False)
    obs, parts = flat.reset(seed=0)[0], named.reset(seed=0)[0]
    assert set(parts) == set(flat.unwrapped.observation_layout)
    for name, where in flat.unwrapped.observation_layout.items():
        np.testing.assert_array_equal(parts[name], obs[where])


def test_unregistered_ids_work_in_make_and_after_register():
    env = make("Goal_Point_3Hazards")
    assert env.unwrapped.scenario.constraints["hazards"]["num"] == 3
    assert env.spec.id == "Goal_Point_3Hazards-v0"
    assert "Goal_Point_5Hazards-v0" not in gymnasium.registry
    assert register("Goal_Point_5Hazards") == "Goal_Point_5Hazards-v0"
    assert gymnasium.make("Goal_Point_5Hazards-v0").spec.max_episode_steps == 1000
    del gymnasium.registry["Goal_Point_5Hazards-v0"]
    register("Mine", sb3_guard.Scenario(constraints={"hazards": {"num": 1}}))
    assert gymnasium.make("Mine-v0").unwrapped.scenario.constraints == {"hazards": {"num": 1}}
    del gymnasium.registry["Mine-v0"]


@pytest.mark.parametrize("cls", [GuardEnv, GuardVectorEnv])
def test_what_a_refused_constructor_leaves_can_be_closed(cls):
    cls.__new__(cls).close()  # Gymnasium closes vector environments when they are collected


def test_bad_actions_and_modes_are_refused():
    env = gymnasium.make("Goal_Point_8Hazards-v0").unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action has shape \(3,\), expected \(2,\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match="not finite"):
        env.step(np.array([np.nan, 0.0]))
    with pytest.raises(ValueError, match="did you mean 'rgb_array'"):
        gymnasium.make("Goal_Point_8Hazards-v0", render_mode="rgbarray").unwrapped.close()
    with pytest.raises(ValueError, match="unknown camera 'tracker': did you mean 'track'"):
        gymnasium.make("Goal_Point_8Hazards-v0", camera="tracker")
    with pytest.raises(ValueError, match="num_envs = 0 must be"):
        gymnasium.make_vec("Goal_Point_8Hazards-v0", num_envs=0)
    with pytest.raises(ValueError, match="max_episode_steps = 0 must be at least 1"):
        gymnasium.make_vec("Goal_Point_8Hazards-v0", num_envs=1, max_episode_steps=0)
    with pytest.raises(ValueError, match="2 seeds for 1"):
        gymnasium.make_vec("Goal_Point_8Hazards-v0", num_envs=1).reset(seed=[1, 2])

"""Vector environments of Gymnasium, against the same environments one by one."""

import copy
import os
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_guard import (
    CPO,
    CostEvalCallback,
    CostMonitor,
    PPOLag,
    SACLag,
    evaluate_policy,
    make_vec_env,
    train,
)
from sb3_guard.common.adapters import CostFromFunction
from sb3_guard.common.native import GuardVecEnv
from sb3_guard.vector import GymnasiumVecEnv, as_vec_env, info_rows

N = 3
SPACES: dict[str, spaces.Space] = {
    "box": spaces.Box(-1.0, 1.0, (3,), np.float32),
    "discrete": spaces.Discrete(9),
    "dict": spaces.Dict({"a": spaces.Box(-1.0, 1.0, (2,), np.float32), "b": spaces.Discrete(4)}),
    "image": spaces.Box(0, 255, (36, 36, 1), np.uint8),
}
POLICIES = {"dict": "MultiInputPolicy", "image": "CnnPolicy"}


class Staggered(gym.Env):
    """Episodes of 2 to 8 steps, terminated, truncated or both; costs that are not always told.

    The info of a reset has a cost, too, which no step has brought.
    """

    def __init__(self, observed: str = "box", moved: str = "box") -> None:
        self.observation_space = copy.deepcopy(SPACES[observed])  # each draws from its own
        self.action_space = SPACES[moved]

    def _info(self, cost):
        wear = {"a": float(cost) / 2, "b": np.arange(2) + cost}
        return {"cost": cost, "wear": cost / 2, "detail": wear} if cost else {"wear": 0.25}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.left = int(self.np_random.integers(2, 9))
        return self.observation_space.sample(), self._info(100.0)

    def step(self, action):
        self.left -= 1
        over, how = self.left == 0, self.np_random.integers(3)
        reward = float(np.sum(action) + self.np_random.random())
        info = self._info(float(self.np_random.integers(3)))
        return self.observation_space.sample(), reward, over and how > 0, over and how < 2, info


class Batch(VectorEnv):
    """A vector environment of another's own, which does in its way what a class may."""

    def __init__(self, mode: str = "NextStep", **kwargs: Any) -> None:
        self.inner = sync(mode, **kwargs)
        self.metadata, self.num_envs = self.inner.metadata, N
        for kind in ("observation_space", "action_space"):
            setattr(self, kind, getattr(self.inner, kind))
            setattr(self, f"single_{kind}", getattr(self.inner, f"single_{kind}"))
        self.memory = np.zeros(self.observation_space.shape, np.float32)

    def reset(self, *, seed=None, options=None):
        assert seed is None or isinstance(seed, int)  # Gymnasium's interface knows no list
        mask = (options or {}).get("reset_mask")
        obs, infos = self.inner.reset(seed=seed, options=options)
        if mask is None:
            return obs, infos
        return obs[mask], {}  # EnvPool hands out these rows alone

    def step(self, actions):
        obs, *rest, infos = self.inner.step(actions)
        self.memory[:] = obs  # the same array in each step
        return self.memory, *rest, {**infos, "version": 3}


def sync(mode: str = "NextStep", **kwargs: Any) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: Staggered(**kwargs)] * N, autoreset_mode=mode)


def one_by_one(**kwargs: Any) -> VecEnv:
    return DummyVecEnv([lambda: Staggered(**kwargs)] * N)


class Recorder(BaseCallback):
    """The episodes that a monitor reports."""

    def __init__(self) -> None:
        super().__init__()
        self.episodes: list[Any] = []
        self.infos: list[Any] = []

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                told = {k: v for k, v in info["episode"].items() if k != "t"}
                self.episodes.append(told)
            self.infos.append({k: v for k, v in info.items() if k not in ("episode", "version")})
        return True


def assert_same(one: Any, other: Any, path: str = "") -> None:
    assert type(one) is type(other) or isinstance(one, np.number | float | int), path
    if isinstance(one, dict):
        assert one.keys() == other.keys(), path
        for key, value in one.items():
            assert_same(value, other[key], f"{path}.{key}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), path
        for i, pair in enumerate(zip(one, other, strict=True)):
            assert_same(*pair, f"{path}[{i}]")
    else:
        np.testing.assert_array_equal(one, other, path)


def trained(env: VecEnv, observed: str = "box", cls: Any = PPOLag) -> tuple[Any, Recorder]:
    keys = {"cost_keys": ("cost", "wear"), "missing_cost": "zero", "cost_limit": [1.0, 1.0]}
    size: dict[str, Any] = {"n_steps": 25, "batch_size": 25, "n_epochs": 1}
    if cls is SACLag:
        size = {"learning_starts": 20, "buffer_size": 100, "batch_size": 8}
    env = CostMonitor(env, cost_keys=("cost", "wear"))
    policy, recorder = POLICIES.get(observed, "MlpPolicy"), Recorder()
    model = cls(policy, env, seed=7, policy_kwargs={"net_arch": [8]}, **keys, **size)
    model.learn(2 * N * 25, callback=recorder)
    return model, recorder


def assert_equal_training(env: VecEnv, **kwargs: Any) -> None:
    """Episodes, returns, costs, infos, buffer and weights are those of the environments alone."""
    cls, observed = kwargs.pop("cls", PPOLag), kwargs.get("observed", "box")
    model, seen = trained(env, observed, cls)
    other, expected = trained(one_by_one(**kwargs), observed, cls)
    assert len(expected.episodes) > 15 and len({e["l"] for e in expected.episodes}) > 3
    assert_same(seen.episodes, expected.episodes)
    assert_same(seen.infos, expected.infos)
    name = "replay_buffer" if cls is SACLag else "rollout_buffer"
    arrays = [
        {k: v for k, v in vars(getattr(m, name)).items() if isinstance(v, np.ndarray | dict)}
        for m in (model, other)
    ]
    assert_same(*arrays)
    assert_same(*[[w.detach().numpy() for w in m.policy.parameters()] for m in (model, other)])
    np.testing.assert_array_equal(model.costs.total, other.costs.total)


MODES = [mode.value for mode in AutoresetMode]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("observed", SPACES)
def test_training_is_that_of_the_environments_one_by_one(mode, observed):
    moved = "discrete" if observed == "discrete" else "box"
    kwargs = {"observed": observed, "moved": moved}
    assert_equal_training(GymnasiumVecEnv(sync(mode, **kwargs)), **kwargs)


@pytest.mark.parametrize("mode", MODES)
def test_so_is_that_of_classes_of_ones_own_and_of_wrapped_ones(mode):
    assert_equal_training(GymnasiumVecEnv(Batch(mode)))
    assert_equal_training(GymnasiumVecEnv(RecordEpisodeStatistics(sync(mode))), cls=SACLag)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_so_is_that_of_processes(mode):
    env = gym.vector.AsyncVectorEnv([Staggered] * N, autoreset_mode=mode)
    assert_equal_training(as_vec_env(env))
    env.close()


def test_what_gymnasium_steps_one_by_one_stable_baselines3_does():
    env = as_vec_env(sync())
    assert_equal_training(env)
    assert type(env) is DummyVecEnv and len(env.get_attr("left")) == N


@pytest.mark.parametrize("mode", MODES)
def test_our_own_become_the_native_batch(mode):
    envs = gym.make_vec(
        "Goal_Point_8Hazards-v0", num_envs=3, max_episode_steps=20, autoreset_mode=mode
    )
    kwargs = {"n_steps": 30, "cost_limit": 1.0, "seed": 3, "policy_kwargs": {"net_arch": [8]}}
    ours = CPO("MlpPolicy", envs, **kwargs).learn(180)
    env = make_vec_env("Goal_Point_8Hazards", 3, max_episode_steps=20)
    other = CPO("MlpPolicy", env, **kwargs).learn(180)
    assert isinstance(ours.env.unwrapped, GuardVecEnv) and ours.env.unwrapped.envs is envs
    for name in ("observations", "rewards", "costs", "cost_advantages", "episode_starts"):
        arrays = [getattr(model.rollout_buffer, name) for model in (ours, other)]
        np.testing.assert_array_equal(*arrays)
    assert ours.costs.horizon == 20 and [e["l"] for e in ours.ep_info_buffer] == [20] * 9
    assert isinstance(make_vec_env(envs, seed=1).unwrapped, GuardVecEnv)
    by_id = make_vec_env("Goal_Point_8Hazards", 2, vec_env="gymnasium")
    assert isinstance(by_id.unwrapped, GuardVecEnv)


# Costs of a function


def far(obs, action, next_obs, info):
    return np.abs(next_obs[..., 0] - obs[..., 0]) + action[..., 1] ** 2 + np.float32(info["wear"])


@pytest.mark.parametrize("mode", MODES)
def test_a_function_of_the_batch_charges_what_one_of_each_row_does(mode):
    lone = [lambda: CostFromFunction(Staggered(), far)] * N
    envs = CostMonitor(GymnasiumVecEnv(sync(mode), cost=far)), CostMonitor(DummyVecEnv(lone))
    rng = np.random.default_rng(0)
    for env in envs:
        env.seed(3)
        env.reset()
    ends = 0
    for _ in range(40):
        actions = rng.uniform(-1, 1, (N, 3)).astype(np.float32)
        steps = [env.step(actions) for env in envs]
        for a, b in zip(*(step[3] for step in steps), strict=True):
            assert a["cost"] == b["cost"]
            ends += "episode" in a
            assert ("episode" in a) == ("episode" in b)
            assert "episode" not in a or a["episode"]["c"] == b["episode"]["c"]
    assert ends > 15


def test_infos_are_those_of_the_rows_that_have_them():
    infos = {
        "cost": np.array([1.0, 0.0, 2.0]),
        "_cost": np.array([True, False, True]),
        "parts": {"force": np.eye(3), "_force": np.array([False, True, False]), "unit": "N"},
        "names": np.array(["a", None, "c"], object),
        "paths": [[1, 2], None, "p"],
        "time": 0.5,
        "_private": np.arange(3),
    }
    first, second, third = info_rows(infos, 3)
    told = {"parts": {"unit": "N"}, "names": "a", "paths": [1, 2], "time": 0.5, "_private": 0}
    assert first == {"cost": 1.0, **told}
    assert type(third["cost"]) is float and "cost" not in second
    np.testing.assert_array_equal(second["parts"]["force"], [0, 1, 0])


# Where else they go


def test_evaluations_take_them_and_know_the_models_own():
    model = PPOLag("MlpPolicy", sync(), missing_cost="zero", n_steps=20, cost_limit=1.0)
    model.learn(60)
    assert len(model.ep_info_buffer) > 5
    seen = evaluate_policy(model, GymnasiumVecEnv(Batch()), 6, seed=0)
    alone = evaluate_policy(model, one_by_one(), 6, seed=0)
    np.testing.assert_array_equal(seen.costs, alone.costs)
    watcher = CostEvalCallback(Batch("Disabled"), eval_freq=20, n_eval_episodes=3, verbose=0)
    model.learn(60, callback=watcher)
    assert watcher.last_mean_cost > 0.0
    shared = Batch()
    other = PPOLag("MlpPolicy", shared, missing_cost="zero", n_steps=20, cost_limit=1.0)
    assert other.learn(20)._last_obs is not None
    evaluate_policy(other, shared, 2)
    assert other._last_obs is None  # so the next learn begins new episodes


def mixed_up() -> Any:
    env = Batch()
    env.single_observation_space = env.observation_space
    return env


def without_a_mode(mode: Any) -> Any:
    env = Batch()
    env.metadata = {"autoreset_mode": mode}
    return env


class Dying(Staggered):
    """The process that steps it ends, or an error of its code does that."""

    def __init__(self, error: type[Exception] | None = None) -> None:
        super().__init__()
        self.error = error

    def step(self, action):
        if self.error is None:
            os._exit(1)
        raise self.error("stuck\nin a corner")


@pytest.mark.parametrize("error", [None, ValueError])
@pytest.mark.parametrize("row", range(N))
def test_a_process_that_dies_is_told_and_ends_the_others(row, error):
    makers = [partial(Dying, error) if i == row else Staggered for i in range(N)]
    with closing(as_vec_env(gym.vector.AsyncVectorEnv(makers, context="fork"))) as env:
        env.reset()
        with pytest.raises(ConnectionError, match="a process of AsyncVectorEnv has died"):
            env.step(np.zeros((N, 3), np.float32))
    for process in env.envs.processes:
        process.join(10)
        assert not process.is_alive()


def test_an_interrupted_step_ends_the_processes(monkeypatch):
    """Their answers are lost, so that ``close`` would wait for them."""
    envs = gym.vector.AsyncVectorEnv([Staggered] * 2, context="fork")
    with closing(as_vec_env(envs)) as env, pytest.raises(KeyboardInterrupt):
        env.reset()
        envs.step_async(np.zeros((2, 3), np.float32))
        envs.parent_pipes[0].recv()

        def interrupted(actions):
            raise KeyboardInterrupt

        monkeypatch.setattr(envs, "step", interrupted)
        env.step(np.zeros((2, 3), np.float32))


SMALL: dict[str, Any] = {"n_steps": 20, "cost_limit": 1.0}
ZERO: dict[str, Any] = {"missing_cost": "zero"}
REFUSED = {
    "an unknown mode": (lambda: CPO("MlpPolicy", without_a_mode("NextStap"), **SMALL), "did you"),
    "no mode": (lambda: as_vec_env(without_a_mode(None)), "autoreset_mode of Batch = None"),
    "the space of rows": (lambda: as_vec_env(mixed_up()).reset(), "mixes up single and vector"),
    "a single one": (lambda: GymnasiumVecEnv(Staggered()), "Staggered is no vector environment"),
    "a function of them": (lambda: make_vec_env(sync, 2), "makes a SyncVectorEnv, a vector env"),
    "a function of single ones": (lambda: CostFromFunction(sync(), far), "Expected env to be a"),
    "made already": (lambda: make_vec_env(sync(), 2), "SyncVectorEnv is made already"),
    "no cost": (lambda: CPO("MlpPolicy", Batch(), **SMALL).learn(20), "no cost key 'cost'"),
    "a cost of other rows": (
        lambda: CPO("MlpPolicy", GymnasiumVecEnv(sync(), lambda *_: 1.0), **SMALL).learn(20),
        r"returned shape \(\), expected \(3,\)",
    ),
    "resets of others": (
        lambda: CPO("MlpPolicy", gym.make_vec("CartPole-v1", 3), **SMALL, **ZERO).learn(120),
        "CartPoleVectorEnv begins other episodes",
    ),
    "Gymnasium's normalisation": (
        lambda: CPO("MlpPolicy", NormalizeObservation(Batch()), **SMALL, **ZERO).learn(20),
        "does not support partial resets",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_can_not_be_is_a_line(name):
    call, message = REFUSED[name]
    with pytest.raises((TypeError, ValueError), match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


# Commands


def test_a_command_steps_the_vector_environment_that_is_registered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = []

    def batch(num_envs: int, **kwargs: Any) -> VectorEnv:
        made.append(num_envs)
        assert num_envs in (1, 4)
        return sync_of(num_envs)

    def sync_of(n: int) -> VectorEnv:
        return RecordEpisodeStatistics(SyncVectorEnv([Staggered] * n))

    gym.register("Batched-v0", vector_entry_point=batch)
    try:
        words = "--algo ppo_lag --env Batched-v0 -n 200 --eval-freq -1 -f logs --vec-env gymnasium"
        params = ["n_envs:4", "n_steps:25", "cost_limit:1", "missing_cost:'zero'"]
        assert train.main([*words.split(), "-params", *params]) == 0
        assert 4 in made
    finally:
        del gym.registry["Batched-v0"]


# Peers


def hoppers(n: int) -> Any:
    envpool = pytest.importorskip("envpool")
    return envpool.make_gymnasium("Hopper-v4", num_envs=n, seed=0, max_episode_steps=30)


@pytest.mark.slow
def test_envpools_episodes_are_those_of_its_own_resets():
    """Each row is given its actions in order, whether the next step resets it or a mask does."""
    ended: list[list[Any]] = [[], []]
    for mine in (False, True):
        env = GymnasiumVecEnv(hoppers(N)) if mine else hoppers(N)
        env.reset()
        rows = [iter(np.random.default_rng(i).uniform(-1, 1, (200, 3))) for i in range(N)]
        resting = [False] * N
        for _ in range(120):
            actions = np.stack([np.zeros(3) if resting[i] else next(rows[i]) for i in range(N)])
            obs, rewards, *ends, infos = env.step(actions)
            dones = np.any(ends, axis=0).tolist()
            for i in np.flatnonzero(dones).tolist():
                last = infos[i]["terminal_observation"] if mine else obs[i]
                ended[mine].append((i, np.float32(rewards[i]), *last))
            resting = [False] * N if mine else dones
    for i in range(N):
        theirs, ours = ([end for end in ends if end[0] == i] for ends in ended)
        assert len(theirs) > 2
        np.testing.assert_array_equal(theirs, ours[: len(theirs)])


@pytest.mark.slow
def test_envpool_trains_within_a_limit():
    """The cost counts fast steps; a first policy has 3.7 of them in an episode."""

    def fast(obs, actions, next_obs, infos):
        return infos["x_velocity"] > 0.1

    env = make_vec_env(GymnasiumVecEnv(hoppers(8), cost=fast))
    model = PPOLag("MlpPolicy", env, n_steps=250, cost_limit=1.5, seed=0, learning_rate=1e-3)
    first = model.learn(2000).costs.episode_cost[0]
    model.learn(60_000)
    assert model.costs.episode_cost[0] < 2.5 < first

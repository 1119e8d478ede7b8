"""Simulators that step torch tensors, by a stand-in with mjlab's interface."""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_guard import PPOLag, make_vec_env
from sb3_guard.vector import TensorVecEnv

N = 4


def box(size: int) -> Any:
    """mjlab's spaces are its own."""
    return SimpleNamespace(shape=(size,), low=-np.inf, high=np.inf)


class Simulator:
    """Row i counts to 3 + i and dies, or to 6 and is cut; it shows its count and its episode.

    As mjlab, it resets rows by itself and then shows the new episode; always in the same tensor.

    :param auto_reset: False: it leaves resets to ``reset(env_ids=...)``, as mjlab may
    :param tells_last: ``extras["final_obs"]`` has what was before the resets, as in Isaac Lab
    """

    num_envs, device, max_episode_length, render_mode = N, "cpu", 6, None

    def __init__(self, auto_reset: bool = True, tells_last: bool = False) -> None:
        self.cfg = SimpleNamespace(auto_reset=auto_reset)
        self.tells_last = tells_last
        groups = {"actor": box(2), "critic": box(5)}
        self.single_observation_space = SimpleNamespace(spaces=groups)
        self.single_action_space = box(1)
        self.extras: dict[str, Any] = {"log": {}}
        self.shown = th.zeros(N, 2)
        self.count, self.begun = self.shown.T
        self.seed: Any = None
        self.lives = 3.0

    def _observed(self) -> dict[str, th.Tensor]:
        return {"critic": th.zeros(N, 5), "actor": self.shown}

    def reset(self, *, seed: Any = None, env_ids: Any = None) -> Any:
        if env_ids is None:
            self.seed = seed
            self.begun[:] = 0.0
        rows = slice(None) if env_ids is None else env_ids
        self.count[rows] = 0.0
        self.begun[rows] += 1.0
        return self._observed(), self.extras

    def step(self, action: th.Tensor) -> Any:
        assert action.shape == (N, 1) and action.dtype == th.float32
        self.count += 1.0
        late = self.count >= 6.0
        died = self.count >= th.arange(N) + self.lives
        reward = self.count * 10.0
        self.extras["cost"] = (self.count > 2.0).float()
        if self.tells_last:
            self.extras["final_obs"] = {"actor": self.shown.clone()}
        if self.cfg.auto_reset:
            self.reset(env_ids=died | late)
        return self._observed(), reward, died, late, self.extras


def test_a_step_is_what_stable_baselines3_needs():
    env = TensorVecEnv(Simulator())
    assert env.observation_space.shape == (2,) and env.action_space.high.tolist() == [5.0]
    assert env.get_attr("max_episode_steps") == [6] * N
    env.seed(3)
    np.testing.assert_array_equal(env.reset(), [[0, 1]] * N)
    assert env.envs.seed == 3
    steps = [env.step(np.zeros((N, 1))) for _ in range(6)]
    obs, rewards, dones, infos = steps[2]
    np.testing.assert_array_equal(obs, [[0, 2], [3, 1], [3, 1], [3, 1]])
    assert rewards.tolist() == [30.0] * N and dones.tolist() == [True, False, False, False]
    assert [info["cost"] for info in infos] == [1.0] * N
    assert infos[0]["TimeLimit.truncated"] is False and [*infos[1]] == ["cost"]
    np.testing.assert_array_equal(infos[0]["terminal_observation"], [2, 1])
    np.testing.assert_array_equal(steps[1][0][0], [2, 1])  # as it was: nothing wrote into it


def test_gymnasiums_wrappers_may_be_around():
    """As around every environment of Isaac Lab, which ``gymnasium.make`` makes."""
    inner = Simulator()
    wrapped = SimpleNamespace(unwrapped=inner, reset=inner.reset, step=inner.step, render_mode=None)
    env = TensorVecEnv(wrapped)
    np.testing.assert_array_equal(env.reset(), [[0, 1]] * N)
    np.testing.assert_array_equal(env.step(np.zeros((N, 1)))[0], [[1, 1]] * N)
    assert env.spec.id == "Simulator-v0"


def test_time_outs_are_apart_from_deaths():
    env = TensorVecEnv(Simulator())
    env.reset()
    cuts = {}
    for step in range(1, 7):
        _, _, dones, infos = env.step(np.zeros((N, 1)))
        for i in np.flatnonzero(dones).tolist():
            cuts[step, i] = infos[i]["TimeLimit.truncated"]
    # row 3 dies and is cut in the same step
    assert cuts == {(3, 0): False, (4, 1): False, (5, 2): False, (6, 0): False, (6, 3): False}
    env.envs.lives = 9.0
    cut = [env.step(np.zeros((N, 1)))[3][0].get("TimeLimit.truncated") for _ in range(6)]
    assert cut == [None] * 5 + [True]


@pytest.mark.parametrize("how", [{"auto_reset": False}, {"tells_last": True}])
def test_the_last_observation_is_that_of_the_simulator(how):
    """Also in what the cost is computed from, and with a wrapper that knows no ``env_ids``."""
    wrapped = gym.wrappers.OrderEnforcing(Gymnasiums(**how))
    env = TensorVecEnv(wrapped, cost=lambda obs, a, after, extras: after[:, 0] - obs[:, 0])
    env.reset()
    for step in range(1, 9):
        obs, _, dones, infos = env.step(np.zeros((N, 1)))
        assert [info["cost"] for info in infos] == [1.0] * N
        for i in np.flatnonzero(dones).tolist():
            np.testing.assert_array_equal(
                infos[i].pop("terminal_observation"), [3 + i, 1 + step // (4 + i)]
            )
            np.testing.assert_array_equal(obs[i], [0, 2 + step // (4 + i)])
    np.testing.assert_array_equal(obs, [[2, 3], [0, 3], [3, 2], [2, 2]])


class Limited(Simulator):
    """Every end is a termination, and ``extras["time_outs"]`` says which are none."""

    def step(self, action: th.Tensor) -> Any:
        obs, reward, died, late, extras = super().step(action)
        return obs, reward, died | late, th.zeros_like(late), {**extras, "time_outs": late}


def test_time_outs_may_be_told_apart():
    env = TensorVecEnv(Limited())
    env.envs.lives = 5.0  # row 0 dies, the others are cut
    env.reset()
    steps = [env.step(np.zeros((N, 1))) for _ in range(6)]
    assert steps[4][2].tolist() == [True, False, False, False]
    assert steps[4][3][0]["TimeLimit.truncated"] is False
    assert steps[5][2].tolist() == [False, True, True, True]
    assert [info["TimeLimit.truncated"] for info in steps[5][3][1:]] == [True] * 3


def test_a_function_of_tensors_charges():
    seen = []

    def cost(obs: th.Tensor, actions: th.Tensor, next_obs: th.Tensor, extras: Any) -> th.Tensor:
        seen.append((obs[:, 0].tolist(), next_obs[:, 0].tolist()))
        return actions[:, 0].abs() + obs[:, 0]

    env = TensorVecEnv(Simulator(), cost=cost, group="actor")
    env.reset()
    env.step(np.full((N, 1), -0.5))
    infos = env.step(np.full((N, 1), -0.5))[3]
    assert [info["cost"] for info in infos] == [1.5] * N
    assert seen[1] == ([1.0] * N, [2.0] * N)


def test_it_trains():
    env = make_vec_env(TensorVecEnv(Simulator()), seed=0)
    model = PPOLag("MlpPolicy", env, n_steps=30, batch_size=30, cost_limit=2.0).learn(240)
    assert model.costs.latest[0] == 1.0 and env.episode_count > 40
    assert sorted({float(c[0]) for c in model.costs.latest}) == [1.0, 2.0, 3.0, 4.0]


class Gymnasiums(Simulator, gym.Env):
    """As those of Isaac Lab, which ``gymnasium.make`` may wrap."""

    def reset(self, *, seed: Any = None, options: Any = None, env_ids: Any = None) -> Any:
        return super().reset(seed=seed, env_ids=env_ids)


class FourValues(Simulator):
    def step(self, action: th.Tensor) -> Any:
        obs, reward, died, late, extras = super().step(action)
        return obs, reward, died | late, extras


class LastOfFew(Simulator):
    def step(self, action: th.Tensor) -> Any:
        return *super().step(action)[:4], {**self.extras, "final_obs": {"actor": self.shown[:1]}}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TensorVecEnv(SimpleNamespace(num_envs=2)), "has no device"),
        (lambda: TensorVecEnv(Simulator(), group="actr"), "did you mean 'actor'"),
        (
            lambda: stepped("costs"),
            r"cost='costs' .* extras: \['log', 'cost'\]",
        ),
        (lambda: stepped(lambda *_: th.zeros(N, 1)), "is no tensor of 4 numbers"),
        (
            lambda: TensorVecEnv(gym.wrappers.TimeLimit(Gymnasiums(), 5)),
            "TimeLimit ends all rows at once: set the episode length of Gymnasiums",
        ),
        (lambda: stepped("cost", FourValues()), "step returned 4 values, not five"),
        (lambda: stepped(lambda *_: np.zeros(N)), "is no tensor of 4 numbers"),
        (lambda: stepped("cost", LastOfFew()), r"'final_obs'\] has no tensor of shape \(4, 2\)"),
    ],
)
def test_what_can_not_be_is_a_line(make, message):
    with pytest.raises((TypeError, ValueError), match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def stepped(cost: Any, simulator: Any = None) -> Any:
    env = TensorVecEnv(simulator or Simulator(), cost=cost)
    env.reset()
    return env.step(np.zeros((N, 1)))


@pytest.mark.slow
def test_mjlab_trains_on_a_processor():
    """Its velocity task within a limit on the torques of its joints [N m]."""
    envs = pytest.importorskip("mjlab.envs")
    metrics = pytest.importorskip("mjlab.managers.metrics_manager")
    from mjlab.tasks.registry import load_env_cfg

    def torque(env: Any) -> th.Tensor:
        env.extras["cost"] = env.scene["robot"].data.actuator_force.abs().mean(dim=1)
        return env.extras["cost"]

    cfg = load_env_cfg("Mjlab-Velocity-Flat-Unitree-Go1")
    cfg.scene.num_envs, cfg.episode_length_s, cfg.auto_reset = 8, 1.0, False
    cfg.metrics["cost"] = metrics.MetricsTermCfg(func=torque)
    env = make_vec_env(TensorVecEnv(envs.ManagerBasedRlEnv(cfg, device="cpu")), seed=0)
    model = PPOLag("MlpPolicy", env, n_steps=60, batch_size=120, cost_limit=10.0).learn(960)
    assert env.episode_count >= 16 and model.costs.horizon <= 50
    assert 0.0 < model.costs.episode_cost[0] < 500.0

"""Advantages and returns against hand calculations and against SB3's own."""

import numpy as np
import pytest
import torch as th
from cost_envs import CostPoint
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.env_util import make_vec_env

from sb3_guard.algorithms import CPO
from sb3_guard.algorithms.common.advantage import discounted_returns, gae
from sb3_guard.algorithms.common.buffers import CostRolloutBuffer


def test_gae_by_hand() -> None:
    """Four steps, γ = 0.5, λ = 0.5: an episode of two steps, then the rollout cuts the next."""
    rewards = np.array([[1.0], [2.0], [3.0], [4.0]])
    values = np.array([[0.5], [1.0], [1.5], [2.0]])
    starts = np.array([[1], [0], [1], [0]])
    last, dones = np.array([6.0]), np.array([False])
    # errors: 1 + .5·1 - .5 = 1;  2 - 1 = 1 (ends);  3 + .5·2 - 1.5 = 2.5;  4 + .5·6 - 2 = 5
    # sums:   1 + .25·1 = 1.25;   1;                  2.5 + .25·5 = 3.75;    5
    expected = np.array([[1.25], [1.0], [3.75], [5.0]])
    np.testing.assert_allclose(gae(rewards, values, starts, last, dones, 0.5, 0.5), expected)
    # returns: 1 + .5·2;  2;  3 + .5·7;  4 + .5·6
    returns = discounted_returns(rewards, starts, last, dones, 0.5)
    np.testing.assert_allclose(returns, [[2.0], [2.0], [6.5], [7.0]])


def test_last_step_that_ends_is_not_bootstrapped() -> None:
    rewards, values = np.ones((1, 1)), np.zeros((1, 1))
    args = (np.ones((1, 1)), np.array([9.0]), np.array([True]))
    assert gae(rewards, values, *args, 0.9, 0.9)[0, 0] == 1.0
    assert discounted_returns(rewards, *args, 0.9)[0, 0] == 1.0


@pytest.mark.parametrize("gae_lambda", [0.0, 0.9, 1.0])
def test_gae_agrees_with_sb3_for_every_cost(gae_lambda: float) -> None:
    rng = np.random.default_rng(0)
    T, n, m = 40, 3, 2
    rewards, values = rng.normal(size=(2, T, n, m)).astype(np.float32)
    starts = (rng.random((T, n)) < 0.2).astype(np.float32)
    last, dones = rng.normal(size=(n, m)).astype(np.float32), rng.random(n) < 0.5
    ours = gae(rewards, values, starts, last, dones, 0.97, gae_lambda)
    box = spaces.Box(-1, 1, (1,))
    for i in range(m):
        buffer = RolloutBuffer(T, box, box, "cpu", gae_lambda, 0.97, n)
        buffer.rewards, buffer.values, buffer.episode_starts = (
            rewards[..., i],
            values[..., i],
            starts,
        )
        buffer.compute_returns_and_advantage(th.as_tensor(last[:, i]), dones)
        np.testing.assert_allclose(ours[..., i], buffer.advantages, rtol=1e-4, atol=1e-5)


def test_buffer_keeps_transitions_together() -> None:
    """Flattening and shuffling move a transition's reward and its costs alike."""
    box = spaces.Box(-np.inf, np.inf, (1,))
    buffer = CostRolloutBuffer(5, box, box, "cpu", n_envs=3, n_costs=2)
    for t in range(5):
        label = 10 * t + np.arange(3, dtype=np.float32)
        buffer.costs[t] = np.stack([label, label + 100], axis=1)
        buffer.add(label[:, None], label[:, None], label, np.zeros(3), th.zeros(3), th.zeros(3))
    buffer.compute_returns_and_advantage(th.zeros(3), np.ones(3, dtype=bool))
    buffer.compute_cost_returns_and_advantage(np.zeros((3, 2), np.float32), np.ones(3, dtype=bool))
    expected = buffer.cost_advantages.copy()
    batch = next(buffer.get())
    label = batch.observations[:, 0]
    th.testing.assert_close(batch.costs, th.stack([label, label + 100], dim=1))
    for observation, advantage in zip(label, batch.cost_advantages, strict=True):
        t, i = divmod(int(observation), 10)
        np.testing.assert_array_equal(advantage.numpy(), expected[t, i])


@pytest.mark.parametrize("terminate", [False, True])
def test_time_outs_bootstrap_costs_on_a_copy(terminate: bool) -> None:
    """A truncated episode adds γ V_c(terminal observation), a terminated one nothing."""
    env = make_vec_env(lambda: CostPoint(episode_length=7, terminate=terminate), 2, seed=0)
    arguments = {"n_steps": 16, "n_critic_updates": 1, "cost_gamma": 0.8, "seed": 0}
    model = CPO("MlpPolicy", env, cost_limit=0.0, cost_gae_lambda=0.97, **arguments)
    model.cost_units = np.full(1, 3.0, np.float32)  # as after a cost
    terminals: list[tuple[int, np.ndarray]] = []

    def record(local: dict, _: dict) -> bool:
        terminals.extend(
            (local["n_steps"], info["terminal_observation"])
            for info in local["infos"][:1]
            if "terminal_observation" in info
        )
        return True

    before = {}
    train = model.train

    def spy() -> None:
        buffer = model.rollout_buffer
        before["bootstraps"] = buffer.cost_bootstraps[:, 0, 0].copy()
        before["costs"] = buffer.costs[:, 0, 0].copy()
        before["advantages"] = buffer.cost_advantages[:, 0, 0].copy()
        before["returns"] = buffer.cost_returns[:, 0, 0].copy()
        for name, observations in (
            ("values", buffer.observations[:, 0]),
            ("terminal", np.stack([o for _, o in terminals])),
            ("last", model._last_obs),
        ):
            predicted = model.cost_critic.predict(th.as_tensor(observations))
            before[name] = 3.0 * predicted[:, 0].numpy()
        train()

    model.train = spy  # type: ignore[method-assign]
    model.learn(32, callback=record)
    steps = [step for step, _ in terminals]
    assert steps == [6, 13]
    expected = np.zeros(16)
    if not terminate:
        expected[steps] = 0.8 * before["terminal"]
    np.testing.assert_allclose(before["bootstraps"], expected, rtol=1e-5)
    # The whole recursion once more, step by step.
    advantage, paid = 0.0, before["last"][0]
    for t in reversed(range(16)):
        ends = t in steps
        following = 0.0 if ends else (before["last"][0] if t == 15 else before["values"][t + 1])
        paid = before["costs"][t] + expected[t] + 0.8 * (0.0 if ends else paid)
        assert before["returns"][t] == pytest.approx(paid, rel=1e-4, abs=1e-6)
        cost = before["costs"][t] + expected[t]
        error = cost + 0.8 * following - before["values"][t]
        advantage = error + 0.8 * 0.97 * (0.0 if ends else advantage)
        assert before["advantages"][t] == pytest.approx(advantage, rel=1e-4, abs=1e-6)

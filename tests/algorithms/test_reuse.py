"""Earlier rollouts in the cost surrogates: weights, gradients, what is kept."""

from typing import Any

import numpy as np
import pytest
import torch as th
from cost_envs import CostPoint, RandomCostEnv
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import (
    VecEnvWrapper,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)

from sb3_guard.algorithms import CPO, PCPO, SCPO
from sb3_guard.algorithms.common.advantage import gae
from sb3_guard.algorithms.common.reuse import PooledSurrogates, importance
from sb3_guard.algorithms.common.trust_region import CostSurrogates, Region
from sb3_guard.algorithms.common.vectors import assign, flatten
from sb3_guard.algorithms.fast.actor import actor_of


def points(n_envs: int = 2, **kwargs: Any) -> Any:
    return make_vec_env(lambda: CostPoint(**{"episode_length": 30, **kwargs}), n_envs, seed=0)


def make(cls: Any = CPO, env: Any = None, **kwargs: Any) -> Any:
    arguments = {"n_steps": 40, "n_critic_updates": 3, "seed": 0, "device": "cpu"}
    arguments |= {"cost_limit": 0.0, "reuse": 2, "policy_kwargs": {"net_arch": [8]}}
    return cls("MlpPolicy", points() if env is None else env, **{**arguments, **kwargs})


def test_weights_by_hand() -> None:
    """Ratios 1, 2 and 4 of seven: 49 / (1 + 4 + 16) equal rows; their scale does not matter."""
    for scale in (1.0, 1e-30, 1e30):
        weights, size = importance(th.log(th.tensor([1.0, 2.0, 4.0]).double() * scale))
        assert weights.tolist() == pytest.approx([1 / 7, 2 / 7, 4 / 7])
        assert size == pytest.approx(49 / 21)
    assert importance(th.zeros(5))[1] == pytest.approx(5.0)


class _Raw(VecEnvWrapper):
    """Remembers all observations as the environments report them."""

    def __init__(self, venv: Any) -> None:
        super().__init__(venv)
        self.seen: list[np.ndarray] = []
        self.ends: list[tuple[int, int, np.ndarray]] = []

    def reset(self) -> Any:
        self.seen.append(self.venv.reset().copy())
        return self.seen[-1]

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones):
            self.ends.append((len(self.seen) - 1, i, infos[i]["terminal_observation"].copy()))
        self.seen.append(observations.copy())
        return observations, rewards, dones, infos


class _Watched(CPO):
    """Keeps the last update's region, and what rollouts stored."""

    def step(self, region: Region) -> th.Tensor:
        self.region, self.before = region, flatten(region.actor.parameters).clone()
        return super().step(region)


@pytest.mark.parametrize("normalize", [True, False])
def test_pooled_surrogates_against_a_loop(normalize: bool) -> None:
    """Rows, weights, advantages and shares written out for the third update."""
    raw = _Raw(points(hazard=(-1.0, 0.0)))
    env = VecNormalize(raw, norm_reward=False) if normalize else raw
    model = make(_Watched, env, cost_gae_lambda=0.7, reuse=3)
    kept: list[dict[str, np.ndarray]] = []
    critics: list[Any] = []
    train = model.train

    def spy() -> None:
        buffer = model.rollout_buffer
        names = ("actions", "log_probs", "costs", "episode_starts", "observations")
        kept.append({name: getattr(buffer, name).copy() for name in names})
        critics.append({k: v.clone() for k, v in model.cost_critic.state_dict().items()})
        kept[-1]["units"] = model.cost_units.copy()
        kept[-1]["advantages"] = buffer.cost_advantages.copy()
        statistics = env.obs_rms.copy() if normalize else None
        train()
        model.statistics = statistics  # at the beginning of the last update

    model.train = spy
    model.learn(3 * 80)
    statistics = model.statistics
    moved = flatten(model.region.actor.parameters).clone()
    policy, region = model.policy, model.region
    assign(region.actor.parameters, model.before)
    critic = model.cost_critic
    critic.load_state_dict(critics[-1])

    def today(observations: np.ndarray) -> th.Tensor:
        if statistics is not None:
            scaled = (observations - statistics.mean) / np.sqrt(statistics.var + env.epsilon)
            observations = np.clip(scaled, -10.0, 10.0)
        return th.as_tensor(np.asarray(observations, np.float32))

    def log_prob(observations: th.Tensor, actions: np.ndarray) -> th.Tensor:
        return policy.get_distribution(observations).log_prob(th.as_tensor(actions))

    gamma, units = 0.99, kept[-1]["units"][0]
    pieces, sizes = [], []
    for number, rollout in enumerate(kept[:-1]):
        states = today(np.array(raw.seen[40 * number : 40 * number + 41]))  # [41, 2, 4]
        values = units * critic(states.reshape(-1, 4)).detach().numpy().reshape(41, 2)
        costs = rollout["costs"][..., 0].copy()
        for step, i, end in raw.ends:
            if step // 40 == number:
                costs[step % 40, i] += gamma * units * critic(today(end[None])).item()
        with th.no_grad():
            now = log_prob(states[:40].reshape(80, 4), rollout["actions"].reshape(80, 2))
        now = now.numpy().reshape(40, 2)
        ratio = np.exp(now - rollout["log_probs"])
        advantages = np.zeros((40, 2))
        over = {(step, i) for step, i, _ in raw.ends}
        for i in range(2):
            later = 0.0
            for t in reversed(range(40)):
                on = (40 * number + t, i) not in over
                error = costs[t, i] + gamma * on * values[t + 1, i] - values[t, i]
                later = error + gamma * 0.7 * on * later
                advantages[t, i] = later
                later *= min(1.0, ratio[t, i])
        weights = ratio / ratio.sum()
        centred = weights * (advantages - (weights * advantages).sum())
        sizes.append(1.0 / (weights**2).sum())
        pieces.append((states[:40].reshape(80, 4), rollout["actions"].reshape(80, 2), now, centred))
    own = kept[-1]["advantages"][..., 0]
    states = th.as_tensor(kept[-1]["observations"]).reshape(80, 4)
    with th.no_grad():
        now = log_prob(states, kept[-1]["actions"].reshape(80, 2)).numpy().reshape(40, 2)
    pieces.append((states, kept[-1]["actions"].reshape(80, 2), now, (own - own.mean()) / 80))
    sizes.append(80.0)

    def surrogate() -> th.Tensor:
        total = th.zeros(())
        for (states, actions, then, weighted), size in zip(pieces, sizes, strict=True):
            ratio = th.exp(log_prob(states, actions) - th.as_tensor(then.ravel()))
            share = size / np.sum(sizes)
            total = total + share * ((ratio - 1.0) * th.as_tensor(weighted.ravel()).float()).sum()
        return total

    expected = flatten(th.autograd.grad(surrogate(), region.actor.parameters))
    th.testing.assert_close(region.cost_gradients[0], expected, rtol=1e-3, atol=1e-5)
    assert region.costs.rollouts == pytest.approx(np.sum(sizes) / 80.0, rel=1e-4)
    assign(region.actor.parameters, moved)
    with th.no_grad():
        change, (ratio, _) = surrogate(), region.actor.evaluate()
        assert abs(float(change)) > 1e-5
        th.testing.assert_close(region.costs.changes(ratio)[0], change, rtol=1e-3, atol=1e-6)
    assert [rollout.number for rollout in model.earlier] == [80, 160, 240]


def test_without_earlier_rollouts_it_is_the_same_update() -> None:
    for updates, same in ((1, True), (2, False)):
        one, other = (
            make(env=points(hazard=(-1.0, 0.0)), reuse=n).learn(80 * updates).get_parameters()
            for n in (0, 5)
        )
        equal = [th.equal(value, other["policy"][key]) for key, value in one["policy"].items()]
        assert all(equal) is same


class _Compared(CPO):
    """Compares its cost gradient with that of a rollout twenty times as long."""

    def step(self, region: Region) -> th.Tensor:
        if isinstance(region.costs, PooledSurrogates) and len(region.costs.parts) == self.reuse:
            truth, alone = self._truth(), CostSurrogates.gradients(region.costs)[0]
            pooled = region.cost_gradients[0]
            distances = [float((g - truth).norm() / truth.norm()) for g in (alone, pooled)]
            self.distances.append(distances)
        return super().step(region)

    @th.no_grad()
    def _truth(self) -> th.Tensor:
        env = make_vec_env(CostPoint, 20, seed=len(self.distances))
        observation = env.reset()
        kept: list[Any] = []
        for _ in range(100):  # two episodes
            actions = self.policy(th.as_tensor(observation))[0]
            after, _, dones, infos = env.step(np.clip(actions.numpy(), -1.0, 1.0))
            costs = [info["cost"] for info in infos]
            for i in np.flatnonzero(dones):
                end = th.as_tensor(infos[i]["terminal_observation"])[None]
                costs[i] += 0.99 * self.cost_units[0] * self.cost_critic(end).item()
            kept.append((observation, actions.numpy(), costs, dones))
            observation = after
        states, actions, costs, dones = (np.array(each) for each in zip(*kept, strict=True))
        seen = np.concatenate([states, observation[None]])
        values = self.cost_units[0] * self.cost_critic(th.as_tensor(seen.reshape(-1, 4))).numpy()
        values = values.reshape(101, 20)
        starts = np.concatenate([np.ones((1, 20)), dones[:-1]])
        advantages = gae(costs, values[:-1], starts, values[-1], dones[-1], 0.99, 0.5)
        weights = th.as_tensor((advantages - advantages.mean()).ravel() / advantages.size).float()
        rows = th.as_tensor(states.reshape(-1, 4)), th.as_tensor(actions.reshape(-1, 2))
        with th.enable_grad():
            return actor_of(self.policy, *rows).score(weights)


def test_the_cost_gradient_is_closer_to_that_of_a_longer_rollout() -> None:
    model = make(
        _Compared,
        make_vec_env(CostPoint, 1, seed=1),
        n_steps=100, n_critic_updates=20, cost_limit=1.0, reuse=9, cost_gae_lambda=0.5,
        target_kl=0.005, seed=1,
    )  # fmt: skip
    model.distances = []
    model.learn(100 * 25)
    alone, pooled = np.mean(model.distances, axis=0)
    assert len(model.distances) == 16
    assert pooled < 0.6 * alone


@pytest.mark.parametrize("cls", [CPO, PCPO, SCPO])
def test_every_kind_of_observation_and_action(cls: Any) -> None:
    image = spaces.Box(0, 255, (36, 36, 1), np.uint8)
    vector = spaces.Box(-1.0, 1.0, (3,), np.float32)
    for policy, space, action, keys in (
        ("MlpPolicy", vector, spaces.MultiDiscrete([2, 3]), None),
        ("CnnPolicy", image, vector, None),
        ("MultiInputPolicy", spaces.Dict({"a": vector, "b": image}), spaces.Discrete(3), ["a"]),
    ):
        env = make_vec_env(lambda s=space, a=action: RandomCostEnv(s, a), 2, seed=0)
        if policy != "MlpPolicy":
            env = VecTransposeImage(env)
        if policy != "CnnPolicy":
            env = VecNormalize(env, norm_obs_keys=keys)
        arguments = {"n_steps": 20, "n_critic_updates": 1, "seed": 0, "device": "cpu"}
        model = cls(policy, env, cost_limit=0.0, reuse=1, **arguments)
        model.learn(120)
        (rollout,) = model.earlier
        kept = rollout.observations
        assert (kept["b"] if isinstance(kept, dict) else kept).shape[:2] == (20, 2)
        assert model.logger.name_to_value["train/rollouts_used"] > 1.0


def test_a_frame_stack_around_the_statistics_is_refused() -> None:
    stacked = VecFrameStack(VecNormalize(points()), 3)
    with pytest.raises(ValueError, match=r"reuse=2: .*VecFrameStack"):
        make(env=stacked)
    make(env=stacked, reuse=0).learn(80)
    model = make(env=VecFrameStack(points(), 3)).learn(160)
    assert model.earlier[0].observations.shape == (40, 2, 12)


def test_a_model_file_holds_no_rollouts(tmp_path: Any) -> None:
    model = make().learn(160)
    model.save(tmp_path / "model")
    again = CPO.load(tmp_path / "model", env=points())
    assert len(model.earlier) == 2 and again.earlier == []
    again.learn(80, reset_num_timesteps=False)
    assert len(again.earlier) == 1

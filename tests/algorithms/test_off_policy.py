"""SAC-, TD3- and TQC-Lagrangian: SB3's own while the limit holds, and what costs add to them."""

import itertools
import pickle
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch as th
from agents import points
from gymnasium import spaces
from known_optima import Outcomes, problems
from sb3_contrib import TQC
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_guard import SACLag, TD3Lag, TQCLag, evaluate_policy
from sb3_guard.algorithms.common.replay_buffers import (
    CostDictReplayBuffer,
    CostNStepReplayBuffer,
    CostReplayBuffer,
    CostReplayBufferSamples,
)


def settings() -> dict[str, Any]:
    """Small and quick; SB3 writes into ``policy_kwargs``, so they are remade."""
    return {
        "learning_starts": 60,
        "seed": 0,
        "device": "cpu",
        "batch_size": 16,
        "buffer_size": 2_000,
        "policy_kwargs": {"net_arch": [16]},
    }


every = pytest.mark.parametrize("cls", [SACLag, TD3Lag, TQCLag])
# Of what they share: the quickest of them, the others with the slow tests.
shared = pytest.mark.parametrize(
    "cls", [TD3Lag, *(pytest.param(cls, marks=pytest.mark.slow) for cls in (SACLag, TQCLag))]
)


def noise(n: int = 2) -> NormalActionNoise:
    return NormalActionNoise(np.zeros(n), np.full(n, 0.1))


def state_of(model: Any) -> list[Any]:
    """Weights, optimizers' moments and generators as plain values."""
    tensors = [*model.policy.state_dict().values(), th.get_rng_state()]
    for owner in (model.actor, model.critic):
        for entry in owner.optimizer.state_dict()["state"].values():
            tensors += entry.values()
    if getattr(model, "log_ent_coef", None) is not None:
        tensors.append(model.log_ent_coef)
    _, keys, position, *_ = np.random.get_state()  # noqa: NPY002
    return [*(tensor.tolist() for tensor in tensors), keys.tolist(), position]


@pytest.mark.parametrize(
    ("ours", "theirs", "more"),
    [
        (SACLag, SAC, {"gradient_steps": 2, "target_update_interval": 2, "ent_coef": "auto"}),
        (SACLag, SAC, {"ent_coef": 0.1, "use_sde": True}),
        (TD3Lag, TD3, {"n_steps": 3}),
        (TQCLag, TQC, {"gradient_steps": 2, "target_update_interval": 2, "ent_coef": "auto"}),
        (TQCLag, TQC, {"ent_coef": 0.1, "use_sde": True, "top_quantiles_to_drop_per_net": 5}),
    ],
)
def test_while_the_limit_holds_it_is_sb3s_bit_for_bit(ours: Any, theirs: Any, more: Any) -> None:

    def kwargs() -> dict[str, Any]:
        return settings() | more | ({"action_noise": noise()} if ours is TD3Lag else {})

    expected = theirs("MlpPolicy", VecNormalize(points()), **kwargs()).learn(200)
    logged = dict(expected.logger.name_to_value)
    state = state_of(expected)
    model = ours("MlpPolicy", VecNormalize(points()), cost_limit=1e6, **kwargs()).learn(200)
    assert state_of(model) == state
    assert model.total_cost > 0.0 and float(model.multiplier.value[0]) == 0.0
    for name in ("actor_loss", "critic_loss", "n_updates", "learning_rate"):
        assert model.logger.name_to_value[f"train/{name}"] == pytest.approx(
            logged[f"train/{name}"], rel=1e-6
        ), name
    assert model.logger.name_to_value["train/cost_critic_loss"] > 0.0


@every
def test_the_actor_descends_the_lagrangian(cls: Any) -> None:
    """Its loss and gradient by hand, (α log π - Q + Σ w_i Q_Ci) / (1 + Σ λ_i); α is 0 in TD3.

    w_i is λ_i in standard deviations of Q over those of Q_Ci, of the batch's own actions.
    """
    more = settings() | {"cost_keys": ("cost", "again"), "missing_cost": "zero", "cost_limit": 1.0}
    more |= {} if cls is TD3Lag else {"ent_coef": 0.1}
    model = cls("MlpPolicy", points(), **more).learn(80)
    for part in (model.actor, model.critic, model.cost_critic):
        part.optimizer.param_groups[0]["lr"] = 0.0
    model.prices, model._n_updates = np.array([0.5, 2.0]), 2  # an update of TD3's actor, too
    batch, moved = model.replay_buffer.sample(8), [*model.actor.parameters()]
    th.manual_seed(1)
    loss = model.learn_from(batch, 0)["actor_loss"]
    gradient = [part.grad.clone() for part in moved]

    th.manual_seed(1)
    at, entropy = batch.observations, 0.0
    if cls is TD3Lag:
        actions = model.actor(at)
        value = model.critic.q1_forward(at, actions)[:, 0]
    else:
        actions, log_prob = model.actor.action_log_prob(at)
        values, entropy = model.critic(at, actions), 0.1 * log_prob
        value = values.mean((1, 2)) if cls is TQCLag else th.min(*values)[:, 0]
    replayed = model.critic(at, batch.actions)
    replayed = replayed.mean((1, 2)) if cls is TQCLag else replayed[0]
    spread = model.cost_critic(at, batch.actions).std(0, correction=0)
    weight = (th.tensor([0.5, 2.0]) * replayed.std(correction=0) / spread).detach()
    expected = ((entropy - value + model.cost_critic(at, actions) @ weight) / 3.5).mean()
    assert loss == pytest.approx(expected.item(), rel=1e-5)
    th.testing.assert_close(gradient, [*th.autograd.grad(expected, moved)])


@shared
def test_targets_follow_what_learns(cls: Any, tmp_path: Path) -> None:
    """Also of a model that was saved, loaded and given other parameters."""
    cls("MlpPolicy", points(), **settings()).learn(60).save(tmp_path / "model.zip")
    assert "_targets" not in zipfile.ZipFile(tmp_path / "model.zip").read("data").decode()
    model = cls.load(tmp_path / "model.zip", points()).learn(60)
    model.set_parameters(model.get_parameters())
    pairs = [(model.cost_critic.online, model.cost_critic.target)]
    pairs.append((model.critic, model.critic_target))
    if cls is TD3Lag:
        pairs.append((model.actor, model.actor_target))
    before = [[part.clone() for part in target.parameters()] for _, target in pairs]
    model._n_updates = 1  # the next one is one of TD3's actor, too
    model.train(1, 32)
    for old, (online, target) in zip(before, pairs, strict=True):
        for was, now, goal in zip(old, target.parameters(), online.parameters(), strict=True):
            assert th.allclose(now, (1 - model.tau) * was + model.tau * goal)
            assert not th.equal(was, now)


class Clock(gymnasium.Env[Any, Any]):
    """Observes the time t = 1, 2, … within the episode; its step costs t and, as another, 10 t."""

    observation_space = spaces.Box(0.0, 100.0, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, length: int, cut: bool) -> None:
        self.length, self.cut, self.t = length, cut, 0

    def reset(self, **kwargs: Any) -> Any:
        super().reset(**kwargs)
        self.t = 1
        return np.array([1.0], np.float32), {}

    def step(self, action: Any) -> Any:
        info = {"cost": float(self.t), "ten": 10.0 * self.t}
        self.t += 1
        over = self.t > self.length
        observation = np.array([self.t], np.float32)
        return observation, 0.0, over and not self.cut, over and self.cut, info


@shared
@pytest.mark.parametrize("cut", [False, True])
def test_what_is_replayed_and_learnt_from(cls: Any, cut: bool) -> None:
    """Each row has the cost of its own step, the last one's too, and what came after it."""
    env = make_vec_env(lambda: Clock(4, cut), 3)
    more = {"cost_keys": ("cost", "ten"), "cost_limit": [10.0, 1.0], "cost_gamma": 0.8}
    model = cls("MlpPolicy", env, **more, **settings()).learn(90)
    batch = model.replay_buffer.sample(256)
    times = batch.observations[:, 0]
    th.testing.assert_close(batch.costs, th.stack([times, 10.0 * times], dim=1))
    assert {*times.tolist()} == {1.0, 2.0, 3.0, 4.0}
    # Not the observation after the reset, and no end where a time limit cut the episode.
    th.testing.assert_close(batch.next_observations[:, 0], times + 1.0)
    ends = (times == 4.0) & (not cut)
    assert th.equal(batch.dones[:, 0].bool(), ends)
    # J_C of whole episodes: 1 + 2 + 3 + 4.
    np.testing.assert_allclose(model.costs.episode_cost, [10.0, 100.0])
    np.testing.assert_allclose(model.multiplier.value[0], 0.0)
    assert float(model.multiplier.value[1]) > 0.0

    # The loss by hand, with the larger of two target values per cost.
    if cls is TQCLag:
        return
    critic = model.cost_critic
    actions = th.zeros_like(batch.actions)
    with th.no_grad():
        after = critic.target(batch.next_observations, actions)[:, :, 0]
        largest = th.stack([after[:, :2].max(1)[0], after[:, 2:].max(1)[0]], dim=1)
        target = batch.costs + 0.8 * (1.0 - ends.float()[:, None]) * largest
        values = critic.online(batch.observations, batch.actions)[:, :, 0]
        expected = float(((values - target.repeat_interleave(2, dim=1)) ** 2).mean())
    assert model.fit_cost_critic(batch, actions) == pytest.approx(expected, rel=1e-5)


@shared
@pytest.mark.parametrize("cut", [False, True])
def test_sums_of_several_steps(cls: Any, cut: bool) -> None:
    """Costs of n steps, or of those until the episode ends, discounted by γ_C, not by γ."""
    env = make_vec_env(lambda: Clock(4, cut), 3)
    model = cls(
        "MlpPolicy",
        env,
        cost_keys=("cost", "ten"),
        cost_limit=[10.0, 1.0],
        n_steps=3,
        gamma=0.9,
        cost_gamma=0.5,
        **settings(),
    )
    model.learn(96)
    batch = model.replay_buffer.sample(256)
    times = batch.observations[:, 0]
    for index, t in enumerate(times.tolist()):
        costs, discount, reached = 0.0, 1.0, t
        while reached <= min(t + 2.0, 4.0):
            costs, discount, reached = costs + discount * reached, discount * 0.5, reached + 1.0
        assert batch.costs[index].tolist() == [costs, 10.0 * costs]
        assert batch.cost_discounts[index].item() == discount
        assert batch.next_observations[index].item() == reached
        assert batch.dones[index].item() == (reached == 5.0 and not cut)
    assert model.logger.name_to_value["train/cost_critic_loss"] > 0.0


def test_several_steps_survive_saving(tmp_path: Path) -> None:
    more = {"n_steps": 3, "gamma": 0.9, "cost_gamma": 0.5}
    model = SACLag("MlpPolicy", points(), **settings(), **more).learn(100)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = SACLag.load(tmp_path / "model", env=points())
    loaded.replay_buffer = None  # as SB3's own tests do
    loaded.load_replay_buffer(tmp_path / "buffer")
    buffer = loaded.replay_buffer
    assert isinstance(buffer, CostNStepReplayBuffer)
    assert (buffer.n_steps, buffer.gamma, buffer.cost_gamma) == (3, 0.9, 0.5)
    loaded.learn(50, reset_num_timesteps=False)
    changed = SACLag.load(tmp_path / "model", env=points(), cost_gamma=0.7)
    changed.load_replay_buffer(tmp_path / "buffer")
    assert changed.replay_buffer.cost_gamma == 0.7
    one = SACLag.load(tmp_path / "model", env=points(), n_steps=1)
    assert type(one.replay_buffer) is CostReplayBuffer
    with pytest.raises(ValueError, match="must be a CostReplayBuffer of"):
        one.load_replay_buffer(tmp_path / "buffer")
    SAC("MlpPolicy", points(), buffer_size=100).save_replay_buffer(tmp_path / "theirs")
    with pytest.raises(ValueError, match="must be a CostReplayBuffer of"):
        one.load_replay_buffer(tmp_path / "theirs")
    two = TD3Lag("MlpPolicy", points(), cost_keys=("cost", "heat"), n_steps=3, cost_limit=1.0)
    with pytest.raises(ValueError, match=r"a CostNStepReplayBuffer of .* and 2 costs"):
        two.load_replay_buffer(tmp_path / "buffer")
    assert type(one.replay_buffer) is CostReplayBuffer
    one.save(tmp_path / "one")
    assert isinstance(
        SACLag.load(tmp_path / "one", env=points(), n_steps=5).replay_buffer, CostNStepReplayBuffer
    )


def test_cost_quantiles_by_hand() -> None:
    """Two costs, five quantiles of two networks each, the lowest two of the ten dropped."""
    keys = {"cost_keys": ("cost", "again"), "missing_cost": "zero", "cost_limit": [0.1, 1.0]}
    more = settings() | {"policy_kwargs": {"net_arch": [16], "n_quantiles": 5}}
    more |= {"top_quantiles_to_drop_per_net": 1, **keys}
    model = TQCLag("MlpPolicy", points(), **more).learn(80)
    batch, critic = model.replay_buffer.sample(3), model.cost_critic
    batch = batch._replace(costs=th.rand(3, 2), dones=th.tensor([[0.0], [1.0], [0.0]]))
    actions = th.rand(3, 2)
    with th.no_grad():
        after = critic.target(batch.next_observations, actions)  # [B, 4, 5]
        now = critic.online(batch.observations, batch.actions)
    losses = []
    for b, i in itertools.product(range(3), range(2)):
        pool = sorted(after[b, 2 * i : 2 * i + 2].flatten().tolist())[2:]
        targets = [
            float(batch.costs[b, i]) + 0.99 * (1.0 - float(batch.dones[b, 0])) * value
            for value in pool
        ]
        for k, j, target in itertools.product(range(2), range(5), targets):
            error = target - float(now[b, 2 * i + k, j])
            huber = 0.5 * error**2 if abs(error) <= 1.0 else abs(error) - 0.5
            losses.append(abs((j + 0.5) / 5 - (error < 0.0)) * huber)
    value = critic(batch.observations, batch.actions)
    nets = now.unflatten(1, (2, 2))
    th.testing.assert_close(value, nets.mean(dim=(2, 3)))
    assert model.fit_cost_critic(batch, actions) == pytest.approx(np.mean(losses), rel=1e-4)


def test_networks_side_by_side_are_networks() -> None:
    keys = {"cost_keys": ("cost", "again"), "missing_cost": "zero", "cost_limit": 1.0}
    model = SACLag("MlpPolicy", points(), **keys, **settings() | {"policy_kwargs": {}})
    networks = model.cost_critic.online
    observations, actions = th.randn(5, *points().observation_space.shape), th.rand(5, 2)
    together = networks(observations, actions)
    assert together.shape == (5, 4, 1) and len({*together[0, :, 0].tolist()}) == 4
    for k in range(4):
        x = th.cat([observations, actions], dim=1)
        for i in (0, 2, 4):
            layer = networks.layers[i]
            x = x @ layer.weight[k] + layer.bias[k]
            x = x if i == 4 else x.relu()
        th.testing.assert_close(together[:, k], x)


@shared
def test_multipliers_follow_ended_episodes_once_and_not_before_their_time(cls: Any) -> None:
    """Episodes of 30 steps: λ moves at their ends alone, by η T / t, once ``lambda_starts``."""
    more = {"cost_limit": 0.01, "lambda_lr": 0.1, "proportional_gain": 0.0, "train_freq": 10}
    model = cls("MlpPolicy", points(1), lambda_starts=100, gradient_steps=3, **more, **settings())
    seen: dict[int, float] = {}

    def look(names: dict[str, Any], _: Any) -> bool:
        seen[names["self"].num_timesteps] = float(model.multiplier.value[0])
        return True

    model.learn(180, callback=look)
    assert seen[101] == 0.0  # the episodes until then broke the limit as well
    assert [seen[n] for n in (119, 121, 125, 151)] == pytest.approx([0.0, 0.025, 0.025, 0.045])


def given(costs: Iterable[float], n_envs: int, length: int) -> Any:
    """Environments whose episodes, in the order in which they begin, cost what is given."""
    to_come = iter(costs)

    class Given(Clock):
        def reset(self, **kwargs: Any) -> Any:
            self.cost = next(to_come) / length
            return super().reset(**kwargs)

        def step(self, action: Any) -> Any:
            *others, info = super().step(action)
            return *others, {**info, "cost": self.cost}

    return make_vec_env(lambda: Given(length, cut=True), n_envs)


@shared
def test_multipliers_follow_the_mean_of_episodes(cls: Any) -> None:
    """Most episodes cost nothing, each tenth 60: 6 on average, which is what the limit is about."""
    values = []
    for limit in (5.0, 7.0):
        env = given(itertools.cycle([0.0] * 9 + [60.0]), 1, length=3)
        model = cls("MlpPolicy", env, cost_limit=limit, **settings()).learn(300)
        values.append(float(model.multiplier.integral[0]))
    assert values[0] > 0.1 and values[1] == 0.0


@shared
@pytest.mark.parametrize("sign", [1.0, -1.0])  # at most 5 of a cost; at least 5 of something
def test_a_safety_margin_is_a_share_of_the_limit(cls: Any, sign: float) -> None:
    """Episodes 0.2 within the limit break it by 0.8 and 1.8 with margins of 20 and 40 %."""
    gains = {"cost_limit": 5.0 * sign, "lambda_lr": 0.1, "proportional_gain": 0.0}
    gains |= {"lambda_starts": 0.0}
    values = []
    for margin in (0.0, 0.2, 0.4):
        env = given(itertools.repeat(5.0 * sign - 0.2), 1, length=4)
        model = cls("MlpPolicy", env, safety_margin=margin, **gains, **settings())
        values.append(float(model.learn(200).multiplier.integral[0]))
    assert values[0] == 0.0 and values[2] / values[1] == pytest.approx(1.8 / 0.8)


@shared
@pytest.mark.parametrize(("n_envs", "total"), [(1, 400), (8, 800)])
def test_a_training_moves_multipliers_as_far_however_many_episodes_it_has(
    cls: Any, n_envs: int, total: int
) -> None:
    """From 40 % of it on: η Δ ∫ dt / t with η = 2 and half a limit's worth of violation."""
    env = given(itertools.repeat(150.0), n_envs, length=4)
    more = {"cost_limit": 100.0, "lambda_lr": 2.0, "proportional_gain": 0.0, "lambda_starts": 0.4}
    model = cls("MlpPolicy", env, **more, **settings() | {"train_freq": 2}).learn(total)
    assert float(model.multiplier.value[0]) == pytest.approx(np.log(1.0 / 0.4), abs=0.1)


def paid(size: float) -> Any:
    """Two environments with two action dimensions that pay ``size`` and its negative by turns."""

    class Paid(Clock):
        action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

        def step(self, action: Any) -> Any:
            observation, _, *others = super().step(action)
            return observation, size * (-1.0) ** self.t, *others

    return make_vec_env(lambda: Paid(4, cut=True), 2)


@pytest.mark.parametrize(
    ("ent_coef", "size", "start"),
    [
        ("auto_reward", 0.02, 0.01),
        ("auto_reward", 0.0, 1.0),  # nothing to go by
        ("auto", 0.02, 1.0),
        ("auto_0.1", 0.02, 0.1),
    ],
)
def test_the_entropy_coefficient_starts_where_it_is_told(
    ent_coef: str, size: float, start: float
) -> None:
    """At the mean absolute reward by the number of action dimensions; once, not at each."""
    model = SACLag("MlpPolicy", paid(size), ent_coef=ent_coef, cost_limit=1e6, **settings())
    model.learn(62)
    assert model._n_updates == 1
    rate = model.learning_rate  # Adam's first step of log α
    assert abs(np.log(float(model.log_ent_coef.exp()) / start)) == pytest.approx(rate, rel=0.01)
    assert model.ent_coef == ent_coef
    model.set_env(paid(1000.0))
    model.learn(4, reset_num_timesteps=False)
    assert float(model.log_ent_coef.exp()) == pytest.approx(start, rel=0.01)


def test_the_entropy_coefficient_starts_at_the_rewards_that_are_learnt_from() -> None:
    env = VecNormalize(paid(20.0), gamma=0.0)
    model = SACLag("MlpPolicy", env, cost_limit=1e6, **settings()).learn(62)
    start = env.normalize_reward(np.array(20.0)) / 2
    assert float(model.log_ent_coef.exp()) == pytest.approx(float(start), rel=1e-3)


@shared
def test_random_actions_do_not_move_multipliers(cls: Any) -> None:
    """11 steps of 8 environments, whose first action after 81 steps is the policy's."""
    env = given([100.0] * 88 + [0.0] * 40, 8, length=1)
    more = {"cost_limit": 5.0, "gradient_steps": -1}
    model = cls("MlpPolicy", env, **more, **settings() | {"learning_starts": 81}).learn(96)
    assert model._n_updates == 16 and float(model.multiplier.value[0]) == 0.0
    assert np.ravel(model.latest_costs).tolist() == [0.0] * 8


def test_a_loaded_model_counts_the_episodes_that_have_ended(tmp_path: Path) -> None:
    waiting = {"train_freq": 100, "learning_starts": 0, "cost_limit": 1.0}
    model = SACLag("MlpPolicy", given(itertools.count(), 1, 10), **settings() | waiting)
    model.learn(100, callback=lambda names, _: names["self"].num_timesteps < 25)
    model.save(tmp_path / "model")
    again = SACLag.load(tmp_path / "model", env=given(itertools.count(5), 1, 10))
    again.learn(1, reset_num_timesteps=False)
    np.testing.assert_allclose(np.ravel(again.latest_costs), [0, 1, *range(5, 15)])
    assert float(again.costs.episode_cost[0]) == pytest.approx(np.mean([0, 1, *range(5, 15)]))


def test_a_callback_that_stops_loses_no_cost() -> None:
    """Stopped at the last step of an episode, which SB3 does not store: the episode has ended."""

    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            return self.num_timesteps % 30 != 0

    model = SACLag("MlpPolicy", points(1), **settings())
    for _ in range(2):
        model.learn(100, Stop(), reset_num_timesteps=False)
    assert model.num_timesteps == 60 and model.costs.episodes.lengths.tolist() == [0]
    assert model.total_cost == pytest.approx(sum(float(cost[0]) for cost in model.costs.latest))
    assert len(model.costs.latest) == 2


@pytest.mark.parametrize(
    ("kind", "steps"), [("flat", 5), ("flat, memory saved", 70), ("dictionary", 70)]
)
def test_a_buffer_is_saved_without_its_empty_rows(kind: str, steps: int) -> None:
    dictionary, memory = kind == "dictionary", kind == "flat, memory saved"
    box = spaces.Box(-1.0, 1.0, (3,))
    space: Any = spaces.Dict({"a": box, "b": box}) if dictionary else box
    cls = CostDictReplayBuffer if dictionary else CostReplayBuffer
    kwargs = {"handle_timeout_termination": not memory, "optimize_memory_usage": memory}
    buffer = cls(128, space, box, device="cpu", n_envs=2, n_costs=2, **kwargs)
    space.seed(0)
    box.seed(0)
    for row in range(steps):
        obs: Any = [space.sample() for _ in range(4)]
        if dictionary:
            obs = [
                {k: np.stack([one[k], two[k]]) for k in "ab"}
                for one, two in itertools.pairwise(obs)
            ]
        else:
            obs = [np.stack(pair) for pair in itertools.pairwise(obs)]
        buffer.costs[buffer.pos] = row
        zeros = np.zeros(2)
        buffer.add(obs[0], obs[1], np.stack([box.sample()] * 2), zeros, zeros, [{}, {}])
    text = pickle.dumps(buffer)
    assert (len(text) < 4_000) == (steps == 5)
    again = pickle.loads(text)
    assert (again.pos, again.full) == (buffer.pos, buffer.full) == (steps % 64, steps > 64)
    np.testing.assert_equal(vars(again), vars(buffer))


@every
def test_saved_and_loaded(cls: Any, tmp_path: Path) -> None:
    kwargs = settings() | {"cost_limit": 0.1, "buffer_size": 500}
    model = cls("MlpPolicy", points(), **kwargs).learn(150)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    again = cls.load(tmp_path / "model", env=points())
    again.load_replay_buffer(tmp_path / "buffer")
    assert again.buffer_size == 500 and again.replay_buffer.costs.any()
    assert float(again.multiplier.value[0]) == float(model.multiplier.value[0]) > 0.0
    for name, value in model.cost_critic.state_dict().items():
        assert th.equal(value, again.cost_critic.state_dict()[name]), name
    moments, loaded = (one.cost_critic.optimizer.state_dict() for one in (model, again))
    assert loaded["state"].keys() == moments["state"].keys() != set()
    observation = model.get_env().reset()
    np.testing.assert_array_equal(
        *(m.predict(observation, deterministic=True)[0] for m in (model, again))
    )
    again.learn(40, reset_num_timesteps=False)
    assert again.num_timesteps == 190
    result = evaluate_policy(again, points(1), n_eval_episodes=2)
    assert result.lengths.tolist() == [30, 30] and (result.costs > 0.0).all()


def test_sampling_draws_what_sb3s_buffer_draws() -> None:
    space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    buffer = CostReplayBuffer(20, space, space, "cpu", n_envs=4, n_costs=1)
    for step in range(5):
        rows = np.arange(4.0)[:, None] + 10 * step
        buffer.costs[step] = rows
        buffer.add(rows, rows, rows, rows[:, 0], np.zeros(4), [{}] * 4)
    batch = buffer.sample(50)
    assert isinstance(batch, CostReplayBufferSamples) and len({*batch.costs[:, 0].tolist()}) > 10
    th.testing.assert_close(batch.costs, batch.rewards)
    assert CostReplayBufferSamples._fields[:6] == ReplayBufferSamples._fields


@pytest.mark.parametrize(
    ("more", "error"),
    [
        ({"n_steps": 3, "optimize_memory_usage": True}, "n_steps=3: must be 1 .*optimize_memory"),
        ({"cost_gamma": 1.0}, "cost_gamma = 1.0 must be at least 0 and less than 1"),
        ({"env": "CartPole-v1"}, r"^\w+ needs continuous actions \(Box\), not Discrete"),
    ],
)
def test_bad_input(more: Any, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        SACLag("MlpPolicy", **{"env": points(1), **settings(), **more})


@pytest.mark.slow
@pytest.mark.parametrize("cls", [TD3Lag, SACLag, TQCLag])
def test_it_finds_a_known_optimum(cls: Any) -> None:
    """Defaults but for a small network and a high rate, which spare time."""
    problem, steps = problems()["bandit"], 8_000
    env, outcomes = problem.make_env(), Outcomes(steps)
    fast: dict[str, Any] = {
        "learning_rate": 3e-3,
        "batch_size": 64,
        "seed": 0,
        "buffer_size": steps,
        "gradient_steps": 2,
    }
    # SAC's temperature would need longer to come down.
    fast |= {"action_noise": noise()} if cls is TD3Lag else {"ent_coef": 0.01}
    policy = {"net_arch": [32, 32]}
    cls("MlpPolicy", env, cost_limit=0.5, policy_kwargs=policy, **fast).learn(steps, outcomes)
    assert np.mean(outcomes.returns) / problem.best >= 0.9
    assert 0.85 <= np.mean(outcomes.costs) / 0.5 <= 1.05

"""Whole episodes, counted fairly, each with a seed of its own."""

import dataclasses
import io
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from cost_envs import CostPoint
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import NormalizeReward, TimeLimit, vector
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_guard.algorithms import CPO, TRPOSL, SACLag
from sb3_guard.common.certificate import certify
from sb3_guard.common.evaluation import (
    Evaluation,
    check_agent,
    evaluate_policy,
    sync_normalization,
)
from sb3_guard.common.monitor import CostMonitor
from sb3_guard.judging import Mean
from sb3_guard.vector import as_vec_env, own_statistics


class Fixed(gym.Env):
    """Episodes of a given length, reward 1 a step; the k-th step costs 10 k."""

    def __init__(self, length: int) -> None:
        self.observation_space = spaces.Box(-1, 1, (1,), np.float32)
        self.action_space = spaces.Discrete(2)
        self.length, self.k = length, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.k = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.k += 1
        over = self.k == self.length
        info = {"cost": 10.0 * self.k, "is_success": self.length == 1}
        return np.zeros(1, np.float32), 1.0, over, False, info


class Idle:
    """A policy that does nothing, and remembers what it was given."""

    def __init__(self, acts_on_cost: bool = False) -> None:
        self.acts_on_cost = acts_on_cost
        self.states: list = []
        self.starts: list = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.states.append(state)
        self.starts.append(episode_start.copy())
        return np.zeros(len(observation), int), "memory"


def fixed(*lengths: int) -> DummyVecEnv:
    return DummyVecEnv([lambda length=length: Fixed(length) for length in lengths])


def test_short_episodes_get_no_more_than_their_share():
    # Taking the first six episodes that end would take five of length 1.
    result = evaluate_policy(Idle(), fixed(1, 5), n_eval_episodes=6)
    assert sorted(result.lengths.tolist()) == [1, 1, 1, 5, 5, 5]


def test_sums_by_hand():
    result = evaluate_policy(Idle(), fixed(3), n_eval_episodes=2)
    assert result.returns.tolist() == [3, 3]
    assert result.costs.tolist() == [60, 60]
    assert result.key_costs.tolist() == [[60], [60]]
    assert result.successes.tolist() == [False, False]


def test_stops_after_max_steps():
    result = evaluate_policy(Idle(), fixed(2, 5), n_eval_episodes=100, max_steps=4)
    assert result.lengths.tolist() == [2]
    assert result.unfinished[:, [0, 2]].tolist() == [[4.0, 4.0]]  # return and steps of the other


def test_costs_that_no_step_reports_are_told(recwarn):
    def play(*keys: str, **monitor: Any) -> Evaluation:
        env = CostMonitor(DummyVecEnv([lambda: CostPoint(cost_keys=keys)]), **monitor)
        return evaluate_policy(Idle(), env, n_eval_episodes=1)

    play("cost")
    renamed = play("heat", cost_keys=("heat",))  # the monitor knows the name
    assert renamed.cost_keys == ("heat",) and not recwarn
    evaluate_policy(Idle(), gym.make("CartPole-v1"), n_eval_episodes=1)  # has no costs
    assert not recwarn
    with pytest.warns(UserWarning, match=r"no step reported a cost as info\['noise'\], so"):
        assert play("heat", cost_keys=("noise",)).costs.tolist() == [0.0]


def test_a_policy_that_acts_on_costs_gets_the_last_ones():
    model = Idle(acts_on_cost=True)
    evaluate_policy(model, fixed(2, 3), n_eval_episodes=4)
    seen = [state[0][:, 0].tolist() for state in model.states]
    # Row 0 starts anew at step 2, both at step 3: no cost then.
    assert seen == [[0, 0], [10, 10], [0, 20]] * 2


def test_other_policies_keep_their_own_state_and_see_where_episodes_start():
    model = Idle()
    evaluate_policy(model, fixed(2), n_eval_episodes=2)
    assert model.states == [None, "memory"] * 2
    assert [one[0] for one in model.starts] == [True, False, True, False]


@pytest.mark.parametrize("inside", [CostMonitor, None])
@pytest.mark.parametrize("outside", [CostMonitor, VecMonitor, None])
def test_reward_normalisation_does_not_show(inside, outside):
    env = scaled = VecNormalize(inside(fixed(3)) if inside else fixed(3), norm_obs=False)
    scaled.ret_rms.var = np.array(100.0)
    env = VecFrameStack(outside(env) if outside else env, 2)
    assert evaluate_policy(Idle(), env, n_eval_episodes=2).returns.tolist() == [3, 3]


def test_an_episode_that_a_wrapper_outside_of_monitor_cuts_is_over():
    def cut(length: int) -> gym.Env:
        return TimeLimit(Monitor(Fixed(length)), 3)

    seen = evaluate_policy(Idle(), DummyVecEnv([lambda: cut(2), lambda: cut(5)]), 4)
    assert sorted(seen.lengths.tolist()) == [2, 2, 3, 3] == sorted(seen.returns.tolist())
    assert sorted(seen.costs.tolist()) == [30, 30, 60, 60]
    model = CPO("MlpPolicy", cut(5), n_steps=30, n_critic_updates=1).learn(30)
    assert (model.costs.horizon, model.costs.episode_cost.tolist()) == (3, [60])


class Waiting(gym.Wrapper):
    """Begins each episode with a step, as ``NoopResetEnv`` does."""

    def reset(self, **kwargs):
        self.env.reset(**kwargs)
        obs, _, _, _, info = self.env.step(0)
        return obs, info


def test_so_is_one_whose_reset_takes_steps():
    env = DummyVecEnv([lambda: TimeLimit(Waiting(Monitor(Fixed(9))), 3)])
    seen = evaluate_policy(Idle(), env, 2)
    assert (seen.lengths.tolist(), seen.costs.tolist()) == ([3, 3], [90, 90])


class Cutting(VecEnvWrapper):
    """Ends all episodes after two steps, and tells no monitor."""

    def reset(self):
        self.k = 0
        return self.venv.reset()

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        self.k += 1
        if self.k % 2 == 0:
            self.env_method("reset")
            dones = np.ones_like(dones)
        return obs, rewards, dones, infos


def test_a_monitor_that_is_not_told_of_an_end_reports_nothing():
    seen = evaluate_policy(Idle(), Cutting(CostMonitor(fixed(2, 5))), 4)
    assert seen.lengths.tolist() == seen.returns.tolist() == [2] * 4
    assert seen.costs.tolist() == [30] * 4


class Lives(gym.Wrapper):
    """Ends an episode after each step, though the game goes on, as SB3's EpisodicLifeEnv."""

    over = True

    def step(self, action):
        obs, reward, self.over, truncated, info = self.env.step(action)
        return obs, reward, True, truncated, info

    def reset(self, **kwargs):
        return self.env.reset(**kwargs) if self.over else (np.zeros(1, np.float32), {})


def test_a_life_lost_is_not_the_end():
    seen = evaluate_policy(Idle(), Lives(Monitor(Fixed(3))), 2)
    assert seen.lengths.tolist() == seen.returns.tolist() == [3, 3]
    assert seen.costs.tolist() == [60, 60]


@pytest.mark.parametrize("deterministic", [True, False])
def test_seeded_evaluation_repeats_and_leaves_training_alone(deterministic):
    env = CostMonitor(DummyVecEnv([lambda: CostPoint(episode_length=10)] * 2))
    model = CPO("MlpPolicy", env, n_steps=20, seed=1)
    before = th.get_rng_state()
    first = evaluate_policy(model, env, 4, deterministic, seed=7)
    assert th.equal(before, th.get_rng_state())
    th.rand(3)
    again = evaluate_policy(model, env, 4, deterministic, seed=7)
    other = evaluate_policy(model, env, 4, deterministic, seed=8)
    np.testing.assert_array_equal(first.returns, again.returns)
    np.testing.assert_array_equal(first.costs, again.costs)
    assert not np.array_equal(first.returns, other.returns)


class Costs(gym.Wrapper):
    """Reports other costs instead of the cost c of a step."""

    def __init__(self, env, report) -> None:
        super().__init__(env)
        self.report = report

    def step(self, action):
        *rest, info = self.env.step(action)
        return *rest, self.report(info["cost"])


@pytest.mark.parametrize(
    ("report", "message"),
    [
        (lambda c: {"cost": c if c < 20 else np.nan}, "is nan: a cost must be a finite number"),
        (lambda c: {"costs": c}, "no cost key 'cost'.*nearest: 'costs'"),
    ],
)
def test_costs_are_read_as_strictly_as_in_training(report, message):
    env = Costs(Fixed(3), report)
    model = CPO("MlpPolicy", Fixed(3), n_steps=20)
    with pytest.raises(ValueError, match=message):
        evaluate_policy(model, env, 2)


def test_an_absent_cost_is_none_where_the_model_says_so_or_knows_of_no_costs():
    env = Costs(Fixed(3), lambda c: {"cost": c} if c == 30 else {})
    lenient = CPO("MlpPolicy", env, n_steps=20, missing_cost="zero")
    for model in (lenient, Idle()):
        assert evaluate_policy(model, DummyVecEnv([lambda: env]), 2).costs.tolist() == [30, 30]


def test_the_cost_is_that_of_the_one_key_and_of_several_the_total():
    env = DummyVecEnv([lambda: Costs(Fixed(3), lambda c: {"cost": 9 * c, "a": c, "b": 2 * c})])
    one, two = (evaluate_policy(Idle(), env, 1, cost_keys=keys) for keys in (("a",), ("a", "b")))
    assert (one.costs.tolist(), one.key_costs.tolist()) == ([60], [[60]])
    assert (two.costs.tolist(), two.key_costs.tolist()) == ([540], [[60, 120]])


@pytest.mark.parametrize("vectorised", [True, False])
def test_training_goes_on_with_new_episodes_after_an_evaluation_in_its_environment(vectorised):
    env = Fixed(30)
    model = CPO("MlpPolicy", env, n_steps=40, n_critic_updates=1, seed=0).learn(40)
    assert model.costs.episodes.lengths.tolist() == [10]
    evaluate_policy(model, fixed(7), 1)
    model.learn(20, reset_num_timesteps=False)
    assert model.costs.episodes.lengths.tolist() == [20]  # another one's episodes change nothing
    evaluate_policy(model, model.env if vectorised else env, 1)
    model.learn(40, reset_num_timesteps=False)
    assert (model.costs.horizon, model.costs.episode_cost.tolist()) == (30, [4650])
    model.learn(40, reset_num_timesteps=False)
    assert model.costs.episodes.lengths.tolist() == [20]  # once is enough


@pytest.mark.parametrize("algorithm", [CPO, SACLag])
@pytest.mark.parametrize("moment", ["training_start", "rollout_start", "step", "rollout_end"])
def test_an_evaluation_in_the_training_environment_is_refused_while_it_trains(algorithm, moment):
    env = CostPoint(10)
    steps = {"n_steps": 20} if algorithm is CPO else {"learning_starts": 5, "batch_size": 8}
    model = algorithm("MlpPolicy", env, **steps)

    class Evaluating(BaseCallback):
        def _on_step(self) -> bool:
            return True

    play = lambda *_: evaluate_policy(model, env, 1)  # noqa: E731
    setattr(Evaluating, f"_on_{moment}", play)
    with pytest.raises(ValueError, match="eval_env is the training environment, whose episodes"):
        model.learn(40, callback=Evaluating())
    setattr(Evaluating, f"_on_{moment}", lambda *_: True)
    Evaluating._on_training_end = play
    model.learn(40, callback=Evaluating()).learn(0)
    model.save(path := io.BytesIO())
    path.seek(0)
    assert len(play()) == len(evaluate_policy(algorithm.load(path, env=env), env, 1)) == 1


def test_a_seeded_evaluation_wakes_no_other_gpu(monkeypatch):
    """fork_rng takes the states of all GPUs unless it is told which."""
    monkeypatch.setattr(th.cuda, "device_count", lambda: 4)
    monkeypatch.setattr(th.cuda, "get_rng_state", lambda gpu: pytest.fail(f"GPU {gpu} is used"))
    model = CPO("MlpPolicy", CostPoint(10), n_steps=20, device="cpu")
    for agent in (model, model.policy, Idle()):
        assert len(evaluate_policy(agent, CostPoint(5), 1, seed=0))


def test_a_policy_of_several_costs_is_told_their_names():
    keys = ("cost", "cost_1")
    env = DummyVecEnv([lambda: CostPoint(10, cost_keys=keys)])
    model = TRPOSL("MlpPolicy", env, n_steps=20, cost_keys=keys, warmup=0, seed=0)
    alone = evaluate_policy(model.policy, env, 2, seed=1, cost_keys=keys)
    np.testing.assert_array_equal(alone.key_costs, evaluate_policy(model, env, 2, seed=1).key_costs)


def test_an_evaluation_in_words():
    """Means, ± their standard errors, and limits; a verdict is for a certificate."""
    model = CPO("MlpPolicy", CostPoint(10), n_steps=20, cost_limit=30.0, seed=0)
    seen = evaluate_policy(model, CostPoint(10), 5)
    mean, error = seen.returns.mean(), seen.returns.std(ddof=1) / 5**0.5
    assert str(seen) == f"5 episodes: {seen.words}"
    assert seen.words.startswith(f"return {mean:.3f} ± {error:.3f}, cost ")
    assert seen.words.endswith(", limit 30")
    one = evaluate_policy(Idle(), fixed(3), 1)
    assert str(one) == "1 episodes: return 3.000, cost 60.000"


def test_each_of_several_costs_has_its_limit_in_words():
    keys = ("cost", "heat")
    model = CPO("MlpPolicy", CostPoint(10, cost_keys=keys), cost_keys=keys, cost_limit=[30, 0.0])
    seen = evaluate_policy(model, CostPoint(10, hazard=(-1, 0), cost_keys=keys), 5)
    _, total, cost, _, heat, limit = seen.words.split(", ")
    assert total == f"total cost {Mean.of(seen.costs)}"
    assert (cost, heat) == tuple(f"{k} {Mean.of(seen.key_costs[:, i])}" for i, k in enumerate(keys))
    assert limit == "limit 0"
    worst = dataclasses.replace(seen, limits=dataclasses.replace(seen.limits, on="max"))
    assert f", worst step of heat {Mean.of(seen.max_costs[:, 1])}, limit 0" in str(worst)


class Seeded(Fixed):
    """The cost of an episode is the seed that it began with; 1000 without one."""

    def reset(self, *, seed=None, options=None):
        self.seed = 1000 if seed is None else seed
        return super().reset(seed=seed)

    def step(self, action):
        *rest, _ = super().step(action)
        return *rest, {"cost": self.seed / self.length}


@pytest.mark.parametrize("n_envs", [1, 3, 8])
def test_each_episode_has_a_seed_of_its_own_in_any_number_of_environments(n_envs):
    env = DummyVecEnv([lambda i=i: Seeded(2 + i % 3) for i in range(n_envs)])
    seen = evaluate_policy(Idle(), env, 8, seed=40)
    np.testing.assert_allclose(seen.costs, np.arange(40.0, 48.0))


@pytest.mark.parametrize(
    ("envs", "copies"),
    [(fixed(3, 3), True), (fixed(3), True), (fixed(3, 4), False), (None, False)],
)
def test_copies_of_one_episode_are_told(envs, copies):
    envs = envs or DummyVecEnv([lambda: CostPoint(10)] * 2)  # begins somewhere else each time
    assert evaluate_policy(Idle(), envs, 4, seed=0).copies == copies
    assert not evaluate_policy(Idle(), envs, 1, seed=0).copies


def test_an_evaluation_leaves_the_normalization_as_it_is():
    env = VecNormalize(CostMonitor(DummyVecEnv([lambda: CostPoint(30)] * 2)))
    model = CPO("MlpPolicy", env, n_steps=60, seed=0, device="cpu").learn(120)
    count, rows = env.obs_rms.count, []
    for _ in range(2):
        rows.append(evaluate_policy(model, model.get_env(), 4, seed=3).returns)
    assert env.training and env.obs_rms.count == count
    np.testing.assert_array_equal(*rows)


def test_a_second_normalizer_is_refused():
    def two() -> VecNormalize:
        return VecNormalize(CostMonitor(VecNormalize(DummyVecEnv([lambda: CostPoint(10)]))))

    model = CPO("MlpPolicy", CostPoint(10), n_steps=20)
    for use in (
        lambda: CPO("MlpPolicy", two()),
        lambda: model.set_env(two()),
        lambda: evaluate_policy(model.policy, two()),
        lambda: certify(model.policy, two(), 1.0),
        lambda: sync_normalization(two(), two()),
    ):
        with pytest.raises(ValueError, match=r"env has two VecNormalize.*: keep one"):
            use()


@pytest.mark.parametrize("name", ["NormalizeObservation", "NormalizeReward"])
def test_wrappers_with_statistics_of_their_own_are_named(name):
    env = DummyVecEnv([lambda: getattr(gym.wrappers, name)(CostPoint(10))])
    model = CPO("MlpPolicy", CostPoint(10), n_steps=20)
    with pytest.warns(UserWarning, match=f"^{name} moves its statistics .*: use VecNormalize"):
        evaluate_policy(model, env, 1)
    with pytest.raises(ValueError, match=f"^{name} moves its statistics"):
        certify(model, env, 1.0)


def test_they_are_named_wherever_gymnasium_has_them():
    rows, kwargs = [lambda: CostPoint(10)], {"autoreset_mode": AutoresetMode.SAME_STEP}
    inner = AsyncVectorEnv([lambda: NormalizeReward(CostPoint(10))], **kwargs)
    outer = vector.NormalizeReward(SyncVectorEnv(rows, **kwargs))
    for env in (inner, vector.RecordEpisodeStatistics(outer)):
        assert own_statistics(as_vec_env(env)).startswith("NormalizeReward moves")
        env.close()


def test_statistics_that_are_not_finite_are_refused():
    for infinite in ("mean", "var"):
        env = VecNormalize(DummyVecEnv([lambda: CostPoint(10)]))
        getattr(env.obs_rms, infinite)[0] = np.inf  # clipped, or divided by, it makes a number
        with pytest.raises(ValueError, match=r"statistics do not fit .* not finite"):
            check_agent(object(), env)


def test_an_agent_of_normalized_observations_is_not_given_raw_ones():
    env = VecNormalize(CostMonitor(DummyVecEnv([lambda: CostPoint(30)])))
    model = CPO("MlpPolicy", env, n_steps=60, device="cpu")
    raw = CostMonitor(DummyVecEnv([lambda: CostPoint(30)]))
    with pytest.raises(ValueError, match=r"env has no VecNormalize: .*model.get_env\(\)"):
        evaluate_policy(model, raw)
    other = VecNormalize(raw, training=False)
    sync_normalization(env, other)
    assert len(evaluate_policy(model, other)) == 10
    env.norm_obs = False
    assert len(evaluate_policy(model, raw)) == 10

"""Anyone's environment: costs from wherever they are, budgets, Safety-Gymnasium's interface."""

import json
import pickle
import re
import subprocess
import sys
import warnings
from pathlib import Path

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from cost_envs import CostPoint
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import DependencyNotInstalled, NameNotFound
from gymnasium.utils.env_checker import check_env as gymnasium_check
from safety_stub import Builder, SafeTimeLimit, install
from stable_baselines3.common.env_checker import check_env as sb3_check
from stable_baselines3.common.env_util import make_vec_env as sb3_make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_guard import CPO, TRPO, CostMonitor, evaluate_policy, make_vec_env
from sb3_guard.common.adapters import (
    CostAsThirdValue,
    CostFromFunction,
    CostFromInfo,
    CostFromStep,
    is_safety_gymnasium,
    make_safety_gymnasium,
)
from sb3_guard.common.budgets import EarlyTermination, RemainingBudget
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.run.make_envs import source_of
from sb3_guard.zoo.run.resumable import ResumableEnv

SUPPORT = Path(__file__).parents[1] / "support"
SMALL = {"n_steps": 32, "seed": 0, "policy_kwargs": {"net_arch": [8]}}
SHAPES = {
    "flat": spaces.Box(-1.0, 2.0, (3,), np.float32),
    "double": spaces.Box(-1.0, 2.0, (3,), np.float64),
    "whole": spaces.Box(0, 9, (3,), np.int64),
    "image": spaces.Box(0, 255, (36, 36, 3), np.uint8),
    "number": spaces.Discrete(5),
    "dictionary": spaces.Dict({"a": spaces.Box(-1.0, 1.0, (2,), np.float32)}),
}


class Scripted(gym.Env):
    """Reward 1, and infos as written down; observations count the steps where they can."""

    def __init__(self, infos, space=SHAPES["flat"]):
        self.infos = list(infos)
        self.observation_space = space
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.steps = 0
        self.buffer = np.zeros(3, np.float32)

    def observe(self):
        if self.observation_space == SHAPES["flat"]:
            self.buffer[:] = self.steps % 3  # written in place, as simulators do
            return self.buffer
        return self.observation_space.sample()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observe(), {}

    def step(self, action):
        info = dict(self.infos[self.steps])
        self.steps += 1
        return self.observe(), 1.0, False, self.steps == len(self.infos), info


def play(env, steps, action=(0.0, 0.0)):
    env.reset(seed=0)
    return [env.step(np.array(action, np.float32)) for _ in range(steps)]


@pytest.fixture
def package(monkeypatch):
    install(monkeypatch)


def test_six_values_become_five_and_nothing_is_lost():
    raw, env = Builder("x"), CostFromStep(Builder("x"))
    raw.reset(seed=0)
    charged = 0
    for mine in play(env, 30, (1.0, 0.0)):
        obs, reward, cost, terminated, truncated, info = raw.step(np.float32([1.0, 0.0]))
        np.testing.assert_array_equal(mine[0], obs)
        assert mine[1:4] == (reward, terminated, truncated)
        assert mine[4] == {**info, "cost": cost}
        charged += cost > 0
    assert 0 < charged < 30


def test_five_values_become_six_and_back_without_loss():
    plain, six = CostPoint(), CostAsThirdValue(CostPoint())
    back = CostFromStep(CostAsThirdValue(CostPoint()))
    for env in (plain, six, back):
        env.reset(seed=0)
    for action in np.float32([[1.0, 0.0], [0.5, -1.0], [1.0, 1.0]]):
        obs, reward, terminated, truncated, info = plain.step(action)
        out = six.step(action)
        np.testing.assert_array_equal(out[0], obs)
        assert out[1:5] == (reward, info["cost"], terminated, truncated)
        assert type(out[2]) is float and out[5]["cost_sum"] == out[2]
        again = back.step(action)
        assert again[1:4] == (reward, terminated, truncated)
        assert again[4] == {**info, "cost_sum": info["cost"]}


def test_five_values_are_refused():
    env = CostFromStep(CostPoint())
    env.reset()
    with pytest.raises(ValueError, match=r"returned 5 values, not six .* use CostFromInfo"):
        env.step(np.zeros(2))


@pytest.mark.parametrize(
    "env_id",
    ["SafetyPointGoal9-v0", "safety_gymnasium:SafetyPointGoal9-v0", "SafetyPointGoal9Gymnasium-v0"],
)
def test_its_ids_are_accepted(package, env_id):
    assert is_safety_gymnasium(env_id)
    source = source_of(env_id)
    assert (
        source.batch is None and source.env_id == env_id
    )  # the prefix tells it from ours of that name
    for name in (env_id, source.env_id):
        env = make_vec_env(name, 2, seed=0)
        env.reset()
        *_, infos = env.step(np.ones((2, 2)))
        assert {"cost", "cost_hazards", "cost_sum"} <= set(infos[0])
        assert env.get_attr("spec")[0].max_episode_steps == 40


def test_its_environments_train(package):
    env = make_vec_env("SafetyPointGoal9-v0", 2, seed=0, max_episode_steps=20)
    settings = {
        **SMALL,
        "policy_kwargs": {"net_arch": [8], "ortho_init": True, "log_std_init": 0.0},
    }
    costs = {"cost_limit": 0.5, "cost_keys": ("cost_hazards",)}
    model = CPO("MlpPolicy", env, **costs, **settings).learn(128)
    assert [one["l"] for one in model.ep_info_buffer] == [20] * 6
    evaluation = evaluate_policy(model, env, n_eval_episodes=3, seed=0)
    assert evaluation.costs.sum() > 0
    np.testing.assert_allclose(evaluation.key_costs[:, 0], evaluation.costs)


def test_absent_package_says_where_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "safety_gymnasium", None)
    # not even importlib.util can find it: as if it had never been installed
    for ask in (make_vec_env, make_safety_gymnasium):
        with pytest.raises(DependencyNotInstalled, match="safety_gymnasium/check"):
            ask("safety_gymnasium:SafetyPointGoal9-v0")
    with pytest.raises(ValueError, match="use 'SafetyPointGoal1-v0'"):
        make_vec_env("SafetyPointGoal9-v0")  # what there is without the package
    with pytest.raises(
        UsageError, match=r"'safety_gymnasium:SafetyPointGoal9-v0' needs .*safety-gymnasium"
    ):
        source_of("safety_gymnasium:SafetyPointGoal9-v0")


def test_broken_package_says_why(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "safety_gymnasium.py").write_text("raise ValueError('mutable\\n default')")
    monkeypatch.delitem(sys.modules, "safety_gymnasium", raising=False)
    with pytest.raises(DependencyNotInstalled, match="ValueError: mutable default") as caught:
        make_vec_env("safety_gymnasium:SafetyPointGoal9-v0")
    assert "\n" not in str(caught.value)


def test_unknown_ids_of_it_have_a_nearest_match(package):
    with pytest.raises(ValueError, match="use 'SafetyPointGoal1-v0'"):
        make_vec_env("SafetyPointGoal8-v0")
    with pytest.raises(NameNotFound, match="did you mean 'SafetyPointGoal9-v0'"):
        make_safety_gymnasium("SafetyPointGoal8-v0")


def test_who_registered_an_id_decides(monkeypatch):
    monkeypatch.setitem(sys.modules, "safety_gymnasium", None)
    monkeypatch.setitem(gym.registry, "SafetyMine-v0", EnvSpec("SafetyMine-v0", CostPoint))
    assert not is_safety_gymnasium("SafetyMine-v0")
    assert not is_safety_gymnasium("CartPole-v1")
    make_vec_env("SafetyMine-v0").reset()


@pytest.mark.parametrize(
    ("keys", "info", "expected"),
    [
        ("cost_sum", {"cost_sum": 2}, {"cost": 2.0}),
        ("fee", {"fee": True, "cost": 9.0}, {"cost": 1.0}),
        ("fee", {"fee": np.array([0.5])}, {"cost": 0.5, "cost_0": 0.5}),
        ("fees", {"fees": [1.0, 0.5]}, {"cost": 1.5, "cost_0": 1.0, "cost_1": 0.5}),
        ("fees", {"fees": np.array([1, 2])}, {"cost": 3.0, "cost_0": 1.0, "cost_1": 2.0}),
        ("fees", {"fees": {"a": 1, "b": np.float32(0.5)}}, {"cost": 1.5, "cost_a": 1.0,
                                                            "cost_b": 0.5}),
        (("x", "y"), {"x": 1.0, "y": 2.0}, {"cost": 3.0}),
        (("x", "y"), {"x": [1.0, 2.0], "y": 4.0}, {"cost": 7.0, "cost_x_0": 1.0,
                                                   "cost_x_1": 2.0}),
    ],
)  # fmt: skip
def test_costs_are_taken_from_other_entries(keys, info, expected):
    env = CostFromInfo(Scripted([info]), keys)
    found = play(env, 1)[0][4]
    assert {key: found[key] for key in expected} == expected
    assert all(type(found[key]) is float for key in expected)
    assert set(found) == {*info, *expected}


def test_absent_entries_are_errors_unless_they_mean_zero():
    infos = [{"cost_sums": 1.0}, {}]
    with pytest.raises(ValueError, match=r"no cost key 'cost_sum'.*nearest: 'cost_sums'"):
        play(CostFromInfo(Scripted(infos)), 1)
    free = CostFromInfo(Scripted(infos), "cost_sums", missing_cost="zero")
    assert [info["cost"] for *_, info in play(free, 2)] == [1.0, 0.0]


@pytest.mark.parametrize("value", [float("nan"), "much", "1.5", None, {"a": None}, [np.inf]])
def test_what_is_no_cost_is_refused(value):
    with pytest.raises(ValueError, match="must be a finite number"):
        play(CostFromInfo(Scripted([{"fee": value}]), "fee"), 1)


def moved(obs, action, next_obs, info):
    return {"before": obs[0], "after": next_obs[0], "action": action[1], "info": info["x"]}


@pytest.mark.parametrize("cost", [moved, "test_adapters:moved", "test_adapters.moved"])
def test_functions_see_the_step_from_before_to_after(cost):
    env = CostFromFunction(Scripted([{"x": 8.0}] * 2), cost)
    steps = play(env, 2, (0.0, 0.25))
    for i, (*_, info) in enumerate(steps):
        parts = [info[f"cost_{name}"] for name in ("before", "after", "action", "info")]
        assert parts == [i, i + 1, 0.25, 8.0]
        assert info["cost"] == sum(parts)
    env.reset()
    assert env.step(np.zeros(2))[4]["cost_before"] == 0.0


@pytest.mark.parametrize(
    "kind", [float, int, bool, np.float32, np.float64, np.int64, np.bool_, np.array]
)
def test_every_kind_of_number_is_a_cost(kind):
    def one():
        return Scripted([{"cost": kind(i % 2)} for i in range(8)])

    env = CostMonitor(DummyVecEnv([one, one]), cost_keys=("cost",))
    model = CPO("MlpPolicy", env, **SMALL).learn(128)
    assert [episode["c"] for episode in model.ep_info_buffer] == [4.0] * 16
    assert env.total_cost == 64.0
    np.testing.assert_array_equal(model.rollout_buffer.costs.sum(), 32)
    for played in (env, one()):
        evaluation = evaluate_policy(model, played, n_eval_episodes=3)
        np.testing.assert_array_equal(evaluation.costs, [4.0] * 3)
        np.testing.assert_array_equal(evaluation.key_costs, [[4.0]] * 3)
    for wrapper in (RemainingBudget, EarlyTermination):
        assert len(play(wrapper(one(), budget=9), 8)) == 8


def test_environments_may_report_different_kinds_of_numbers():
    kinds = (float, np.array, lambda cost: np.array([cost]))
    envs = [
        lambda kind=kind: Scripted([{"a": kind(i % 2), "b": 2.0} for i in range(8)])
        for kind in kinds
    ]
    keys = ("a", "b")
    env = CostMonitor(DummyVecEnv(envs), cost_keys=keys)
    model = CPO("MlpPolicy", env, cost_keys=keys, **SMALL).learn(96)
    np.testing.assert_array_equal(model.costs.total, [48, 192])
    np.testing.assert_array_equal(evaluate_policy(model, env, 3).key_costs, [[4, 16]] * 3)


@pytest.mark.parametrize("value", [np.array([1.0, 2.0]), np.array(["1.5"])])
def test_other_arrays_are_no_costs(value):
    model = CPO("MlpPolicy", Scripted([{"cost": value}] * 8), **SMALL)
    with pytest.raises(ValueError, match=r"environment 0 .* be a finite number; .*CostFromInfo"):
        model.learn(32)


@pytest.mark.parametrize("kind", [DummyVecEnv, SubprocVecEnv])
def test_a_time_limit_is_seen_around_an_environment_without_a_spec(kind):
    def one():
        return gym.wrappers.TimeLimit(CostPoint(10**6), 500)

    env = kind([one, one], **({"start_method": "fork"} if kind is SubprocVecEnv else {}))
    model = CPO("MlpPolicy", env, **SMALL).learn(64)
    assert model.costs.horizon == 500
    env.close()


COSTS = [{"cost": cost} for cost in (0.0, 1.0, 0.5, 0.5, 1.0, 0.0)]


@pytest.mark.parametrize("discount", [1.0, 0.5])
def test_what_is_left_of_the_budget_is_observed(discount):
    env = RemainingBudget(Scripted(COSTS), budget=2.0, discount=discount, unsafe_reward=-3.0)
    first, _ = env.reset(seed=0)
    assert first[-1] == 1.0
    z = 1.0
    for obs, reward, *_, info in play(env, len(COSTS)):
        z = (z - info["cost"] / 2.0) / discount
        assert obs[-1] == pytest.approx(z)
        assert reward == (-3.0 if z < 0 else 1.0)
    assert env.reset()[0][-1] == 1.0
    assert z < 0 if discount == 1.0 else z > 0


def test_a_budget_that_is_spent_exactly_is_kept():
    steps = play(RemainingBudget(Scripted(COSTS), budget=3.0, unsafe_reward=-3.0), len(COSTS))
    assert steps[-1][0][-1] == pytest.approx(0.0, abs=1e-6)
    assert [reward for _, reward, *_ in steps] == [1.0] * len(COSTS)
    assert not any(terminated for _, _, terminated, *_ in play(EarlyTermination(
        Scripted(COSTS), budget=3.0), len(COSTS)))  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
def test_the_budget_joins_every_kind_of_observation(shape):
    env = RemainingBudget(Scripted(COSTS, SHAPES[shape]), budget=2.0)
    assert env.observation_space.contains(env.reset(seed=0)[0])
    for obs, *_ in play(env, 3):
        assert env.observation_space.contains(obs)
    flat = len(SHAPES[shape].shape or ()) == 1
    assert obs[-1] == 0.25 if flat else obs["budget"].tolist() == [0.25]
    policy = "MlpPolicy" if flat else "MultiInputPolicy"
    TRPO(policy, env, **SMALL).learn(32)


@pytest.mark.parametrize(("budget", "end"), [(0, 2), (1.0, 3), (1.9, 4), (2.5, 5), (9.0, None)])
def test_overspending_ends_the_episode(budget, end):
    env = EarlyTermination(Scripted(COSTS), budget, final_reward=-2.0)
    for _ in range(2):  # the second episode begins again
        env.reset()
        for i in range(1, len(COSTS) + 1):
            _, reward, terminated, truncated, info = env.step(np.zeros(2))
            assert terminated == (i == end) == ("budget_exceeded" in info)
            assert reward == (-1.0 if terminated else 1.0)
            if terminated:
                break
        assert truncated == (end is None)


def test_ending_episodes_outside_a_monitor_is_warned_about_and_they_are_counted_all_the_same():
    def wrapped(make, **kwargs):
        return make(lambda: Scripted(COSTS), 2, **kwargs)

    with pytest.warns(UserWarning, match="wrap the environment before its monitor"):
        outside = wrapped(
            sb3_make_vec_env, wrapper_class=EarlyTermination, wrapper_kwargs={"budget": 1.0}
        )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        inside = wrapped(make_vec_env, wrapper_class=lambda env: EarlyTermination(env, 1.0))
    model = TRPO("MlpPolicy", inside, **SMALL)
    for env in (outside, inside):
        played = evaluate_policy(model, env, 4, max_steps=100)
        assert played.lengths.tolist() == [3] * 4
        assert played.returns.tolist() == [3.0] * 4
        assert played.costs.tolist() == [1.5] * 4


def test_other_costs_than_the_total_can_be_counted():
    infos = [{"cost": 9.0, "fee": 0.5}] * 4
    assert play(RemainingBudget(Scripted(infos), 1.0, cost_key="fee"), 1)[0][0][-1] == 0.5
    ends = [step[2] for step in play(EarlyTermination(Scripted(infos), 1.0, cost_key="fee"), 3)]
    assert ends == [False, False, True]
    with pytest.raises(ValueError, match=r"no cost key 'fees'.*nearest: 'fee'"):
        play(EarlyTermination(Scripted(infos), 1.0, cost_key="fees"), 1)


class Keyed(CostPoint):
    def step(self, action):
        *rest, info = super().step(action)
        return *rest, {"constraint_costs": {"hazard": info["cost"], "height": 0.0}}


def distance(obs, action, next_obs, info):
    return float(np.linalg.norm(next_obs[:2] - obs[:2]))


WRAPPED = {
    "step": lambda: CostFromStep(SafeTimeLimit(Builder("x"), 30)),
    "info": lambda: CostFromInfo(Keyed(30), "constraint_costs"),
    "function": lambda: CostFromFunction(CostPoint(30), distance),
    "budget": lambda: RemainingBudget(CostPoint(30), 2.0, discount=0.99, unsafe_reward=-1.0),
    "early": lambda: EarlyTermination(CostPoint(30), 1.5, final_reward=-1.0),
    "all": lambda: EarlyTermination(
        RemainingBudget(CostFromInfo(Keyed(30), "constraint_costs"), 2.0), 2.0
    ),
}


@pytest.mark.filterwarnings("ignore::UserWarning")  # about infinite bounds and wrapped environments
@pytest.mark.parametrize("name", WRAPPED)
def test_the_checkers_have_no_objection(name):
    sb3_check(WRAPPED[name]())
    gymnasium_check(WRAPPED[name](), skip_render_check=True)


def rest_of(env, generator):
    steps = []
    while not steps or not (steps[-1][2] or steps[-1][3]):
        steps.append(env.step(generator.uniform(0, 1, 2).astype(np.float32)))
    return [(obs.tolist(), *rest) for obs, *rest in steps]


@pytest.mark.parametrize("travel", ["pickle", "cloudpickle", "resume"])
@pytest.mark.parametrize("name", WRAPPED)
def test_an_episode_goes_on_where_it_was_left(name, travel):
    env = ResumableEnv(WRAPPED[name]()) if travel == "resume" else WRAPPED[name]()
    env.reset(seed=3)
    generator = np.random.default_rng(0)
    for _ in range(8):
        env.step(generator.uniform(0, 1, 2).astype(np.float32))
    if travel == "resume":
        other = ResumableEnv(WRAPPED[name]())
        other.reset(seed=9)
        other.restore(env.state())
    else:
        by = pickle if travel == "pickle" else cloudpickle
        other = pickle.loads(by.dumps(env))
    seeds = np.random.default_rng(1), np.random.default_rng(1)
    assert rest_of(env, seeds[0]) == rest_of(other, seeds[1])


def test_the_spec_says_how_to_wrap_again(monkeypatch):
    monkeypatch.setitem(gym.registry, "Point-v0", EnvSpec("Point-v0", CostPoint))
    env = EarlyTermination(RemainingBudget(gym.make("Point-v0"), 2.0), 1.5)
    again = gym.make(env.spec)
    assert (again.budget, again.env.budget) == (1.5, 2.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda env: RemainingBudget(env, 0.0), r"budget=0.0: must be a number in \(0, inf\)"),
        (lambda env: RemainingBudget(env, True), "budget=True"),
        (
            lambda env: RemainingBudget(env, 1.0, discount=1.5),
            r"discount=1.5: must be a number in \(0, 1\]",
        ),
        (lambda env: RemainingBudget(env, 1.0, unsafe_reward="low"), "unsafe_reward='low'"),
        (lambda env: EarlyTermination(env, -1.0), r"budget=-1.0: must be a number in \[0, inf\)"),
        (lambda env: EarlyTermination(env, float("inf")), "budget=inf"),
        (lambda env: EarlyTermination(env, 1.0, final_reward=None), "final_reward=None"),
        (lambda env: CostFromInfo(env, ()), "must be names of info entries"),
        (lambda env: CostFromInfo(env, missing_cost="no"), "'error' or 'zero'"),
        (lambda env: CostFromFunction(env, "nowhere:cost"), "package.module:function"),
        (lambda env: CostFromFunction(env, 3), "cost=3: must be a function"),
        (
            lambda env: RemainingBudget(
                RemainingBudget(Scripted([], SHAPES["dictionary"]), 1.0), 1.0
            ),
            "wrapped twice",
        ),
    ],
)
def test_bad_arguments_are_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make(CostPoint())
    assert "\n" not in str(caught.value)


def without(*modules, code):
    absent = "".join(f"sys.modules[{name!r}] = None\n" for name in modules)
    run = [sys.executable, "-c", f"import sys\n{absent}{code}"]
    return subprocess.run(run, capture_output=True, text=True)


def test_adapters_need_neither_torch_nor_mujoco():
    run = without(
        "torch", "stable_baselines3", "mujoco", code="import sb3_guard.common.adapters as adapters"
    )
    assert run.returncode == 0, run.stderr


def test_only_mujoco_and_gymnasium_may_be_absent():
    run = without("sb3_guard.envs.mujoco_gaps", code="import sb3_guard")
    assert "import of sb3_guard.envs.mujoco_gaps halted" in run.stderr
    run = without("mujoco", "mujoco.batch", code="import sb3_guard")
    assert run.returncode == 0, run.stderr


# MuJoCo 2.3 and 3 have no `mujoco.batch`
@pytest.mark.slow
@pytest.mark.parametrize("absent", ["mujoco", "mujoco.batch"])
def test_environments_of_others_are_made_and_trained_on_without_mujoco_4(absent):
    run = without(
        absent,
        code="from sb3_guard import CPO, evaluate_policy, make_vec_env\n"
        "env = make_vec_env('CartPole-v1', 2, seed=0)\n"
        "model = CPO('MlpPolicy', env, n_steps=32, missing_cost='zero').learn(64)\n"
        "evaluate_policy(model, env, 2)\n"
        "make_vec_env('Goal_Point_8Hazards-v0')\n",
    )
    assert run.returncode == 1
    error = run.stderr.strip().splitlines()[-1]
    assert "'Goal_Point_8Hazards-v0': it is not registered" in error and "MuJoCo 4" in error, run


@pytest.mark.parametrize("absent", [pytest.param("mujoco", marks=pytest.mark.slow), "mujoco.batch"])
def test_the_commands_train_and_play_on_six_values_without_mujoco_4(absent, tmp_path):
    run = without(
        absent,
        code=f"sys.path[:0] = {[str(SUPPORT)]!r}\n"
        "import pytest, safety_stub\n"
        "from sb3_guard import enjoy, train\n"
        "safety_stub.install(pytest.MonkeyPatch())\n"
        f"where = ['--env', 'SafetyPointGoal9-v0', '-f', {str(tmp_path)!r}]\n"
        "small = ['n_envs:2', 'n_steps:40', 'n_critic_updates:2']\n"
        "assert train.main([*where, '--algo', 'cpo', '-n', '160', '--eval-freq', '80',\n"
        "    '--eval-episodes', '1', '-params', *small]) == 0\n"
        "assert enjoy.main([*where, '--algo', 'cpo', '--no-render', '--n-episodes', '1']) == 0\n"
        "assert train.main(['--env', 'Goal_Point_8Hazards', '-n', '10']) == 2\n",
    )
    assert run.returncode == 0, run.stderr
    result = json.loads((tmp_path / "cpo" / "SafetyPointGoal9-v0_1" / "result.json").read_text())
    assert result["n_timesteps"] == 160 and result["cost"] >= 0.0
    assert "sb3_guard's own environments need MuJoCo 4" in run.stderr


def test_the_pages_examples_run():
    page = Path(__file__).parents[2] / "docs" / "your_environment.md"
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)
    assert len(blocks) == 5
    exec(compile("\n".join(blocks), str(page), "exec"), {})

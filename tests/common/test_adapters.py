"""Anyone's environment: costs from wherever they are, budgets, Safety-Gymnasium's interface."""

import json
import pickle
import re
import subprocess
import sys
from pathlib import Path

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from cost_envs import CostPoint
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled, NameNotFound
from gymnasium.utils.env_checker import check_env as gymnasium_check
from safety_stub import Builder, SafeTimeLimit, install
from stable_baselines3.common.env_checker import check_env as sb3_check
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_guard import CPO, CostMonitor, evaluate_policy, make_vec_env
from sb3_guard.common.adapters import (
    CostAsThirdValue,
    CostFromFunction,
    CostFromStep,
    is_safety_gymnasium,
    make_safety_gymnasium,
)
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.run.checkpoint import ResumableEnv
from sb3_guard.zoo.run.make_envs import source_of

SUPPORT = Path(__file__).parents[1] / "support"
SMALL = {"n_steps": 32, "seed": 0, "policy_kwargs": {"net_arch": [8]}}


class Scripted(gym.Env):
    """Reward 1, and infos as written down; observations count the steps."""

    def __init__(self, infos):
        self.infos = list(infos)
        self.observation_space = spaces.Box(-1.0, 2.0, (3,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.steps = 0
        self.buffer = np.zeros(3, np.float32)

    def observe(self):
        self.buffer[:] = self.steps % 3  # written in place, as simulators do
        return self.buffer

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
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


@pytest.mark.parametrize("env_id", ["SafetyPointGoal9-v0", "safety_gymnasium:SafetyPointGoal9-v0"])
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
        "batch_size": None,
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
    with pytest.raises(ValueError, match="did you mean 'SafetyPointGoal"):
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
    with pytest.raises(ValueError, match="did you mean 'SafetyPointGoal"):
        make_vec_env("SafetyPointGoal8-v0")
    with pytest.raises(NameNotFound, match="did you mean 'SafetyPointGoal9-v0'"):
        make_safety_gymnasium("SafetyPointGoal8-v0")


@pytest.mark.parametrize("value", [float("nan"), "much", {"a": 1.0}])
def test_what_is_no_cost_is_refused(value):
    with pytest.raises(ValueError, match="must be a finite number"):
        play(CostFromFunction(Scripted([{}]), lambda *_: value), 1)


def moved(obs, action, next_obs, info):
    return obs[0] + 10 * next_obs[0] + 100 * action[1] + info["x"]


def first(obs, action, next_obs, info):
    return obs[0]


@pytest.mark.parametrize("cost", [moved, "test_adapters:moved", "test_adapters.moved"])
def test_functions_see_the_step_from_before_to_after(cost):
    env = CostFromFunction(CostFromFunction(Scripted([{"x": 8.0}] * 2), cost), first, "before")
    for i, (*_, info) in enumerate(play(env, 2, (0.0, 0.25))):
        assert info == {"x": 8.0, "cost": i + 10 * (i + 1) + 25.0 + 8.0, "before": i}
    env.reset()
    assert env.step(np.zeros(2))[4]["before"] == 0.0


@pytest.mark.parametrize("kind", [float, bool, np.float32, np.array])
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


def test_a_time_limit_is_seen_around_an_environment_without_a_spec():
    env = DummyVecEnv([lambda: gym.wrappers.TimeLimit(CostPoint(10**6), 500)] * 2)
    model = CPO("MlpPolicy", env, **SMALL).learn(64)
    assert model.costs.horizon == 500
    env.close()


def distance(obs, action, next_obs, info):
    return float(np.linalg.norm(next_obs[:2] - obs[:2]))


WRAPPED = {
    "step": lambda: CostFromStep(SafeTimeLimit(Builder("x"), 30)),
    "function": lambda: CostFromFunction(CostPoint(30), distance),
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


@pytest.mark.parametrize("travel", ["cloudpickle", "resume"])
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
        other = pickle.loads(cloudpickle.dumps(env))
    seeds = np.random.default_rng(1), np.random.default_rng(1)
    assert rest_of(env, seeds[0]) == rest_of(other, seeds[1])


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
    run = without("mujoco", "mujoco.batch", code="import sb3_guard")
    assert run.returncode == 0, run.stderr
    older = "import mujoco; del mujoco.MjSpec\nfrom sb3_guard import CPO"  # as MuJoCo 2.3
    run = without("mujoco.batch", code=older)
    assert run.returncode == 0, run.stderr


@pytest.mark.slow
def test_the_commands_train_and_play_on_six_values_without_mujoco_4(tmp_path):
    run = without(
        "mujoco.batch",  # as in MuJoCo 2.3 and 3
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


@pytest.mark.slow
def test_the_pages_examples_run():
    page = Path(__file__).parents[2] / "docs" / "your_environment.md"
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)
    exec(compile("\n".join(blocks), str(page), "exec"), {})

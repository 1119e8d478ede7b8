"""Evaluation during training: the best model is a safe one, and training does not notice."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from cost_envs import CostPoint
from stable_baselines3.common.callbacks import (
    BaseCallback,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_guard.algorithms import CPO, TRPO
from sb3_guard.common import callbacks
from sb3_guard.common.callbacks import CostEvalCallback
from sb3_guard.common.evaluation import Evaluation, evaluate_policy
from sb3_guard.common.monitor import CostMonitor
from sb3_guard.judging import Limits


def envs(n: int = 2, **kwargs) -> CostMonitor:
    keys = kwargs.get("cost_keys", ("cost",))
    make = [lambda: CostPoint(episode_length=10, **kwargs)] * n
    return CostMonitor(DummyVecEnv(make), cost_keys=keys)


class StopAtOnce(BaseCallback):
    def _on_step(self):
        return False


def evaluation(mean_return: float, *costs: float) -> Evaluation:
    """Two episodes around given means, one cost per key."""
    returns = np.array([mean_return - 1, mean_return + 1])
    key_costs = np.array([costs, costs])
    lengths, limits = np.array([10, 10]), Limits(np.full(len(costs), np.inf))
    return Evaluation(returns, key_costs[:, 0], lengths, key_costs, key_costs, limits)


def callback(selection_limit=None, **model) -> CostEvalCallback:
    result = CostEvalCallback(envs(1), selection_limit=selection_limit)
    keys = model.setdefault("cost_keys", ("cost",))
    model.setdefault("constrained", "cost_limit" in model)
    limits = np.broadcast_to(model.get("cost_limit", np.inf), len(keys))
    result.model = SimpleNamespace(final_cost_limits=limits, **model)
    return result


@pytest.mark.parametrize(
    ("limit", "candidates", "best"),
    [
        # Among safe ones the return decides,
        (10.0, [(1.0, 5.0), (3.0, 9.0), (2.0, 0.0)], 1),
        # a safe one beats every unsafe one,
        (10.0, [(99.0, 10.1), (-5.0, 9.9)], 1),
        # among unsafe ones the violation,
        (10.0, [(99.0, 40.0), (1.0, 12.0), (50.0, 13.0)], 1),
        # the limit itself is safe,
        (10.0, [(1.0, 10.0), (99.0, 10.5)], 0),
        # and the default at d = 0 still chooses by return among those that cost at most 1.
        (None, [(0.0, 0.0), (5.0, 0.9), (9.0, 1.1)], 1),
    ],
)
def test_safe_first_then_good(limit, candidates, best):
    judge = callback(limit, cost_limit=0.0)
    scores = [judge.score(evaluation(*one)) for one in candidates]
    assert scores.index(max(scores)) == best


@pytest.mark.parametrize(("limit", "score"), [(6.2, (True, 3.0)), (6.0, (False, -0.1455))])
def test_safe_is_what_keeps_the_limit_by_a_standard_error(limit, score):
    """Costs of 4, 5, 6 and 7: 5.5 on the average, with a standard error of 0.6455."""
    costs = np.array([[4.0], [5.0], [6.0], [7.0]])
    limits = Limits(np.array([np.inf]))
    seen = Evaluation(np.full(4, 3.0), costs[:, 0], np.full(4, 10), costs, costs, limits)
    safe, value = callback(limit).score(seen)
    assert safe == score[0] and value == pytest.approx(score[1], abs=1e-4)


def test_several_costs_each_have_their_limit():
    judge = callback(cost_limit=[0.0, 20.0], cost_keys=("a", "b"))
    assert judge.limits().values.tolist() == [1.0, 20.0]
    assert judge.score(evaluation(7.0, 0.5, 19.0)) == (True, 7.0)
    # The violations add up.
    assert judge.score(evaluation(7.0, 2.0, 23.0)) == (False, -4.0)


def test_unconstrained_algorithms_are_judged_by_return():
    judge = callback(cost_limit=0.0, constrained=False)
    assert judge.score(evaluation(7.0, 1e9)) == (True, 7.0)
    assert callback(5.0, cost_limit=0.0, constrained=False).score(evaluation(7.0, 9.0)) == (
        False,
        -4,
    )


@pytest.mark.parametrize("limit", [[1.0, 2.0], np.nan])
def test_a_limit_that_does_not_fit_is_refused_before_training(limit):
    model = CPO("MlpPolicy", envs(), n_steps=20)
    with pytest.raises(ValueError, match=r"selection_limit=.*each of the 1 cost keys \('cost',\)"):
        model.learn(20, callback=CostEvalCallback(envs(), selection_limit=limit))


@pytest.mark.parametrize("vectorised", [True, False])
def test_the_training_environment_is_refused(vectorised):
    env = CostPoint(episode_length=10)
    model = CPO("MlpPolicy", env, n_steps=20)
    with pytest.raises(ValueError, match="eval_env is the training environment"):
        model.learn(20, callback=CostEvalCallback(model.env if vectorised else env))


#: (return, cost) of nine evaluations: six models ever less unsafe, then three safe ones
COURSE = [(60, 90), (50, 80), (40, 70), (30, 60), (20, 50), (10, 40), (8, 4), (9, 4), (7, 2)]


@pytest.mark.parametrize(
    ("stop", "evaluations"),
    [
        ({"callback_after_eval": StopTrainingOnNoModelImprovement(3)}, 9),
        ({"callback_after_eval": StopTrainingOnNoModelImprovement(0)}, 9),
        ({"callback_on_new_best": StopTrainingOnRewardThreshold(55.0)}, 9),
        ({"callback_on_new_best": StopTrainingOnRewardThreshold(8.5)}, 8),
    ],
)
def test_sb3s_stopping_callbacks_follow_the_best_model(monkeypatch, stop, evaluations):
    course = iter(COURSE)
    monkeypatch.setattr(callbacks, "evaluate_policy", lambda *_, **__: evaluation(*next(course)))
    model = CPO("MlpPolicy", envs(), n_steps=45, n_critic_updates=1, cost_limit=5.0)
    watcher = CostEvalCallback(envs(), eval_freq=5, verbose=0, deterministic=True, **stop)
    model.learn(90, callback=watcher)
    assert len(watcher.evaluations_costs) == evaluations
    assert watcher.best_score == (True, 9.0) and watcher.best_mean_reward == 9.0


@pytest.mark.parametrize(
    ("mean", "noisy", "best"),
    [(1.0, 9.0, (False, -4.0)), (9.0, 1.0, (False, -4.0)), (1.0, 2.0, (True, 7.0))],
)
def test_the_policy_must_keep_the_limit_with_its_noise_and_without(monkeypatch, mean, noisy, best):
    """Costs of its mean and of its samples, under a limit of 5; the return is that of the mean."""

    def play(*_, deterministic, **__):
        return evaluation(7.0, mean) if deterministic else evaluation(3.0, noisy)

    monkeypatch.setattr(callbacks, "evaluate_policy", play)
    model = CPO("MlpPolicy", envs(), n_steps=20, n_critic_updates=1, cost_limit=5.0)
    watcher = CostEvalCallback(envs(), eval_freq=20, verbose=0)
    model.learn(40, callback=watcher)
    assert watcher.best_score == best


def learn(tmp_path, algorithm=CPO, evaluate=True, env=None, steps=120, **kwargs):
    model = algorithm("MlpPolicy", env or envs(), n_steps=20, n_critic_updates=2, seed=3)
    watcher = CostEvalCallback(
        kwargs.pop("eval_env", None) or envs(),
        n_eval_episodes=4,
        eval_freq=15,
        log_path=tmp_path,
        best_model_save_path=tmp_path,
        verbose=0,
        **kwargs,
    )
    model.learn(steps, callback=watcher if evaluate else None)
    return model, watcher


def logged_rows(model) -> list[dict]:
    """What a model logs from now on, a dictionary per dump."""
    rows = []

    class Recorder(Logger):
        def dump(self, step=0):
            rows.append(dict(self.name_to_value))
            super().dump(step)

    model.set_logger(Recorder(None, []))
    return rows


def test_logs_the_costs(tmp_path, capsys):
    keys = ("cost", "heat")
    model = CPO("MlpPolicy", envs(cost_keys=keys), n_steps=20, cost_keys=keys, n_critic_updates=2)
    rows = logged_rows(model)
    watcher = CostEvalCallback(
        envs(cost_keys=keys, hazard=(-1, 0)),
        n_eval_episodes=5,
        eval_freq=15,
        log_path=tmp_path,
    )
    model.learn(40, callback=watcher)
    (row,) = [row for row in rows if "eval/mean_reward" in row]
    for name in ("mean", "stochastic"):
        cost, heat = (row[f"eval/{name}_ep_cost/{key}"] for key in keys)
        assert cost > 0 and row[f"eval/{name}_ep_cost"] == pytest.approx(cost)
        assert heat == pytest.approx(2 * cost)
    told = capsys.readouterr().out
    assert "; sampled actions: return " in told and f", heat {heat:.3f} ± " in told
    assert row["eval/mean_ep_cost"] == watcher.last_mean_cost > 0
    assert row["time/total_timesteps"] == 30
    costs = np.load(tmp_path / "evaluations.npz")["key_costs"]
    assert costs.shape == (1, 5, 2)
    np.testing.assert_allclose(costs[..., 1], 2 * costs[..., 0])


def test_the_one_cost_that_is_limited_is_the_one_shown(tmp_path, capsys):
    # The environment has a total as well, twice as high.
    env, other = (envs(cost_keys=("heat", "cost"), hazard=(-1, 0)) for _ in range(2))
    model = CPO("MlpPolicy", env, n_steps=20, cost_keys=("heat",), seed=0)
    rows = logged_rows(model)
    watcher = CostEvalCallback(
        other, n_eval_episodes=5, eval_freq=15, callback_after_eval=StopAtOnce(), log_path=tmp_path
    )
    model.learn(40, callback=watcher)
    heat, total = evaluate_policy(
        model, other, 5, seed=0, cost_keys=("heat", "cost")
    ).key_costs.mean(axis=0)
    assert total == pytest.approx(2 * heat) and heat > 0
    assert rows[0]["eval/mean_ep_cost"] == watcher.last_mean_cost == heat
    assert np.load(tmp_path / "evaluations.npz")["costs"].mean() == pytest.approx(heat)
    assert f"heat {heat:.3f} ± " in capsys.readouterr().out


@pytest.mark.parametrize("deterministic", [True, False])
def test_training_does_not_notice(tmp_path, deterministic):
    watched, _ = learn(tmp_path, deterministic=deterministic)
    alone, _ = learn(tmp_path, evaluate=False)
    for one, other in zip(watched.policy.parameters(), alone.policy.parameters(), strict=True):
        assert th.equal(one, other)


def test_best_model_is_the_best_evaluated(tmp_path):
    model, watcher = learn(tmp_path, TRPO, steps=400)
    history = np.load(tmp_path / "evaluations.npz")
    means = history["results"].mean(axis=1)
    assert watcher.best_score == (True, means.max())
    best = TRPO.load(tmp_path / "best_model.zip")
    assert best.num_timesteps == history["timesteps"][means.argmax()]
    assert best.num_timesteps <= model.num_timesteps


def test_normaliser_lies_beside_the_best_model(tmp_path):
    env, eval_env = VecNormalize(envs()), VecNormalize(envs(), training=False, norm_reward=False)
    learn(tmp_path, env=env, eval_env=eval_env)
    saved = VecNormalize.load(str(tmp_path / "best_model_vecnormalize.pkl"), envs())
    assert saved.obs_rms.count > 1
    # Evaluation used training's statistics and did not add to them.
    assert eval_env.obs_rms.count <= env.obs_rms.count


def test_state_continues_the_history(tmp_path):
    _, watcher = learn(tmp_path)
    fresh = CostEvalCallback(envs(), log_path=tmp_path / "elsewhere", best_model_save_path=tmp_path)
    (tmp_path / "elsewhere").mkdir()
    fresh.restore(watcher.state())
    assert fresh.state() == watcher.state()
    one, other = (np.load(path / "evaluations.npz") for path in (tmp_path, tmp_path / "elsewhere"))
    for name in one.files:
        np.testing.assert_array_equal(one[name], other[name])

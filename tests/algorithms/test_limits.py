"""Limits that change over the training."""

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cost_envs import CostPoint
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from sb3_guard import CostEvalCallback, evaluate_policy, train
from sb3_guard.algorithms import CPO, SCPO, TRPOIPO, PPOLag, SACLag
from sb3_guard.algorithms.common.costs import limits_at
from sb3_guard.judging import Limits


def points(n_envs: int = 2, **kwargs: Any) -> Any:
    point = partial(CostPoint, episode_length=20, **{"hazard": (-1.0, 0.0), **kwargs})
    return make_vec_env(point, n_envs, seed=0)


@pytest.mark.parametrize(
    ("limit", "start", "middle", "end"),
    [
        (3, 3, 3, 3),
        ("lin_50_25", 50.0, 37.5, 25.0),
        ("lin_-5_-10.5", -5.0, -7.75, -10.5),
        ("lin_0_1e2", 0.0, 50.0, 100.0),
        (lambda remaining: 1.0 + remaining**2, 2.0, 1.25, 1.0),
        (["lin_4_2", 7.0], [4.0, 7.0], [3.0, 7.0], [2.0, 7.0]),
    ],
)
def test_a_limit_at_a_time(limit: Any, start: Any, middle: Any, end: Any) -> None:
    assert [limits_at(limit, remaining) for remaining in (1.0, 0.5, 0.0)] == [start, middle, end]


def test_bad_schedules_are_named() -> None:
    for limit, message in (
        ("lin_50", r"cost_limit='lin_50': .*'lin_50_25', a line from 50 to 25"),
        ("lin_5_-5", r"cost_limit=-5.0: must be at least 0"),
        (lambda remaining: "low", "cost_limit='low': must be finite numbers"),
        ({"cost": 5}, "must be finite numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            TRPOIPO("MlpPolicy", points(), cost_limit=limit)


def test_a_limit_falls_to_what_is_asked_for_and_stays_there() -> None:
    model = CPO(
        "MlpPolicy", points(), cost_limit=[10.0, -4.0, 0.0], cost_keys=("cost", "a", "b"),
        limit_start=3.0, limit_fall=0.8, missing_cost="zero",
    )  # fmt: skip
    seen = []
    for remaining in (1.0, 0.6, 0.2, 0.1, 0.0):
        model._current_progress_remaining = remaining
        seen.append(model.cost_limits.tolist())
    assert seen[:2] == [[30.0, 4.0, 0.0], pytest.approx([20.0, 0.0, 0.0])]
    np.testing.assert_allclose(seen[2:], [[10.0, -4.0, 0.0]] * 3, atol=1e-12)
    assert model.final_cost_limits.tolist() == [10.0, -4.0, 0.0]
    for name, value in (("limit_start", 0.5), ("limit_fall", 0.0), ("limit_fall", 1.5)):
        with pytest.raises(ValueError, match=f"{name} = {value} must be"):
            CPO("MlpPolicy", points(), cost_limit=2.0, **{name: value})


def test_a_schedule_begins_where_it_says_and_a_number_at_limit_start() -> None:
    model = CPO(
        "MlpPolicy", points(), cost_limit=["lin_8_4", 10.0], cost_keys=("cost", "a"),
        limit_start=3.0, missing_cost="zero",
    )  # fmt: skip
    model._current_progress_remaining = 1.0
    assert model.cost_limits.tolist() == [8.0, 30.0]


@pytest.mark.parametrize(
    ("cls", "limit"),
    [
        (CPO, {"cost_limit": "lin_4_2"}),
        (PPOLag, {"cost_limit": lambda remaining: 2.0 + 2.0 * remaining}),
        (SACLag, {"cost_limit": 2.0, "limit_start": 2.0, "limit_fall": 1.0}),
    ],
)
def test_every_update_has_the_limit_of_its_time(cls: Any, limit: Any, tmp_path: Path) -> None:
    arguments = {"learning_starts": 120} if cls is SACLag else {"n_steps": 40}
    env = points(1)
    model = cls("MlpPolicy", env, **limit, seed=0, device="cpu", **arguments)
    seen: list[tuple[int, float]] = []
    train = model.train

    def spy(*args: Any, **kwargs: Any) -> None:
        expected = 4.0 - 2.0 * model.num_timesteps / 160
        assert model.cost_limits.tolist() == pytest.approx([expected])
        costs = model.costs
        if costs.episode_cost is not None:
            violation = (costs.episode_cost - expected) / costs.horizon
            np.testing.assert_allclose(costs.violation, violation)
        train(*args, **kwargs)
        seen.append((model.num_timesteps, float(model.costs.limits[0])))

    model.train = spy
    model.learn(160)
    assert seen and seen[-1][1] == pytest.approx(4.0 - 2.0 * seen[-1][0] / 160)
    del model.train
    model.save(tmp_path / "model")
    again = cls.load(tmp_path / "model", env=env)
    again._current_progress_remaining = 0.5
    assert again.cost_limits.tolist() == [3.0]
    assert again.final_cost_limits.tolist() == [2.0]
    assert evaluate_policy(again, env, n_eval_episodes=1).limits.values == 2.0


def test_a_rollout_beyond_the_end_of_the_training_has_the_last_limit() -> None:
    model = CPO("MlpPolicy", points(), cost_limit="lin_4_2", n_steps=40).learn(100)
    assert model.num_timesteps == 160 and model.costs.limits.tolist() == [2.0]


def test_an_agent_is_judged_by_the_last_limit(tmp_path: Path) -> None:
    model = CPO("MlpPolicy", points(), cost_limit="lin_4_2")
    callback = CostEvalCallback(points(), n_eval_episodes=1)
    callback.model = model
    assert callback.limits().values.tolist() == [2.0]
    arguments = "--gym-packages registered_envs --env CostPoint-v0 --algo cpo -n 120 --verbose 0"
    hyperparams = "-params n_envs:2 n_steps:30 n_critic_updates:1 cost_limit:lin_4_2 --eval-freq -1"
    folder = ["-f", str(tmp_path)]
    assert train.main([*arguments.split(), *hyperparams.split(), *folder]) == 0
    result = json.loads((tmp_path / "cpo" / "CostPoint-v0_1" / "result.json").read_text())
    assert result["cost_limit"] == result["costs"]["cost"]["limit"] == 2.0


@pytest.mark.parametrize("cls", [CPO, PPOLag, SACLag, SCPO])
def test_updates_keep_to_the_aim(cls: Any, tmp_path: Path) -> None:
    settings = {"learning_starts": 40} if cls is SACLag else {"n_steps": 40}
    model = cls("MlpPolicy", points(4), cost_limit=9.0, aim="certificate", seed=0, **settings)
    assert model.costs.limits == 9.0
    model.set_logger(configure(str(tmp_path), ["json"]))
    seen: list[list[float]] = []

    def note(theirs: Any, _: Any) -> bool:
        seen.append([info["cost"] for info in theirs["infos"]])
        return True

    model.learn(400, callback=note)
    steps = np.array(seen).reshape(-1, 20, 4)
    episodes = (steps.max(axis=1) if cls is SCPO else steps.sum(axis=1)).ravel()[-100:]
    assert len(episodes) > 10 and 0 < episodes.std()
    (width,) = Limits(np.array([9.0])).half_width(episodes[:, None])
    assert model.costs.limits == pytest.approx(9.0 - width) and model.final_cost_limits == 9.0
    if cls is not SACLag:  # which has written it down
        excess = model.logger.name_to_value["train/constraint_violation"]
        assert excess == pytest.approx(model.costs.episode_cost[0] - 9.0)
    row = json.loads((tmp_path / "progress.json").read_text().splitlines()[-1])
    assert 4.5 <= row["train/cost_aim"] < 9.0 and row["rollout/cost_limit"] == 9.0

"""What users get wrong or forget, and what the algorithms say about it."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from cost_envs import CostPoint
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

from sb3_guard import CPO, PPOLag, SACLag
from sb3_guard.algorithms import CostReplay
from sb3_guard.zoo.run.hyperparams import model_arguments

SMALL = {"n_steps": 40, "batch_size": 40, "n_epochs": 1, "n_critic_updates": 1}


def small(cls: type) -> dict[str, Any]:
    if issubclass(cls, CostReplay):
        return {"learning_starts": 20, "train_freq": 40, "buffer_size": 200}
    return {k: v for k, v in SMALL.items() if k in cls.__signature__.parameters}  # type: ignore


@pytest.mark.parametrize("cls", [CPO, PPOLag, SACLag])
def test_no_function_is_asked_about_a_time_after_the_training(cls: Any) -> None:
    """The last rollout of 40 steps goes beyond 100, and 100 more are not a multiple either."""
    asked: list[float] = []

    def at(value: float) -> Any:
        return lambda remaining: asked.append(remaining) or value

    env = CostPoint(20, hazard=(-1.0, 0.0))
    model = cls("MlpPolicy", env, cost_limit=at(5.0), learning_rate=at(1e-3), **small(cls))
    model.learn(100).learn(100, reset_num_timesteps=False)
    assert len(asked) > 3 and min(asked) >= 0.0 and max(asked) <= 1.0


def test_a_rate_of_a_file_ends_at_zero() -> None:
    values = {"learning_rate": "lin_0.1", "n_envs": 1, "n_timesteps": 100}
    rate = model_arguments(values)["learning_rate"]
    assert [rate(remaining) for remaining in (1.0, 0.5, 0.0, -0.2)] == [0.1, 0.05, 0.0, 0.0]


class Box(CostPoint):
    """Actions of another box."""

    def __init__(self, low: Any, high: Any) -> None:
        super().__init__(20)
        self.action_space = spaces.Box(np.float32(low), np.float32(high), (2,))

    def step(self, action: Any) -> Any:
        return super().step(np.clip(action, -1, 1))


@pytest.mark.parametrize(
    ("low", "high", "kwargs", "warned"),
    [
        (0.0, 1000.0, {}, True),
        (5.0, 5.5, {}, True),
        (-50.0, 50.0, {"policy_kwargs": {"log_std_init": 2.0}}, False),
        (-1.0, 1.0, {"policy_kwargs": {"log_std_init": -3.0}}, True),
        (0.0, 1.0, {}, False),
        (0.0, 1000.0, {"use_sde": True, "policy_kwargs": {"squash_output": True}}, False),
    ],
)
@pytest.mark.parametrize("cls", [CPO, PPOLag])
def test_actions_out_of_reach_are_told(
    cls: Any, low: float, high: float, kwargs: Any, warned: bool
) -> None:
    with warnings.catch_warnings(record=True, action="always") as said:
        cls("MlpPolicy", Box(low, high), cost_limit=1.0, **small(cls), **kwargs)
    about = [each for each in said if "RescaleAction" in str(each.message)]
    assert len(about) == warned


def test_a_rescaled_box_and_a_squashed_policy_are_in_reach(tmp_path: Any) -> None:
    env = gym.wrappers.RescaleAction(Box(0.0, 1000.0), np.float32(-1), np.float32(1))
    with warnings.catch_warnings(action="error"):
        CPO("MlpPolicy", env, cost_limit=1.0, **small(CPO)).save(tmp_path / "a")
        SACLag("MlpPolicy", Box(0.0, 1000.0), cost_limit=1.0, **small(SACLag))
        CPO.load(tmp_path / "a", env=env)


def test_a_replay_buffer_of_other_environments_is_refused(tmp_path: Any) -> None:
    old = SACLag("MlpPolicy", make_vec_env(CostPoint, 2), cost_limit=1.0, **small(SACLag))
    old.learn(80).save_replay_buffer(tmp_path / "buffer")
    model = SACLag("MlpPolicy", make_vec_env(CostPoint, 3), cost_limit=1.0, **small(SACLag))
    before = model.replay_buffer
    with pytest.raises(ValueError, match="a CostReplayBuffer of 3 environments and 1 costs"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is before
    model.learn(120)

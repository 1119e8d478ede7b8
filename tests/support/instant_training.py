"""Importing this makes trpo_lag "train" in a moment without learning (``--gym-packages``).

For tests of what surrounds a training: that no trial of a tuner is lost whatever is killed.
"""

import random
import time
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_guard.algorithms import TRPOLag
from sb3_guard.zoo.tuning import studies

STEPS = 10


class Still(gym.Env[np.ndarray, np.ndarray]):
    """Three steps in which nothing happens, at a cost of 0."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (1,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, float]]:
        self.steps += 1
        return np.zeros(1, np.float32), 1.0, self.steps == 3, False, {"cost": 0.0}


def learn(self: TRPOLag, total_timesteps: int, callback: Any = None, **_: Any) -> TRPOLag:
    """Call the callback as a training does, and sleep for up to half a second in all."""
    callback = self._init_callback(callback)
    callback.on_training_start({}, {})
    for _step in range(STEPS):
        time.sleep(random.uniform(0.0, 0.05))
        self.num_timesteps += total_timesteps // STEPS
        if not callback.on_step():
            break
    return self


studies.HEARTBEAT, studies.GRACE = 1, 3  # seconds: a silence is soon a long one
TRPOLag.learn = learn  # type: ignore[method-assign, assignment]
if "Still-v0" not in gym.registry:
    gym.register("Still-v0", entry_point="instant_training:Still")

"""Importing this registers toy environments, as a user's package would (``--gym-packages``)."""

from typing import Any

import gymnasium as gym
import numpy as np
from cost_envs import CostPoint
from stable_baselines3.common.callbacks import BaseCallback


class Filmed(CostPoint):
    """A point that can be filmed: frames are grey with a bright dot."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.render_mode = render_mode

    def render(self) -> np.ndarray:
        frame = np.full((64, 64, 3), 60, np.uint8)
        x, y = (32 + 15 * self.position).astype(int)
        frame[y - 2 : y + 2, x - 2 : x + 2] = 255
        return frame


class Unpicklable(CostPoint):
    """An environment whose state nobody can save."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.stream = (i for i in range(10))


class NoCost(CostPoint):
    """A plain environment: its info says nothing about costs."""

    def step(self, action: np.ndarray) -> Any:
        *rest, info = super().step(action)
        return *rest, {"depth": info["cost"]}


class Flickering(CostPoint):
    """Reports a cost that is not a number after a while."""

    def step(self, action: np.ndarray) -> Any:
        *rest, _ = super().step(action)
        return *rest, {"cost": float("nan") if self.steps > 20 else 0.0}


class Wordy(CostPoint):
    """Reports its cost in a word."""

    def step(self, action: np.ndarray) -> Any:
        *rest, _ = super().step(action)
        return *rest, {"cost": "high"}


class Undefined(CostPoint):
    """Gives a reward or an observation that is not a number after a while."""

    def __init__(self, what: str, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.what = what
        self.taken = 0

    def step(self, action: np.ndarray) -> Any:
        obs, reward, *rest = super().step(action)
        self.taken += 1
        if self.taken > 30 and self.what == "reward":
            reward = float("nan")
        elif self.taken > 30:
            obs = np.full_like(obs, np.nan)
        return obs, reward, *rest


class Broken(CostPoint):
    """Fails after a while."""

    error: Exception = RuntimeError("out of order")
    after = 20

    def step(self, action: np.ndarray) -> Any:
        if self.steps > self.after:
            raise self.error
        return super().step(action)


def far(obs: np.ndarray, action: np.ndarray, next_obs: np.ndarray, info: Any) -> float:
    """A cost for ``CostFromFunction``."""
    return float(np.linalg.norm(next_obs))


class StopAt(BaseCallback):
    """A user's callback that ends training."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _on_step(self) -> bool:
        return self.num_timesteps < self.steps


for name, cls in {
    "CostPoint": CostPoint,
    "Filmed": Filmed,
    "Unpicklable": Unpicklable,
    "NoCost": NoCost,
    "Flickering": Flickering,
    "Wordy": Wordy,
    "Broken": Broken,
    "Undefined": Undefined,
}.items():
    if f"{name}-v0" not in gym.registry:
        gym.register(f"{name}-v0", entry_point=f"{cls.__module__}:{name}")

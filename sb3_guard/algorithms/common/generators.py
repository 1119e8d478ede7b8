"""The random state before a rollout, for any algorithm of Stable-Baselines3.

gSDE draws its noise before callbacks hear that a rollout starts. A checkpoint that a callback
writes then continues from before the draw, as if it had never been written.
"""

import random
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm


class KeepsGenerators(BaseAlgorithm):
    """Keeps the states of all generators as a rollout found them. Mixed in before an algorithm."""

    _rng_at_rollout: tuple[Any, Any, th.Tensor] | None = None
    _cuda_at_rollout: list[th.Tensor] | None = None  # one per device

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> Any:
        legacy = np.random.get_state()  # noqa: NPY002 (the generator SB3 draws from)
        self._rng_at_rollout = (random.getstate(), legacy, th.get_rng_state())
        self._cuda_at_rollout = th.cuda.get_rng_state_all() if self.device.type == "cuda" else []
        return super().collect_rollouts(*args, **kwargs)  # type: ignore[misc]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_rng_at_rollout", "_cuda_at_rollout"]

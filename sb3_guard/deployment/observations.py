"""What an exported policy is given: its inputs by name, and how they are normalised."""

from collections.abc import Mapping
from itertools import takewhile
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import (
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecNormalize,
)
from torch import nn

from sb3_guard.vector import layers, normalizer_of

#: The name of an observation that is not a dictionary.
OBSERVATION = "observation"


def inputs_of(space: spaces.Space) -> dict[str, spaces.Space]:
    """The observation spaces by the names of the inputs, in their order."""
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {OBSERVATION: space}


class Normalizer(nn.Module):
    """``VecNormalize`` of observations, in float64 as there.

    :param env: the environments that the policy was trained in, with their wrappers
    :raises ValueError: a wrapper outside VecNormalize changes observations in a way that is not
        known here
    """

    def __init__(self, env: VecEnv) -> None:
        super().__init__()
        self.names: list[str] = []
        self.clip = np.inf
        normalizer = normalizer_of(env)
        if normalizer is not None:
            outside = [*takewhile(lambda layer: layer is not normalizer, layers(env))]
            self._take(normalizer, outside[::-1])

    def _take(self, normalize: VecNormalize, outside: list[VecEnvWrapper]) -> None:
        """Take over the statistics, in the layout that wrappers from inside to outside make."""
        if not normalize.norm_obs:
            return
        self.clip = float(normalize.clip_obs)
        statistics: Any = normalize.obs_rms
        if not isinstance(statistics, Mapping):
            statistics = {OBSERVATION: statistics}
        for name, moments in statistics.items():
            self.names.append(name)
            std = np.sqrt(moments.var + normalize.epsilon)
            for moment, value in (("mean", moments.mean), ("std", std)):
                for wrapper in outside:
                    value = _wrapped(wrapper, value, name)
                tensor = th.as_tensor(value, dtype=th.float64)
                self.register_buffer(f"{moment}_{name}", tensor)

    def forward(self, inputs: Mapping[str, th.Tensor]) -> dict[str, th.Tensor]:
        """The inputs, those with statistics normalised and in float32."""
        return {name: self._normalized(name, value) for name, value in inputs.items()}

    def _normalized(self, name: str, value: th.Tensor) -> th.Tensor:
        if name not in self.names:
            return value
        mean, std = self.moments(name)
        return ((value.double() - mean) / std).clamp(-self.clip, self.clip).float()

    def moments(self, name: str) -> tuple[th.Tensor, th.Tensor]:
        """Mean and standard deviation of an input."""
        return getattr(self, f"mean_{name}"), getattr(self, f"std_{name}")


def _wrapped(wrapper: VecEnvWrapper, value: np.ndarray, name: str) -> np.ndarray:
    """One number for each of an observation's, in the layout of a wrapper's observations."""
    if isinstance(wrapper, VecFrameStack):
        stacked: Any = wrapper.stacked_obs
        stacked = getattr(stacked, "sub_stacked_observations", {}).get(name, stacked)
        return np.concatenate([value] * stacked.n_stack, axis=stacked.repeat_axis)
    inner, outer = (inputs_of(e.observation_space)[name] for e in (wrapper.venv, wrapper))
    if inner != outer:
        raise ValueError(
            f"{type(wrapper).__name__} outside VecNormalize changes observations and can't be "
            "exported; put it inside, with vec_env_wrapper"
        )
    return value


def joined(inputs: Mapping[str, th.Tensor], space: spaces.Space) -> PyTorchObs:
    """The inputs as the policy knows its observation: a dictionary, or one tensor."""
    return dict(inputs) if isinstance(space, spaces.Dict) else inputs[OBSERVATION]

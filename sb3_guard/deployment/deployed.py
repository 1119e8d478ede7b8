"""A whole agent as one module: raw observations in, actions and controls out."""

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_guard.deployment.environment import drive
from sb3_guard.deployment.observations import Normalizer, inputs_of, joined
from sb3_guard.deployment.policies import Acting


class Deployed(nn.Module):
    """An agent with all that stands between a sensor and an actuator.

    :param model: the agent
    :param env: environments with the wrappers of training
    :param sampled: whether actions are sampled
    :raises ValueError: the agent is of a kind that can't be exported
    """

    offset: th.Tensor
    scale: th.Tensor
    least: th.Tensor
    most: th.Tensor

    def __init__(self, model: BaseAlgorithm, env: VecEnv, sampled: bool) -> None:
        super().__init__()
        self.space = model.observation_space
        self.acting, self.normalizer = Acting(model, sampled), Normalizer(env)
        #: inputs and outputs by name, in their order
        self.inputs = [*inputs_of(self.space)]
        self.inputs += ["noise"] if sampled else []
        self.inputs += ["last_cost"] if self.acting.acts_on_cost else []
        self.outputs = ["action"]
        driven = drive(env)
        if driven is not None:
            self.outputs.append("control")
            self.register_buffer("offset", th.as_tensor(driven.offset).float())
            self.register_buffer("scale", th.as_tensor(driven.scale).float())
            low, high = zip(*(actuator.control for actuator in driven.actuators), strict=True)
            self.register_buffer("least", th.as_tensor(low).float())
            self.register_buffer("most", th.as_tensor(high).float())
        if isinstance(model.action_space, spaces.Box):
            self.shape: tuple[int, ...] = model.action_space.shape
        else:
            self.shape = ()
        self.to(model.device)

    def forward(self, *values: th.Tensor) -> tuple[th.Tensor, ...]:
        """The outputs in their order, from the inputs in theirs, each with a first dimension B."""
        inputs = dict(zip(self.inputs, values, strict=True))
        noise, last_cost = inputs.pop("noise", None), inputs.pop("last_cost", None)
        observations = joined(self.normalizer(inputs), self.space)
        actions = self.acting(observations, noise, last_cost)
        outputs = [actions.reshape(-1, *self.shape) if len(self.shape) > 1 else actions]
        if "control" in self.outputs:
            controls = self.offset + self.scale * actions
            outputs.append(th.minimum(th.maximum(controls, self.least), self.most))
        return tuple(outputs)

    def draw(self, n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Inputs at random: observations as far apart as those of training, or as the space is."""
        drawn = {}
        for name, space in inputs_of(self.space).items():
            space.seed(int(rng.integers(2**31)))
            value = np.stack([space.sample() for _ in range(n)])
            if name in self.normalizer.names and np.issubdtype(value.dtype, np.floating):
                mean, std = self.normalizer.moments(name)
                spread = std.numpy(force=True) * rng.normal(size=value.shape)
                value = (mean.numpy(force=True) + spread).astype(value.dtype)
            drawn[name] = value
        if "noise" in self.inputs:
            size = int(np.prod(self.shape))
            drawn["noise"] = rng.standard_normal((n, size), dtype=np.float32)
        if "last_cost" in self.inputs:
            drawn["last_cost"] = rng.random((n, 1), dtype=np.float32)
            drawn["last_cost"][::2] = np.nan  # half of them not known
        return drawn

"""Replay buffers that carry costs in addition to rewards."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import (
    DictReplayBuffer,
    NStepReplayBuffer,
    ReplayBuffer,
)


class CostReplayBufferSamples(NamedTuple):
    """What SB3's replay buffers return, and the costs of the B transitions, shape [B, m].

    With n-step returns, costs are discounted sums of n steps, and ``cost_discounts`` [B, 1] are
    what the value after them counts, as ``discounts`` are for the reward.
    """

    observations: Any
    actions: th.Tensor
    next_observations: Any
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | None
    costs: th.Tensor
    cost_discounts: th.Tensor | None = None


def _of_length(rows: int, value: Any, length: int) -> Any:
    """An array of so many rows, or a dictionary of such, cut or filled with zeros to a length."""
    if isinstance(value, dict):
        return {key: _of_length(rows, item, length) for key, item in value.items()}
    if not isinstance(value, np.ndarray) or len(value) != rows:
        return value
    if length <= rows:
        return value[:length]
    filled = np.zeros((length, *value.shape[1:]), value.dtype)
    filled[:rows] = value
    return filled


class CostReplayBuffer(ReplayBuffer):
    """SB3's replay buffer with the costs of each step; rows that are empty are not pickled.

    :param n_costs: number m of costs
    """

    def __init__(self, *args: Any, n_costs: int = 1, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.costs = np.zeros((self.buffer_size, self.n_envs, n_costs), np.float32)

    def __getstate__(self) -> dict[str, Any]:
        # One more with `optimize_memory_usage`, where it is the next observation of the last.
        rows = min(self.size() + 1, self.buffer_size)
        state = {n: _of_length(self.buffer_size, v, rows) for n, v in vars(self).items()}
        return {**state, "rows": rows}

    def __setstate__(self, state: dict[str, Any]) -> None:
        rows = state.pop("rows", state["buffer_size"])
        for name, value in state.items():
            setattr(self, name, _of_length(rows, value, state["buffer_size"]))

    def _get_samples(self, batch_inds: np.ndarray, env: Any = None) -> Any:
        # SB3 draws the environments of the rows in there and does not tell: look ahead.
        generator = np.random.get_state()  # noqa: NPY002 (the generator SB3 draws from)
        env_inds = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))  # noqa: NPY002
        np.random.set_state(generator)  # noqa: NPY002
        samples = super()._get_samples(batch_inds, env)
        costs = self.to_torch(self.costs[batch_inds, env_inds])
        return CostReplayBufferSamples(*samples, costs=costs)


class CostDictReplayBuffer(CostReplayBuffer, DictReplayBuffer):
    """The same for Dict observations."""


class CostNStepReplayBuffer(CostReplayBuffer, NStepReplayBuffer):
    """The same for n-step returns of rewards and costs.

    :param cost_gamma: discount factor of the costs
    """

    def __init__(self, *args: Any, cost_gamma: float = 0.99, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.cost_gamma = cost_gamma

    def _get_samples(self, batch_inds: np.ndarray, env: Any = None) -> Any:
        # SB3's sums of rewards, drawn anew for each cost in their place, from the same generator.
        generator = np.random.get_state()  # noqa: NPY002 (the generator SB3 draws from)
        samples = NStepReplayBuffer._get_samples(self, batch_inds, env)
        rewards, gamma = self.rewards, self.gamma
        self.gamma = self.cost_gamma
        sums = []
        for costs in np.moveaxis(self.costs, -1, 0):
            np.random.set_state(generator)  # noqa: NPY002
            self.rewards = costs
            sums.append(NStepReplayBuffer._get_samples(self, batch_inds))
        self.rewards, self.gamma = rewards, gamma
        return CostReplayBufferSamples(
            *samples,
            costs=th.cat([each.rewards for each in sums], dim=1),
            cost_discounts=sums[0].discounts,
        )

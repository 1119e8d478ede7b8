"""Rollout buffers that carry costs in addition to rewards."""

from collections.abc import Callable, Generator
from typing import Any, Literal, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import PyTorchObs, TensorDict
from stable_baselines3.common.utils import obs_as_tensor

from sb3_guard.algorithms.common.advantage import discounted_returns, gae


class CostRolloutBufferSamples(NamedTuple):
    """A batch of B transitions with m cost signals; the first six fields are SB3's."""

    observations: th.Tensor | TensorDict
    actions: th.Tensor  # [B, action_dim]
    old_values: th.Tensor  # [B]
    old_log_prob: th.Tensor  # [B]
    advantages: th.Tensor  # [B]
    returns: th.Tensor  # [B]
    costs: th.Tensor  # [B, m], raw
    cost_advantages: th.Tensor  # [B, m]
    cost_returns: th.Tensor  # [B, m]
    previous_costs: th.Tensor  # [B, m], of the step before; 0 at the start of an episode
    executed_actions: th.Tensor  # [B, action_dim], or [B, 0] where nothing corrects actions
    places: th.Tensor  # [B], where in the whole rollout the rows are


_FIELDS = CostRolloutBufferSamples._fields[6:-1]
_SB3_FIELDS = ("actions", "values", "log_probs", "advantages", "returns")


class CostRolloutBuffer(RolloutBuffer):
    """On-policy transitions with their costs, cost advantages and cost returns.

    ``costs`` [T, n_envs, m] are raw; ``cost_bootstraps`` hold what a time-out adds to them.

    :param n_costs: number m of cost signals
    :param cost_gamma: discount factor of the costs
    :param cost_gae_lambda: bias-variance trade-off of the cost advantages
    :param keep_executed: whether there is room for executed actions in addition to the sampled ones
    :param returns: what the critics learn, of rewards and costs alike: ``"lambda"`` for SB3's
        λ-returns, ``"discounted"`` for discounted sums to come

    Other parameters are those of SB3's ``RolloutBuffer``.
    """

    def __init__(
        self,
        *args: Any,
        n_costs: int = 1,
        cost_gamma: float = 0.99,
        cost_gae_lambda: float = 1.0,
        keep_executed: bool = False,
        returns: Literal["lambda", "discounted"] = "lambda",
        **kwargs: Any,
    ) -> None:
        self.targets = returns
        self.n_costs = n_costs
        self.cost_gamma = cost_gamma
        self.cost_gae_lambda = cost_gae_lambda
        self.keep_executed = keep_executed
        super().__init__(*args, **kwargs)

    def reset(self) -> None:
        shape = (self.buffer_size, self.n_envs, self.n_costs)
        self.costs = np.zeros(shape, dtype=np.float32)
        # γ V_c of the observation an episode was cut at: kept apart, the costs stay raw.
        self.cost_bootstraps = np.zeros(shape, dtype=np.float32)
        self.cost_values = np.zeros(shape, dtype=np.float32)
        self.cost_advantages = np.zeros(shape, dtype=np.float32)
        self.cost_returns = np.zeros(shape, dtype=np.float32)
        self.previous_costs = np.zeros(shape, dtype=np.float32)
        executed = self.action_dim if self.keep_executed else 0
        self.executed_actions = np.zeros((*shape[:2], executed), dtype=np.float32)
        super().reset()

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: np.ndarray) -> None:
        """SB3's advantages and returns; or discounted returns, whatever ``gae_lambda`` is."""
        super().compute_returns_and_advantage(last_values, dones)
        if self.targets == "discounted":
            last = last_values.cpu().numpy().flatten()
            self.returns = discounted_returns(
                self.rewards, self.episode_starts, last, dones, self.gamma
            )

    def compute_cost_returns_and_advantage(
        self, last_cost_values: np.ndarray, dones: np.ndarray
    ) -> None:
        """Finish the cost half once the rollout is full and ``cost_values`` are known.

        :param last_cost_values: values of the observations after the last step, shape [n_envs, m]
        :param dones: whether the last step ended an episode, shape [n_envs]
        """
        costs = self.costs + self.cost_bootstraps
        self.cost_advantages = gae(
            costs,
            self.cost_values,
            self.episode_starts,
            last_cost_values,
            dones,
            self.cost_gamma,
            self.cost_gae_lambda,
        )
        if self.targets == "lambda":
            self.cost_returns = self.cost_advantages + self.cost_values
        else:
            self.cost_returns = discounted_returns(
                costs, self.episode_starts, last_cost_values, dones, self.cost_gamma
            )

    def observations_by_time(self, device: th.device) -> PyTorchObs:
        """All observations before :meth:`get`, step by step, shape [T · n_envs, …]."""
        flat = self._each(lambda array: array.reshape(-1, *array.shape[2:]))
        return obs_as_tensor(flat, device)

    def _each(self, function: Callable[[np.ndarray], np.ndarray]) -> Any:
        """The observations, or those of each key, after a function."""
        stored: Any = self.observations
        if isinstance(stored, dict):
            return {key: function(array) for key, array in stored.items()}
        return function(stored)

    def _flatten(self) -> None:
        """[T, n, …] -> [n · T, …]: one environment's steps after the other's, as SB3 does."""
        if self.generator_ready:
            return
        assert self.full, "the rollout has not ended yet"
        for name in (*_SB3_FIELDS, *_FIELDS):
            setattr(self, name, self.swap_and_flatten(getattr(self, name)))
        self.observations = self._each(self.swap_and_flatten)
        self.generator_ready = True

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        self._flatten()
        yield from super().get(batch_size)

    def whole(self) -> CostRolloutBufferSamples:
        """The rollout in order, one environment's steps after the other's; nothing is drawn."""
        self._flatten()
        return self._get_samples(np.arange(self.buffer_size * self.n_envs))

    def _get_samples(self, batch_inds: np.ndarray, env: Any = None) -> Any:
        samples = super()._get_samples(batch_inds, env)
        arrays = (*(getattr(self, name)[batch_inds] for name in _FIELDS), batch_inds)
        # indexing has copied them
        return CostRolloutBufferSamples(
            *samples, *(self.to_torch(array, copy=False) for array in arrays)
        )


class CostDictRolloutBuffer(CostRolloutBuffer, DictRolloutBuffer):
    """:class:`CostRolloutBuffer` for dictionary observations."""

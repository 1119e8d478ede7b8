"""Hierarchical safety: TRPO learns as if alone, and a learned filter corrects what is executed."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import obs_as_tensor

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.policies import (
    FilteredCnnPolicy,
    FilteredMultiInputPolicy,
    FilteredPolicy,
)
from sb3_guard.algorithms.common.trust_region import TrustRegion
from sb3_guard.costs import check_per_cost
from sb3_guard.fields import fit


class FilteredTrustRegion(TrustRegion):
    """TRPO behind an action filter.

    The surrogate uses the sampled actions and their probabilities, the environment executes the
    corrected ones: the filter is part of the environment that the policy lives in. It learns from
    the first rollout on and is switched on after a warm-up.

    :param policy: policy class or its alias; a class of one's own derives from ``FilteredPolicy``
    :param env: environment or its id; its actions are a Box
    :param learning_rate: of the critic and the filter's network
    :param warmup: share of the first ``learn`` before the filter is switched on; an integer is a
        number of steps
    :param threshold: cost, in the units of the filter's model, that is not corrected; one number or
        one per cost key; None derives it from ``cost_limit``
    :param correction_penalty: κ, in standard deviations of A: the policy ascends
        ``E[ratio · (A - κ |x - a|)]``, x the executed and a the sampled action in units of the
        action space, or it learns to push against the filter; 0 for none, as in the papers
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": FilteredPolicy,
        "CnnPolicy": FilteredCnnPolicy,
        "MultiInputPolicy": FilteredMultiInputPolicy,
    }
    uses_cost_critic = False

    warmup: int | float = hyperparameter(1 / 3)
    threshold: float | Sequence[float] | None = hyperparameter(None)
    correction_penalty: float = hyperparameter(1.0)

    policy: FilteredPolicy

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # Steps after which the filter is switched on; known once `learn` was called.
        self.filter_from: int | None = None
        super().__init__(*args, **kwargs)

    def _check_hyperparameters(self) -> None:
        super()._check_hyperparameters()
        if self.env is not None and not isinstance(self.action_space, spaces.Box):
            raise ValueError(f"{type(self).__name__} corrects actions of a Box only")
        if not issubclass(self.policy_class, FilteredPolicy):
            name = self.policy_class.__name__
            raise ValueError(
                f"policy={name}: must carry an action filter; define class Filtered{name}"
                f"(FilteredPolicy, {name}), with FilteredPolicy from {FilteredPolicy.__module__}"
            )
        if isinstance(self.warmup, int | np.integer):
            fit("warmup", self.warmup, int, 0, ends="[)")
        else:
            fit("warmup", self.warmup, float, 0.0, 1.0, "[]")
        if self.threshold is not None:
            check_per_cost("threshold", self.threshold, tuple(self.cost_keys))

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "policy.action_filter.optimizer"], tensors

    def set_parameters(self, *args: Any, **kwargs: Any) -> None:
        super().set_parameters(*args, **kwargs)
        # A given threshold is a hyperparameter, which `load` may change.
        self._set_threshold(self.policy.action_filter.threshold.cpu().numpy())

    def _setup_learn(
        self, total_timesteps: int, *args: Any, **kwargs: Any
    ) -> tuple[int, BaseCallback]:
        prepared = super()._setup_learn(total_timesteps, *args, **kwargs)
        if self.filter_from is None:
            share = not isinstance(self.warmup, int | np.integer)
            self.filter_from = math.ceil(self.warmup * (total_timesteps if share else 1))
        self._switch_on()
        return prepared

    def _switch_on(self) -> None:
        """Activate the filter if its time has come; it stays active from then on."""
        assert self.filter_from is not None
        if self.num_timesteps >= self.filter_from:
            self.policy.action_filter.active.fill_(True)

    def _set_threshold(self, derived: np.ndarray) -> None:
        """Set the filter's thresholds: the given ones, else those derived from the cost limit."""
        chosen = derived if self.threshold is None else np.asarray(self.threshold, np.float64)
        filter_threshold = self.policy.action_filter.threshold
        filter_threshold.copy_(th.as_tensor(np.broadcast_to(chosen, derived.shape).copy()))

    def correct(self, observations: Any, actions: np.ndarray) -> np.ndarray:
        return self.policy.correct(
            obs_as_tensor(observations, self.device), actions, self.costs.last
        )

    def _unit(self, actions: np.ndarray) -> th.Tensor:
        """Actions of the environment in units of the action space, shape [B, k]."""
        flat = th.as_tensor(actions.reshape(len(actions), -1), dtype=th.float32)
        return self.policy.box.unit(flat.to(self.device))

    def _executed(self, batch: CostRolloutBufferSamples) -> th.Tensor:
        """The executed actions of a batch in units of the action space, shape [B, k]."""
        return self._unit(batch.executed_actions.cpu().numpy())

    def _corrections(self, batch: CostRolloutBufferSamples) -> th.Tensor:
        """How far the executed actions are from the sampled ones, clipped to the box, shape [B]."""
        sampled = self._unit(self.policy.executable(batch.actions.cpu().numpy()))
        return (self._executed(batch) - sampled).norm(dim=1)

    def advantages(self, batch: CostRolloutBufferSamples) -> th.Tensor:
        lengths = self._corrections(batch)
        if self.correction_penalty == 0.0 or not lengths.any():
            return batch.advantages
        penalty = self.correction_penalty * self.advantage_unit()
        return batch.advantages - penalty * (lengths - lengths.mean())

    def _choose_cost_units(self) -> np.ndarray:
        # The root mean square of those costs of a step that are not zero, the largest so far: the
        # first rollout may only have touched what costs.
        costs = self.rollout_buffer.costs.astype(np.float64)
        met = np.maximum(np.count_nonzero(costs, axis=(0, 1)), 1)
        sizes = np.sqrt(np.square(costs).sum(axis=(0, 1)) / met).astype(np.float32)
        units = sizes if self.cost_units is None else np.maximum(self.cost_units, sizes)
        self.cost_units = units
        self.policy.action_filter.unit.copy_(th.as_tensor(np.where(units, units, np.float32(1.0))))
        return units

    def value_rollout(self) -> None:
        """Renew the units that the filter's network measures costs in."""
        self._choose_cost_units()

    def fit(self, batch: CostRolloutBufferSamples) -> None:
        """Log what was corrected; leaves then fit their model."""
        lengths = self._corrections(batch)
        corrected = lengths > 1e-5
        self.logger.record("train/corrected_fraction", corrected.float().mean().item())
        norm = lengths[corrected].mean().item() if corrected.any() else 0.0
        self.logger.record("train/correction_norm", norm)
        self._update_learning_rate(self.policy.action_filter.optimizer)
        self._switch_on()

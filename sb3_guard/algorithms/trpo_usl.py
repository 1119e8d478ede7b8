"""TRPO-USL: TRPO behind a layer that descends the predicted cost to come."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor

from sb3_guard.algorithms.common.action_filters import UnrolledSafetyLayer
from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.filtering import FilteredTrustRegion


class TRPOUSL(FilteredTrustRegion):
    """TRPO with an unrolled safety layer (Zhang et al., 2022, arXiv 2212.05727).

    ::

        execute   a after at most K steps   a ← clip(a - η ∇_a h / |∇_a h|_∞),   while h > 0
                  where   h(s, a) = Σ max(0, Q_i(s, a) - threshold_i) / unit_i

    starting from the sampled action, clipped to the box of the action space. Q_i is the discounted
    cost to come of the executed actions, a network with a softplus output fitted to λ-returns with
    λ = ``cost_gae_lambda``, and unit_i the largest root mean square yet of a rollout's costs of a
    step that are not zero. It can't learn costs below zero. With λ = 0 the target is
    ``c + γ Q(s', a')``, a' the action executed next, as in GUARD; fitted once per update, such a
    critic needs hundreds of updates to forget where it started. The paper's exact penalty is left
    out, as in GUARD.

    :param learning_rate: of the critic and the cost Q-critic
    :param threshold: highest discounted cost to come that is not corrected; one number or one per
        cost key; None: the larger of ``tolerance`` · unit and ``(d/T) (1 - γᵀ)/(1 - γ)``, or
        ``(d/T) / (1 - γ)`` where a time limit cuts episodes, whose cost is bootstrapped
    :param tolerance: what the Q-critic may say of a state where nothing costs, in its units: a
        softplus never is zero
    :param steps: K
    :param rate: η, in units of the action space, which runs from -1 to 1
    """

    label, family, paper = "TRPO-USL", "hierarchical", "Zhang et al. 2022"
    search_space: ClassVar[dict[str, Any]] = {
        "warmup": {"low": 0.0, "high": 0.5},
        "steps": {"low": 5, "high": 40, "log": True},
        "rate": {"low": 0.01, "high": 0.2, "log": True},
        "tolerance": {"low": 0.005, "high": 0.5, "log": True},
    }

    tolerance: float = hyperparameter(0.05)
    steps: int = hyperparameter(20)
    rate: float = hyperparameter(0.05, ends="()")

    def _setup_model(self) -> None:
        super()._setup_model()
        self.policy.carry(
            UnrolledSafetyLayer,
            {"n_costs": len(self.cost_keys), "steps": self.steps, "rate": self.rate},
        )
        self._set_threshold(np.full(len(self.cost_keys), self.tolerance))

    def value_rollout(self) -> None:
        """Value the executed actions, those after the last step by the policy that took them."""
        super().value_rollout()
        buffer = self.rollout_buffer
        observations = buffer.observations_by_time(self.device)
        executed = self._unit(buffer.executed_actions.reshape(-1, buffer.action_dim))
        values = self.policy.action_filter.values(observations, executed)
        buffer.cost_values = values.cpu().numpy().reshape(buffer.costs.shape)
        for step, i, observation in self._timeouts if buffer.cost_gamma < 1.0 else ():
            terminal, _ = self.policy.obs_to_tensor(observation)
            buffer.cost_bootstraps[step, i] = buffer.cost_gamma * self._value_ahead(terminal)[0]
        assert self._last_obs is not None and self._last_episode_starts is not None
        last = self._value_ahead(obs_as_tensor(self._last_obs, self.device))
        buffer.compute_cost_returns_and_advantage(last, self._last_episode_starts)
        buffer.cost_returns = buffer.cost_advantages + buffer.cost_values  # of λ, in any case

    def fit(self, batch: CostRolloutBufferSamples) -> None:
        super().fit(batch)
        unit = self.policy.action_filter.unit
        loss = self.policy.action_filter.learn(
            (batch.observations, self._executed(batch)),
            batch.cost_returns / unit,
            self.n_critic_updates,
            self.critic_batch(len(batch.cost_returns)),
        )
        self._check_finite("cost_model_loss", loss)
        self.logger.record("train/cost_model_loss", loss)
        tolerance = self.tolerance * unit.cpu().numpy()
        self._set_threshold(np.maximum(self.discounted_limits(), tolerance))

    @th.no_grad()
    def _value_ahead(self, observations: PyTorchObs) -> np.ndarray:
        """Costs to come of observations whose action was never taken, shape [B, m]."""
        sampled = self.policy.get_distribution(observations).get_actions()
        actions = self.policy.executable(sampled.cpu().numpy())
        executed = self._unit(self.policy.correct(observations, actions))
        return self.policy.action_filter.values(observations, executed).cpu().numpy()

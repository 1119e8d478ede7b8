"""TRPO-SL: TRPO behind a safety layer that keeps the predicted cost of the next step low."""

from typing import Any, ClassVar

import numpy as np
import torch as th

from sb3_guard.algorithms.common.action_filters import SafetyLayer
from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.batches import rows
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.filtering import FilteredTrustRegion


class TRPOSL(FilteredTrustRegion):
    """TRPO with a safety layer (Dalal et al., 2018, arXiv 1801.08757).

    ::

        execute   argmin_x ½ |x - a|²   subject to   ĉ_i(s, x) ≤ threshold_i,   x in the box
              where         ĉ_i(s, x) = c_i + b_i(s) + g_i(s) · x

    a is the sampled action, clipped to the box of the action space; c_i is what the last step cost
    and b, g networks fitted to the costs of the executed actions, so that ĉ predicts the cost of
    this step. What exceeds the threshold by less than ε_i is left alone, and so are states where
    actions change ĉ_i by less; ε_i is ``tolerance`` times the root mean square error of ĉ_i on the
    last rollout. Steps without cost are so many that as many of them are drawn again for each step
    of the optimizer, as there are steps with a cost.

    :param learning_rate: of the critic and the cost model
    :param threshold: highest predicted cost of a step that is not corrected; one number or one per
        cost key; None: d/T
    :param tolerance: ε in units of the model's error; 0 for none, as in the paper
    :param drift: let the model add b_i(s), for cost that changes whatever the agent does, as when
        it coasts or a hazard moves. Off by default: before the tests' wall it is afraid of every
        action, and stops at 0.77 of the best return instead of 0.99
    """

    label, family, paper = "TRPO-SL", "hierarchical", "Dalal et al. 2018"
    search_space: ClassVar[dict[str, Any]] = {
        "cost_gae_lambda": None,
        "warmup": {"low": 0.0, "high": 0.5},
        "drift": [False, True],
        "tolerance": {"low": 0.0, "high": 4.0},
    }

    #: Passes over the steps that cost, which are few, and as many others.
    model_passes = 80

    tolerance: float = hyperparameter(1.0)
    drift: bool = hyperparameter(False)

    def _setup_model(self) -> None:
        super()._setup_model()
        self.policy.carry(SafetyLayer, {"n_costs": len(self.cost_keys), "drift": self.drift})
        # What is derived from the limit is known once an episode has ended.
        self._set_threshold(np.zeros(len(self.cost_keys)))

    def fit(self, batch: CostRolloutBufferSamples) -> None:
        super().fit(batch)
        layer = self.policy.action_filter
        self._set_threshold(self.costs.limits / self.costs.horizon)
        costly = (batch.costs != 0.0).any(dim=1)
        some, none = costly.nonzero().flatten(), (~costly).nonzero().flatten()
        if not len(some):
            return
        actions, previous = self._executed(batch), batch.previous_costs / layer.unit
        data = (batch.observations, actions, previous)
        targets = th.cat([batch.costs / layer.unit, previous], dim=1)
        loss = 0.0
        for _ in range(self.model_passes):
            drawn = th.randperm(len(none))[: len(some)].to(none.device)
            index = th.cat([some, none[drawn]])
            loss = layer.learn(rows(data, index), targets[index], 1, self.batch_size)
        self._check_finite("cost_model_loss", loss)
        error = layer.error(batch.observations, actions, batch.previous_costs, batch.costs)
        layer.noise.copy_(self.tolerance * error)
        self._record_per_cost("train/cost_model_error", error.cpu().numpy())
        self.logger.record("train/cost_model_loss", loss)

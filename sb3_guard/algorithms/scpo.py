"""SCPO: CPO's step on the increments of the highest cost so far, a limit on the worst step."""

from typing import ClassVar, Literal

import torch as th

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.cpo import CPO


class SCPO(CPO):
    """State-wise constrained policy optimisation (Zhao et al., 2023, arXiv 2306.12594).

    ::

        maximise   J(π)
        subject to E[max_t c_t] ≤ w       for each cost, w = cost_limit

    With ``M_t``, the highest cost before step t (0 at first), the increments
    ``D_t = max(0, c_t - M_t)`` add up to the highest cost of an episode. The step is CPO's on the
    advantages of D, undiscounted. M belongs to the state: ``VecMaxCost`` from
    ``sb3_guard.common.vec_budgets`` shows it to policy and critic, as in the paper; an environment
    that is not wrapped in it trains too, by observations that do not tell what has been reached.

    Most increments are 0: the cost critic is fitted to all rows whose cost-to-go is positive and as
    many others, drawn again for each update.
    """

    label, family, paper = "SCPO", "State-wise", "Zhao et al. 2023"
    limit_on: ClassVar[Literal["sum", "max"]] = "max"
    signed_limits = False  # the highest cost so far begins at 0
    # The increments add up to the highest cost undiscounted alone.
    fixed_arguments: ClassVar[frozenset[str]] = CPO.fixed_arguments | {"cost_gamma"}

    cost_gamma: float | None = hyperparameter(1.0)
    cost_gae_lambda: float | None = hyperparameter(None, high=1.0, ends="[]")

    def critic_rows(self, targets: th.Tensor) -> slice | th.Tensor:
        positive = (targets > 0.0).any(dim=1)
        rare, others = positive.nonzero().ravel(), (~positive).nonzero().ravel()
        if len(rare) == 0 or len(others) <= len(rare):
            return slice(None)
        drawn = self.cost_rng.choice(len(others), len(rare), replace=False)
        return th.cat([rare, others[th.as_tensor(drawn, device=others.device)]])

    def fit(self, batch: CostRolloutBufferSamples) -> None:
        super().fit(batch)
        self._record_per_cost("rollout/ep_max_cost_mean", self.costs.episode_cost)

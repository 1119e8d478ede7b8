"""CPO: trust-region steps that keep the linearised cost limits, solved exactly."""

from typing import Any, ClassVar

import numpy as np
import torch as th

from sb3_guard.algorithms.common.actor import Accept, Region
from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.costs import Margin
from sb3_guard.algorithms.common.natural_gradient import Case, constrained_step
from sb3_guard.algorithms.common.trust_region import TrustRegion


class CPO(TrustRegion):
    """Constrained policy optimisation (Achiam et al., 2017, arXiv 1705.10528).

    ::

        maximise   gᵀx            g    gradient of E[ratio · A]
        subject to c + Bx ≤ 0     B, c gradients of E[ratio · A_C], violations (J_C - d) / T
                   ½ xᵀFx ≤ δ     F    Fisher matrix of the old policy

    Where no such step makes the policy feasible, it lowers the violation, of several limits
    ``Σ max(0, c_i + b_iᵀx)²``, by ``recovery`` of what the region allows. Until the limits hold,
    the line search asks for no more cost, or no more of that sum, and not for more reward. A limit
    whose cost no step changes is left out. The limits are kept with a learnt
    :class:`~sb3_guard.algorithms.common.costs.Margin`, which the paper does not have.

    :param margin_lr: α, how fast the margin follows J_C - d; 0 for no margin, as in the paper
    :param recovery: share of the largest possible decrease of a cost that a step asks for where the
        limit is out of reach, which leaves the rest of the region to the reward, so that a limit
        that nothing keeps does not end all learning; 1 for all of it, as in the paper
    """

    label, family, paper = "CPO", "CPO-based", "Achiam et al. 2017"
    search_space: ClassVar[dict[str, Any]] = {"margin_lr": [0.0, 0.05, 0.1, 0.2]}
    signed_limits = True

    # Costs far ahead are noisy in a rollout, so they are left to the cost critic.
    cost_gae_lambda: float | None = hyperparameter(0.5, high=1.0, ends="[]")
    margin_lr: float = hyperparameter(0.1)
    recovery: float = hyperparameter(0.98, high=1.0, ends="(]")

    margin: Margin = None  # type: ignore[assignment]

    def _setup_model(self) -> None:
        super()._setup_model()
        self.margin = self.margin or Margin(len(self.cost_keys))

    def plan(self, region: Region) -> tuple[th.Tensor, Accept]:
        g, B, delta = region.gradient, region.cost_gradients, region.delta
        c = self.margin.violation(self.costs)
        v, W = region.solve(g), th.stack([region.solve(b) for b in B])
        x, case, lambda_kl, nu, moves = constrained_step(g, B, c, v, W, delta, self.recovery)
        self.logger.record("train/cpo_case", int(case))
        self.logger.record("train/lambda_kl", lambda_kl)
        self._record_per_cost("train/nu", nu)
        return (
            x,
            lambda trial: (
                trial.kl <= delta
                and cheaper(c[moves], trial.cost_change[moves], case)
                and (trial.improvement >= 0.0 or not case.feasible)
            ),
        )

    def fit(self, batch: CostRolloutBufferSamples) -> None:
        self.margin.follow(self.costs, self.margin_lr)
        self._record_per_cost("train/cost_margin", self.margin.value)


def cheaper(c: np.ndarray, change: np.ndarray, case: Case) -> bool:
    """Whether limits are kept after a change of the costs, or their violation does not grow.

    :param c: violations before it, shape (m,)
    """
    if case is Case.LOST and len(c) > 1:
        # Limits that contradict each other: less of one violation may be more of another.
        now, then = (float(np.linalg.norm(each.clip(min=0.0))) for each in (c, c + change))
        return then <= max(0.0, now)
    return bool(np.all(change <= np.maximum(-c, 0.0)))

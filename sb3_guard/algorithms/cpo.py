"""CPO: trust-region steps that keep the linearised cost limits."""

from typing import Any, ClassVar

import numpy as np
import torch as th

from sb3_guard.algorithms.common.checks import check_number
from sb3_guard.algorithms.common.margin import Margin
from sb3_guard.algorithms.common.natural_gradient import Case, constrained_step
from sb3_guard.algorithms.common.trust_region import Region, Trial


class CPO(Margin):
    """Constrained policy optimisation (Achiam et al., 2017, arXiv 1705.10528).

    ::

        maximise   gᵀx            g    gradient of E[ratio · A]
        subject to c + Bx ≤ 0     B, c gradients of E[ratio · A_C], violations (J_C - d) / T
                   ½ xᵀFx ≤ δ     F    Fisher matrix of the old policy

    solved exactly at each update. From a policy that no step within the trust region can make
    feasible, the step lowers the violation as much as the region allows: of several limits,
    ``Σ max(0, c_i + b_iᵀx)²``. Until the limits hold, the line search asks for less cost, or less
    of that sum, and not for more reward. The limits are kept with a learnt margin
    (:class:`~sb3_guard.algorithms.common.margin.Margin`), which the paper does not have.

    :param cost_reduction: smallest decrease of a violated cost surrogate that the line search
        accepts, in cost per step; never more than the violation itself. Where several limits can't
        be reached, of the root of the sum above
    """

    label, family, paper = "CPO", "CPO-based", "Achiam et al. 2017"
    search_space: ClassVar[dict[str, Any]] = {
        "margin_lr": [0.0, 0.05, 0.1, 0.2],
        "cost_reduction": {"low": 0.0, "high": 0.02},
    }

    def __init__(
        self,
        *args: Any,
        cost_reduction: float = 0.0,
        **kwargs: Any,
    ) -> None:
        self.cost_reduction = cost_reduction
        self._case = Case.INACTIVE
        super().__init__(*args, **kwargs)

    def _check_hyperparameters(self) -> None:
        super()._check_hyperparameters()
        check_number("cost_reduction", self.cost_reduction)

    def step(self, region: Region) -> th.Tensor:
        g, B, c, delta = region.gradient, region.cost_gradients, region.violation, region.delta
        v, W = region.solve(g), th.stack([region.solve(b) for b in B])
        x, self._case, lambda_kl, nu = constrained_step(g, B, c, v, W, delta)
        self.logger.record("train/cpo_case", int(self._case))
        self.logger.record("train/lambda_kl", lambda_kl)
        self._record_per_cost("train/nu", nu)
        return x

    def accept(self, trial: Trial) -> bool:
        c, change = self.violation(), trial.cost_change
        if self._case is Case.LOST and len(c) > 1:
            # Limits that contradict each other: less of one violation may be more of another.
            now, then = (float(np.linalg.norm(each.clip(min=0.0))) for each in (c, c + change))
            cheaper = then <= max(0.0, now - self.cost_reduction)
        else:
            cheaper = bool(np.all(change <= np.maximum(-c, -self.cost_reduction)))
        return (
            trial.kl <= self.target_kl
            and cheaper
            and (trial.improvement >= 0.0 or not self._case.feasible)
        )

"""Steps that keep linearised cost limits: CPO's, for any cost whose sum is to be bounded."""

import numpy as np
import torch as th

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.margin import Margin
from sb3_guard.algorithms.common.natural_gradient import Case, constrained_step
from sb3_guard.algorithms.common.trust_region import Region, Trial


class LinearisedLimits(Margin):
    """The best step within a trust region that keeps the linearised limits, solved exactly.

    From a policy that no such step can make feasible, the step lowers the violation, of several
    limits ``Σ max(0, c_i + b_iᵀx)²``, by ``recovery`` of what the region allows. Until the limits
    hold, the line search asks for less cost, or less of that sum, and not for more reward. A limit
    whose cost no step changes is left out.

    :param cost_reduction: smallest decrease of a violated cost surrogate that the line search
        accepts, in cost per step; never more than the violation itself. If several limits
        can't be reached, it applies to the root of the sum of their squared violations
    """

    cost_reduction: float = hyperparameter(0.0)

    _case = Case.INACTIVE
    _moves: np.ndarray | slice = slice(None)

    def step(self, region: Region) -> th.Tensor:
        g, B, c, delta = region.gradient, region.cost_gradients, region.violation, region.delta
        v, W = region.solve(g), th.stack([region.solve(b) for b in B])
        x, self._case, lambda_kl, nu, self._moves = constrained_step(
            g, B, c, v, W, delta, self.recovery
        )
        self.logger.record("train/cpo_case", int(self._case))
        self.logger.record("train/lambda_kl", lambda_kl)
        self._record_per_cost("train/nu", nu)
        return x

    def accept(self, trial: Trial) -> bool:
        c, change = self.violation()[self._moves], trial.cost_change[self._moves]
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

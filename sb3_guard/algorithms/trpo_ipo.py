"""TRPO-IPO: a logarithmic barrier keeps the policy away from the cost limits."""

import math
from typing import Any, ClassVar, Literal

import numpy as np
import torch as th

from sb3_guard.algorithms.common.actor import Accept, Region
from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.trust_region import TrustRegion

TINY = 1e-12


def barrier(excess: th.Tensor, t: float, slope: float) -> th.Tensor:
    """``log(-excess) / t``, continued by its tangent where it would fall steeper than ``slope``.

    Inside the limit it is the barrier of the interior-point method; the straight line takes over
    where ``-excess < 1 / (t · slope)``, so value and derivative are finite and continuous
    everywhere, and an infeasible policy is pushed back with weight ``slope``.

    :param excess: cost minus limit, any shape
    :param t: sharpness; the greater, the closer to the limit the optimum lies
    :param slope: steepest derivative, > 0
    """
    margin = 1.0 / (t * slope)
    inside = th.log((-excess).clamp(min=margin)) / t
    tangent = math.log(margin) / t - slope * (excess + margin)
    return th.where(excess <= -margin, inside, tangent)


class TRPOIPO(TrustRegion):
    """TRPO on an interior-point objective (Liu et al., 2020, arXiv 1910.09615).

    ::

        maximise   E[ratio · A] + Σ s_i φ((J_Ci + T E[ratio · A_Ci] - d_i) / d_i)
                   φ(x) = log(-x) / (m t),   s_i = d_i / (T σ(A_Ci))

    so that in the gradient the standardised cost advantage weighs ``d / (m t (d - J_C))``,
    relative to the standardised reward advantage: 1 / (m t) far inside the limit, more near it, and
    ``max_multiplier`` at most. With m costs each barrier is m times as sharp, so that all of them
    together cost as much return as one. Where it would be steeper, φ continues as a straight line,
    which also leads back where the limit is broken. The unit of the costs does not matter. While a
    limit is kept strictly, the line search accepts no policy whose estimated cost reaches it.

    :param t: sharpness of the barrier: the greater, the closer to the limit it lets the policy go
    :param max_multiplier: the most that cost may weigh against reward
    :param units: ``"relative"`` as above; ``"cost"`` for the raw form of the paper, the barrier
        ``log(d - J_C) / (t T)`` in units of an episode's cost, whatever their number
    """

    label, family, paper = "TRPO-IPO", "Lagrangian", "Liu et al. 2020"
    search_space: ClassVar[dict[str, Any]] = {
        "t": {"low": 2.0, "high": 100.0, "log": True},
        "max_multiplier": {"low": 0.5, "high": 20.0, "log": True},
    }

    t: float = hyperparameter(20.0, ends="()")
    max_multiplier: float = hyperparameter(2.0, ends="()")
    units: Literal["relative", "cost"] = hyperparameter("relative")

    def _unit(self) -> np.ndarray:
        """What excesses are measured in, shape (m,): the limit, or J_C where the limit is 0."""
        if self.units == "cost":
            return np.ones(len(self.cost_keys))
        limits = self.costs.limits
        return np.where(limits > 0.0, limits, np.maximum(self.costs.episode_cost, TINY))

    @property
    def _sharpness(self) -> float:
        return self.t * (len(self.cost_keys) if self.units == "relative" else 1.0)

    def _spread(self, batch: CostRolloutBufferSamples) -> th.Tensor:
        """What one standard deviation of a cost's advantages is in the reward's, shape (m,)."""
        if self.units == "cost":
            return th.ones_like(batch.cost_advantages[0])
        deviation = batch.cost_advantages.std(dim=0)
        return th.where(deviation > 0.0, self.advantage_unit() / deviation, 0.0)

    def surrogate(self, batch: CostRolloutBufferSamples, ratio: th.Tensor) -> th.Tensor:
        change = (ratio - 1.0) @ batch.cost_advantages / len(ratio)  # [m]
        horizon, unit = self.costs.horizon, th.as_tensor(self._unit()).to(change)
        excess = horizon * (th.as_tensor(self.costs.violation).to(change) + change) / unit
        scale = self._spread(batch) * unit / horizon
        penalty = (scale * barrier(excess, self._sharpness, self.max_multiplier)).sum()
        return (ratio * batch.advantages).mean() + penalty

    def plan(self, region: Region) -> tuple[th.Tensor, Accept]:
        x, accept = super().plan(region)
        violation = self.costs.violation
        inside = violation < 0.0
        return (
            x,
            lambda trial: (
                accept(trial) and bool(np.all((violation + trial.cost_change)[inside] < 0.0))
            ),
        )

    def fit(self, batch: CostRolloutBufferSamples) -> None:
        slack = -self.costs.violation * self.costs.horizon / self._unit()
        t, most = self._sharpness, self.max_multiplier
        weight = 1.0 / (t * np.maximum(slack, 1.0 / (t * most)))
        self._record_per_cost("train/multiplier", weight)
        self._record_per_cost("train/cost_weight", weight * self._spread(batch).cpu().numpy())

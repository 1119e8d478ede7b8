"""TRPO-IPO: a logarithmic barrier keeps the policy away from the cost limits."""

import math
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.checks import check_number
from sb3_guard.algorithms.common.trust_region import Trial, TrustRegion


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

        maximise   E[ratio · A] + (1/T) Σ φ(J_Ci + T E[ratio · A_Ci] - d_i),   φ(x) = log(-x) / t

    φ continues as a straight line of slope ``-max_multiplier`` once it would be steeper. So the
    cost weighs ``min(1 / (t (d - J_C)), max_multiplier)`` in the gradient, and ``max_multiplier``
    where the limit is broken, which at ``cost_limit=0`` is always. While a limit is kept strictly,
    the line search accepts no policy whose estimated cost reaches it.

    :param policy: policy class or its alias
    :param env: environment or its id
    :param learning_rate: of the critics
    :param t: sharpness of the barrier; at the optimum of a problem with m constraints it costs
        about m/t of an episode's return (standardised advantages: in their units)
    :param max_multiplier: the most that cost may weigh against reward

    Other parameters are those of :class:`TrustRegion`.
    """

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        *,
        t: float = 0.01,
        max_multiplier: float = 10.0,
        **kwargs: Any,
    ) -> None:
        self.t = t
        self.max_multiplier = max_multiplier
        super().__init__(policy, env, learning_rate, **kwargs)

    def _check_hyperparameters(self) -> None:
        super()._check_hyperparameters()
        check_number("t", self.t, ends="()")
        check_number("max_multiplier", self.max_multiplier, ends="()")

    def surrogate(self, batch: CostRolloutBufferSamples, ratio: th.Tensor) -> th.Tensor:
        assert self.costs is not None
        change = (ratio - 1.0) @ batch.cost_advantages / len(ratio)  # [m]
        horizon = self.costs.horizon
        excess = horizon * (th.as_tensor(self.costs.violation).to(change) + change)
        penalty = barrier(excess, self.t, self.max_multiplier).sum() / horizon
        return (ratio * batch.advantages).mean() + penalty

    def accept(self, trial: Trial) -> bool:
        assert self.costs is not None
        violation = self.costs.violation
        stays_inside = ~(violation < 0.0) | (violation + trial.cost_change < 0.0)
        return super().accept(trial) and bool(np.all(stays_inside))

    def fit(self, batch: CostRolloutBufferSamples) -> None:
        assert self.costs is not None
        margin = -self.costs.violation * self.costs.horizon
        steepest = 1.0 / (self.t * self.max_multiplier)
        self._record_per_cost("train/multiplier", 1.0 / (self.t * np.maximum(margin, steepest)))

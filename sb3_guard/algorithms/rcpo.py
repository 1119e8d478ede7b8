"""RCPO: natural gradient steps on the penalised advantage, without a line search."""

import torch as th

from sb3_guard.algorithms.common.actor import Accept, Region
from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.trpo_lag import TRPOLag


class RCPO(TRPOLag):
    """Reward-constrained policy optimisation (Tessler et al., 2019, arXiv 1805.11074).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    The policy takes a natural step of length √(2δ), without a line search, on ``A - Σ λ_i A_Ci``,
    and the multipliers follow the violation as :class:`~sb3_guard.TRPOLag`'s do; the paper has them
    follow more slowly, and puts the penalty into the reward, which one critic learns.
    """

    label, family, paper = "RCPO", "Lagrangian", "Tessler et al. 2019"

    lambda_lr: float = hyperparameter(0.1)
    proportional_gain: float = hyperparameter(0.5)
    derivative_gain: float = hyperparameter(0.0)

    def plan(self, region: Region) -> tuple[th.Tensor, Accept]:
        return region.natural_step(), lambda trial: True

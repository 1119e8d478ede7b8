"""RCPO: natural gradient steps on the penalised advantage, without a line search."""

from typing import Any, ClassVar

from sb3_guard.algorithms.common.penalized import PenalizedTrustRegion
from sb3_guard.algorithms.common.trust_region import Trial


class RCPO(PenalizedTrustRegion):
    """Reward-constrained policy optimisation (Tessler et al., 2019, arXiv 1805.11074).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    The policy takes a natural step of length √(2δ), without a line search, on ``A - Σ λ_i A_Ci``,
    and the multipliers follow the violation as :class:`~sb3_guard.TRPOLag`'s do; the paper has them
    follow more slowly, and puts the penalty into the reward, which one critic learns.
    """

    label, family, paper = "RCPO", "Lagrangian", "Tessler et al. 2019"
    defaults: ClassVar[dict[str, Any]] = {"lambda_lr": 0.1, "proportional_gain": 0.5}

    def accept(self, trial: Trial) -> bool:
        return True

"""PPO-Lagrangian: the cost joins PPO's objective at a price that follows the violation."""

from typing import Any, ClassVar

from sb3_guard.algorithms.common.first_order import PenalizedPPO
from sb3_guard.algorithms.common.lagrangian import RELATIVE


class PPOLag(PenalizedPPO):
    """PPO on the Lagrangian (Ray et al., 2019; multipliers as in arXiv 2007.03964).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    Before each update the multipliers ascend on the violation, ``λ ← max(0, λ + η (J_C - d) / d)``,
    with J_C and d of whole episodes; a proportional term keeps them from circling the optimum.
    Then SB3's PPO learns from ``A - Σ λ_i A_Ci``, each in its standard deviation. While no limit
    is exceeded the run equals PPO's, bit for bit.
    """

    label, family, paper = "PPO-Lagrangian", "Lagrangian", "Ray et al. 2019"
    search_space: ClassVar[dict[str, Any]] = {
        "lambda_lr": {"low": 0.02, "high": 1.0, "log": True},
        "proportional_gain": {"low": 0.0, "high": 4.0},
    }
    defaults: ClassVar[dict[str, Any]] = RELATIVE

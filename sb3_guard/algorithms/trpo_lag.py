"""TRPO-Lagrangian: TRPO with a multiplier for each cost, which follows the violation."""

from typing import Any, ClassVar

from sb3_guard.algorithms.common.penalized import PenalizedTrustRegion


class TRPOLag(PenalizedTrustRegion):
    """TRPO on the Lagrangian (Ray et al., 2019; Bohez et al., 2019, arXiv 1902.04623).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    The multipliers ascend on the violation, ``λ ← max(0, λ + η (J_C - d) / d)``, with J_C and d of
    whole episodes, and gains of a controller (Stooke et al., 2020) keep them from circling the
    optimum; then the policy takes a TRPO step on ``E[ratio · (A - Σ λ_i A_Ci)] / (1 + Σ λ_i)``, A
    and A_C each in its standard deviation. The division keeps the objective's scale; the direction
    of a trust-region step does not depend on it. While no limit is exceeded the run equals TRPO's,
    bit for bit.
    """

    label, family, paper = "TRPO-Lagrangian", "Lagrangian", "Ray et al. 2019"
    defaults: ClassVar[dict[str, Any]] = {"derivative_gain": 0.5}

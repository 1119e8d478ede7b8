"""TRPO: the baseline, which maximises return and ignores cost."""

from typing import Any, ClassVar, Literal

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.trust_region import TrustRegion


class TRPO(TrustRegion):
    """Trust-region policy optimisation (Schulman et al., 2015, arXiv 1502.05477).

    ::

        maximise E[ratio · A]   subject to   E[KL(old ‖ new)] ≤ δ

    Costs are logged where the environment reports them, and change nothing.

    :param env: environment or its id; it need not report a cost
    :param missing_cost: ``"zero"`` runs on any environment, ``"error"`` asks for the cost keys
    """

    label, family, paper = "TRPO", "unconstrained", "Schulman et al. 2015"

    constrained, uses_cost_critic = False, False
    search_space: ClassVar[dict[str, Any]] = {"cost_gae_lambda": None}

    missing_cost: Literal["error", "zero"] = hyperparameter("zero")

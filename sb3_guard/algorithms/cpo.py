"""CPO: trust-region steps that keep the linearised cost limits."""

from typing import Any, ClassVar

from sb3_guard.algorithms.common.linearised import LinearisedLimits


class CPO(LinearisedLimits):
    """Constrained policy optimisation (Achiam et al., 2017, arXiv 1705.10528).

    ::

        maximise   gᵀx            g    gradient of E[ratio · A]
        subject to c + Bx ≤ 0     B, c gradients of E[ratio · A_C], violations (J_C - d) / T
                   ½ xᵀFx ≤ δ     F    Fisher matrix of the old policy

    solved exactly at each update (:class:`~sb3_guard.algorithms.common.linearised.LinearisedLimits`
    has the step and its line search). The limits are kept with a learnt margin
    (:class:`~sb3_guard.algorithms.common.margin.Margin`), which the paper does not have.
    """

    label, family, paper = "CPO", "CPO-based", "Achiam et al. 2017"
    search_space: ClassVar[dict[str, Any]] = {
        "margin_lr": [0.0, 0.05, 0.1, 0.2],
        "cost_reduction": {"low": 0.0, "high": 0.02},
    }
    # Costs far ahead are noisy in a rollout, so they are left to the cost critic.
    defaults: ClassVar[dict[str, Any]] = {"cost_gae_lambda": 0.5}

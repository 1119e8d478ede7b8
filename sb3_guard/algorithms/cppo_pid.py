"""CPPO-PID: PPO-Lagrangian with a multiplier that a PID controller sets."""

from typing import Any, ClassVar

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.ppo_lag import PPOLag


class CPPOPID(PPOLag):
    """PPO on the Lagrangian, weighted by a controller (Stooke et al., 2020, arXiv 2007.03964).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

        I ← max(0, I + K_I Δ)          Δ = (J_C - d) / d
        λ = max(0, I + K_P Δ̄ + K_D ∂)  ∂ = rise of the average J̄_C over some updates, at least 0

    The proportional term answers a violation immediately, the derivative term answers costs that
    rise, and both damp the oscillation that the integral alone has. ``lambda_lr`` is K_I.

    With K_P = K_D and averages that keep one half, as by default, the two are PPO-Lagrangian's
    K_P Δ while J̄_C rises from below d (to at most 2 d); where it falls, they are K_P Δ̄.
    """

    label, family, paper = "CPPO-PID", "Lagrangian", "Stooke et al. 2020"
    search_space: ClassVar[dict[str, Any]] = {
        "derivative_gain": {"low": 0.0, "high": 4.0},
    }

    derivative_gain: float = hyperparameter(0.5)
    lambda_smoothing: float = hyperparameter(0.5, high=1.0)

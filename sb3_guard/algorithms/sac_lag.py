"""SAC-Lagrangian: SAC with cost critics and a multiplier that follows the violation."""

from stable_baselines3 import SAC

from sb3_guard.algorithms.common.soft import SoftActorCritic


class SACLag(SoftActorCritic, SAC):
    """SAC on the Lagrangian (Ha et al., 2020, arXiv 2002.08550).

    ::

        max_π min_{λ ≥ 0}   J(π) + α H(π) - Σ λ_i (J_Ci(π) - d_i)

    Each cost has critics of its own, of which the larger value counts. The actor descends
    ``(α log π - min Q + Σ w_i Q_Ci) / (1 + Σ λ_i)``, where w_i is λ_i in standard deviations of Q
    over those of Q_Ci; the multipliers follow the mean cost of the latest episodes. With
    ``ent_coef="auto"`` and while no limit is exceeded the run equals SB3's SAC, bit for bit.
    """

    label, family, paper = "SAC-Lagrangian", "Lagrangian", "Ha et al. 2020"

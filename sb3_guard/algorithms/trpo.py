"""TRPO: the baseline, which maximises return and ignores cost."""

from typing import Any, ClassVar, Literal

from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_guard.algorithms.common.trust_region import TrustRegion


class TRPO(TrustRegion):
    """Trust-region policy optimisation (Schulman et al., 2015, arXiv 1502.05477).

    ::

        maximise E[ratio · A]   subject to   E[KL(old ‖ new)] ≤ δ

    Costs are logged where the environment reports them, and change nothing.

    :param policy: policy class or its alias
    :param env: environment or its id; it need not report a cost
    :param learning_rate: of the critics
    :param missing_cost: ``"zero"`` runs on any environment, ``"error"`` asks for the cost keys

    Other parameters are those of :class:`TrustRegion`.
    """

    constrained: ClassVar[bool] = False
    uses_cost_critic: ClassVar[bool] = False

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        *,
        missing_cost: Literal["error", "zero"] = "zero",
        **kwargs: Any,
    ) -> None:
        super().__init__(policy, env, learning_rate, missing_cost=missing_cost, **kwargs)

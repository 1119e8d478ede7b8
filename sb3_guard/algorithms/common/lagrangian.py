"""Lagrange multipliers that follow the violation, for on- and off-policy algorithms."""

from collections.abc import Iterable
from typing import Any, ClassVar, Literal

import numpy as np

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.constrained import Constrained

# A limit that nothing keeps raises λ as long as it may; where limits are kept it ends below this.
HIGHEST = 5.0  # in standard deviations of the advantages, or of Q

SLOW = 0.95  # what the slow average of J_C keeps in an update


class Multiplier:
    """One λ ≥ 0 per constraint, raised while its limit is broken and lowered while it holds.

    With violation Δ = J_C - d, in units of an episode's cost or of the limit, an update is

        I ← clip(I + η Δ, 0, max)
        λ ← clip(I + K_P Δ̄ + K_D max(0, J̄_C - J̄_C one update before), 0, max)

    where a bar is an exponential average that begins at its first value. With both gains zero this
    is projected gradient ascent of the Lagrangian; otherwise the controller of Stooke et al. (2020,
    arXiv 2007.03964, algorithm 2).

    :param n_costs: number m of constraints
    :param init: λ before the first update
    """

    def __init__(self, n_costs: int, init: float = 0.0) -> None:
        #: λ and I, shape (m,)
        self.value = self.integral = np.full(n_costs, float(init))
        # Averages, NaN before the first update: of J_C, slow and as smooth as the law says, and Δ̄
        self.slow_cost = self.smooth_cost = self.violation = np.full(n_costs, np.nan)

    def update(
        self,
        cost: np.ndarray,
        limit: np.ndarray,
        rate: float,
        *,
        maximum: float | None = None,
        proportional: float = 0.0,
        derivative: float = 0.0,
        smoothing: float = 0.0,
        relative: bool = False,
    ) -> None:
        """Follow the violation.

        :param cost: J_C, shape (m,)
        :param limit: d, shape (m,)
        :param rate: η
        :param maximum: bound on λ and I; None for none
        :param proportional: K_P
        :param derivative: K_D
        :param smoothing: share of its old value that an average keeps in an update; 0 for none
        :param relative: measure costs in units of the limit (of a slow average of J_C where that is
            0) and count violations of more than one unit as one, so that neither the unit of cost
            nor how far away training begins matters; J̄_C is in units of the slow average where
            that is larger
        """
        self.slow_cost = _average(self.slow_cost, cost, SLOW)
        violation = cost - limit
        if relative:
            unit = np.abs(np.where(limit == 0.0, self.slow_cost, limit))
            unit[unit == 0.0] = 1.0  # neither cost nor limit: nothing is violated
            violation = np.clip(violation / unit, -1.0, 1.0)
            # Far from a limit, its own size
            cost = cost / np.maximum(unit, np.abs(self.slow_cost))
        self.integral = np.clip(self.integral + rate * violation, 0.0, maximum)
        self.violation = _average(self.violation, violation, smoothing)
        before, self.smooth_cost = self.smooth_cost, _average(self.smooth_cost, cost, smoothing)
        rise = np.fmax(self.smooth_cost - before, 0.0)  # 0 in the first update
        correction = proportional * self.violation + derivative * rise
        self.value = np.clip(self.integral + correction, 0.0, maximum)


def _average(before: np.ndarray, now: np.ndarray, keep: float) -> np.ndarray:
    """The next value of an exponential average whose first is the first it meets."""
    return np.where(np.isnan(before), now, keep * before + (1.0 - keep) * now)


class Lagrangian(Constrained):
    """Weights of the costs that follow the violations, for any algorithm that takes them.

    ``train`` calls :meth:`step` at its top, which lets the multipliers follow J_C, and takes the
    weights of its update from :meth:`weights`.

    :param lambda_lr: η, what the multipliers gain per unit of violation and step
    :param lambda_init: multipliers before the first update
    :param lambda_max: bound on the multipliers; None for 5 in relative units, none in those of cost
    :param lambda_update: ``"before"`` moves the multipliers before the policy learns, with the new
        ones; ``"after"`` lets it learn with the old ones
    :param proportional_gain: with ``derivative_gain``, turns the ascent into a PID controller
        (Stooke et al., 2020, arXiv 2007.03964) whose integral gain is ``lambda_lr``
    :param derivative_gain: of the rise of J_C
    :param lambda_smoothing: share that the averages behind those two gains keep in a step
    :param lambda_units: ``"relative"`` measures violations in units of the limit and λ in standard
        deviations of the advantages, so that a run with all costs and limits multiplied by a number
        is the same run; ``"cost"`` takes both as they are
    """

    search_space: ClassVar[dict[str, Any]] = {
        "lambda_lr": {"low": 5e-4, "high": 0.1, "log": True},
        "lambda_init": {"low": 0.0, "high": 2.0},
    }

    signed_limits = True

    lambda_lr: float = hyperparameter(0.005)
    lambda_init: float = hyperparameter(0.0)
    lambda_max: float | None = hyperparameter(None)
    lambda_update: Literal["before", "after"] = hyperparameter("before")
    proportional_gain: float = hyperparameter(0.0)
    derivative_gain: float = hyperparameter(0.0)
    lambda_smoothing: float = hyperparameter(0.0, high=1.0)
    lambda_units: Literal["relative", "cost"] = hyperparameter("cost")

    prices: np.ndarray  # λ of the update under way, shape (m,)

    multiplier: Multiplier = None  # type: ignore[assignment]

    def _setup_model(self) -> None:
        super()._setup_model()
        self.multiplier = self.multiplier or Multiplier(len(self.cost_keys), self.lambda_init)

    def step(self, costs: Iterable[np.ndarray] | None = None, rate: float | None = None) -> None:
        """Let the multipliers follow J_C; called once, at the top of ``train``.

        :param costs: J_C of each of their steps, shape (m,); None for one step, with the estimate
        :param rate: η of each step; None for ``lambda_lr``
        """
        old, relative = self.multiplier.value, self.lambda_units == "relative"
        highest = self.lambda_max
        if relative and highest is None:
            highest = max(HIGHEST, self.lambda_init)
        for cost in [self.costs.episode_cost] if costs is None else costs:
            self.multiplier.update(
                cost,
                self.costs.limits,
                self.lambda_lr if rate is None else rate,
                maximum=highest,
                proportional=self.proportional_gain,
                derivative=self.derivative_gain,
                smoothing=self.lambda_smoothing,
                relative=relative,
            )
        self.prices = self.multiplier.value if self.lambda_update == "before" else old
        self._record_per_cost("train/multiplier", self.multiplier.value)

    def weights(self, spread: np.ndarray | float = 1.0) -> np.ndarray:
        """What each cost weighs against the reward in this update, float32, shape (m,).

        :param spread: what one standard deviation of a cost's advantages is in the reward's, shape
            (m,); multiplies λ if it is relative
        """
        weight = self.prices
        if self.lambda_units == "relative":
            weight = weight * spread
            self._record_per_cost("train/cost_weight", weight)
        return weight.astype(np.float32)

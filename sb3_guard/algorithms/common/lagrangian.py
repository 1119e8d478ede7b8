"""Lagrange multipliers that follow the violation, for on- and off-policy algorithms."""

from collections.abc import Iterable
from typing import Any, ClassVar, Literal

import numpy as np
import torch as th
from stable_baselines3.common.utils import update_learning_rate
from torch import nn

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.constrained import Constrained

# A limit that nothing keeps raises λ as long as it may; where limits are kept it ends below this.
HIGHEST = 5.0  # in standard deviations of the advantages, or of Q

SLOW = 0.95  # what the slow average of J_C keeps in an update


class Multiplier(nn.Module):
    """One λ ≥ 0 per constraint, raised while its limit is broken and lowered while it holds.

    With violation Δ = J_C - d, in units of an episode's cost or of the limit, an update is

        I ← clip(I + η Δ, 0, max)
        λ ← clip(I + K_P Δ̄ + K_D max(0, J̄_C - J̄_C one update before), 0, max)

    where a bar is an exponential average that begins at its first value. With both gains zero this
    is projected gradient ascent of the Lagrangian; otherwise the controller of Stooke et al. (2020,
    arXiv 2007.03964, algorithm 2).

    :param n_costs: number m of constraints
    :param rate: η
    :param init: λ before the first update
    :param maximum: bound on λ and I; None for none
    :param proportional: K_P
    :param derivative: K_D
    :param smoothing: share of its old value that an average keeps in an update; 0 for none
    :param relative: measure costs in units of the limit (of a slow average of J_C where that is 0)
        and count violations of more than one unit as one, so that neither the unit of cost nor how
        far away training begins matters; J̄_C is in units of the slow average where that is larger
    """

    def __init__(
        self,
        n_costs: int,
        rate: float,
        *,
        init: float = 0.0,
        maximum: float | None = None,
        proportional: float = 0.0,
        derivative: float = 0.0,
        smoothing: float = 0.0,
        relative: bool = False,
    ) -> None:
        super().__init__()
        self.maximum = maximum
        self.proportional = proportional
        self.derivative = derivative
        self.smoothing = smoothing
        self.relative = relative
        start = th.full((n_costs,), float(init), dtype=th.float64)
        unknown = th.full_like(start, np.inf)
        self.integral = nn.Parameter(start)
        self.register_buffer("value", start.clone())
        self.register_buffer("slow_cost", unknown.clone())
        self.register_buffer("violation", unknown.clone())
        # The average of the last update; before the first one nothing has risen.
        self.register_buffer("last_costs", unknown[None].clone())
        self.optimizer = th.optim.SGD([self.integral], lr=rate)

    value: th.Tensor
    slow_cost: th.Tensor
    violation: th.Tensor
    last_costs: th.Tensor

    @th.no_grad()
    def update(self, cost: np.ndarray, limit: np.ndarray) -> None:
        """Follow the violation.

        :param cost: J_C, shape (m,)
        :param limit: d, shape (m,)
        """
        now, bound = th.tensor(cost), th.tensor(limit)
        self.slow_cost.copy_(_average(self.slow_cost, now, SLOW))
        violation = now - bound
        if self.relative:
            unit = th.where(bound == 0.0, self.slow_cost, bound).abs()
            unit[unit == 0.0] = 1.0  # neither cost nor limit: nothing is violated
            violation = (violation / unit).clamp_(-1.0, 1.0)
            now = now / unit.maximum(self.slow_cost.abs())  # far from a limit, its own size
        self.integral.grad = -violation
        self.optimizer.step()
        self.integral.clamp_(0.0, self.maximum)
        self.violation.copy_(_average(self.violation, violation, self.smoothing))
        smooth = _average(self.last_costs[0], now, self.smoothing)
        rise = (smooth - self.last_costs[0]).clamp_(min=0.0)
        self.last_costs.copy_(smooth[None])
        correction = self.proportional * self.violation + self.derivative * rise
        self.value.copy_(self.integral + correction)
        self.value.clamp_(0.0, self.maximum)


def _average(before: th.Tensor, now: th.Tensor, keep: float) -> th.Tensor:
    """The next value of an exponential average whose first is the first it meets."""
    return th.where(th.isinf(before), now, keep * before + (1.0 - keep) * now)


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

    def _setup_model(self) -> None:
        super()._setup_model()
        relative = self.lambda_units == "relative"
        highest = self.lambda_max
        if relative and highest is None:
            highest = max(HIGHEST, self.lambda_init)
        self.multiplier = Multiplier(
            len(self.cost_keys),
            self.lambda_lr,
            init=self.lambda_init,
            maximum=highest,
            proportional=self.proportional_gain,
            derivative=self.derivative_gain,
            smoothing=self.lambda_smoothing,
            relative=relative,
        )

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "multiplier", "multiplier.optimizer"], tensors

    def step(self, costs: Iterable[np.ndarray] | None = None, rate: float | None = None) -> None:
        """Let the multipliers follow J_C; called once, at the top of ``train``.

        :param costs: J_C of each of their steps, shape (m,); None for one step, with the estimate
        :param rate: η of each step; None for ``lambda_lr``
        """
        old = self.multiplier.value.clone()
        # As with the critics' rate: what the attribute says, not what a file has restored.
        rate = self.lambda_lr if rate is None else rate
        update_learning_rate(self.multiplier.optimizer, rate)
        for cost in [self.costs.episode_cost] if costs is None else costs:
            self.multiplier.update(cost, self.costs.limits)
        new = self.multiplier.value
        self.prices = (new if self.lambda_update == "before" else old).numpy()
        self._record_per_cost("train/multiplier", self.multiplier.value.numpy())

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

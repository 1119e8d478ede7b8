"""PCPO: a TRPO step, then a projection onto the cost limits."""

from typing import Any, ClassVar, Literal

import numpy as np
import torch as th

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.margin import Margin
from sb3_guard.algorithms.common.natural_gradient import projected_step
from sb3_guard.algorithms.common.trust_region import Region, Trial


class PCPO(Margin):
    """Projection-based constrained policy optimisation (Yang et al., 2020, arXiv 2010.03152).

    ::

        y = argmax  gᵀy                subject to   ½ yᵀFy ≤ δ
        x = argmin  (x - y)ᵀL(x - y)   subject to   c + Bx ≤ 0

    g and B are the gradients of E[ratio · A] and E[ratio · A_C], c the violations (J_C - d) / T, F
    the Fisher matrix, and L is F or I. The projection knows no trust region: it may ask for more
    than δ. The line search therefore shortens x until KL ≤ δ, and asks for nothing else. The limits
    are kept with a learnt margin (:class:`~sb3_guard.algorithms.common.margin.Margin`), which the
    paper does not have.

    :param projection: ``"kl"`` for L = F, ``"l2"`` for L = I
    :param line_search: whether to shorten steps that leave the trust region; False takes them
        whole, as the paper does
    """

    label, family, paper = "PCPO", "CPO-based", "Yang et al. 2020"
    search_space: ClassVar[dict[str, Any]] = {
        "projection": ["kl", "l2"],
        "margin_lr": [0.0, 0.05, 0.1, 0.2],
    }
    # Costs far ahead are noisy in a rollout, so they are left to the cost critic. A step always has
    # the reward's part, so the projection may go as far as the limit asks.
    defaults: ClassVar[dict[str, Any]] = {"cost_gae_lambda": 0.5, "recovery": 1.0}

    projection: Literal["kl", "l2"] = hyperparameter("kl")
    line_search: bool = hyperparameter(True)

    def step(self, region: Region) -> th.Tensor:
        g, B, c, delta = region.gradient, region.cost_gradients, region.violation, region.delta
        v, W = region.solve(g), th.stack([region.solve(b) for b in B])
        x, pull = projected_step(g, B, c, v, W, delta, self.projection == "l2", self.recovery)
        self._record_per_cost("train/projection", pull)
        return x

    def accept(self, trial: Trial) -> bool:
        return trial.kl <= (self.target_kl if self.line_search else np.finfo(np.float64).max)

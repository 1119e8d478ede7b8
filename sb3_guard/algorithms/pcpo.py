"""PCPO: a TRPO step, then a projection onto the cost limits."""

import sys
from typing import Any, ClassVar, Literal

import torch as th

from sb3_guard.algorithms.common.actor import Accept, Region
from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.natural_gradient import projected_step
from sb3_guard.algorithms.cpo import CPO


class PCPO(CPO):
    """Projection-based constrained policy optimisation (Yang et al., 2020, arXiv 2010.03152).

    ::

        y = argmax  gᵀy                subject to   ½ yᵀFy ≤ δ
        x = argmin  (x - y)ᵀL(x - y)   subject to   c + Bx ≤ 0

    g and B are the gradients of E[ratio · A] and E[ratio · A_C], c the violations (J_C - d) / T, F
    the Fisher matrix, and L is F or I. The projection knows no trust region: it may ask for more
    than δ. The line search therefore shortens x until KL ≤ δ, and asks for nothing else. The limits
    are kept with a learnt :class:`~sb3_guard.algorithms.common.costs.Margin`, which the paper does
    not have.

    :param projection: ``"kl"`` for L = F, ``"l2"`` for L = I
    :param line_search: whether to shorten steps that leave the trust region; False takes them
        whole, as the paper does
    """

    label, family, paper = "PCPO", "CPO-based", "Yang et al. 2020"
    search_space: ClassVar[dict[str, Any]] = {"projection": ["kl", "l2"]}

    # A step always has the reward's part, so the projection may go as far as the limit asks.
    fixed_arguments: ClassVar[frozenset[str]] = CPO.fixed_arguments | {"recovery"}

    projection: Literal["kl", "l2"] = hyperparameter("kl")
    line_search: bool = hyperparameter(True)

    def plan(self, region: Region) -> tuple[th.Tensor, Accept]:
        g, B, delta = region.gradient, region.cost_gradients, region.delta
        c = self.margin.violation(self.costs)
        v, W = region.solve(g), th.stack([region.solve(b) for b in B])
        x, pull = projected_step(g, B, c, v, W, delta, self.projection == "l2")
        self._record_per_cost("train/projection", pull)
        return x, lambda trial: trial.kl <= (delta if self.line_search else sys.float_info.max)

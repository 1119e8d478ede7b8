"""The linear algebra of a natural-gradient step, with and without constraints: pure functions.

One convention holds throughout. The policy parameters move by ``x`` so as to

    maximise  gᵀx   subject to   c + Bx ≤ 0   and   ½ xᵀFx ≤ δ

where ``g`` is the gradient of the reward surrogate (ascent), the rows of ``B`` are the gradients of
the cost surrogates, ``c`` the violations of the limits by the old policy (positive: violated),
``F`` the Fisher matrix and ``δ`` the trust-region radius. Only ``v = F⁻¹g`` and ``w_i = F⁻¹b_i``
are ever needed (``vectors.conjugate_gradient``), and the answer lies in their span, so everything
here happens in ``m + 1`` dimensions, in float64.
"""

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import torch as th
from scipy.optimize import brentq, nnls


class Case(IntEnum):
    """How the cost constraints lie to the trust region; decides what a step may ask for.

    Numbered as in the code that accompanies CPO (Achiam et al., 2017).
    """

    LOST = 0  # no point of the trust region satisfies the constraints
    RECOVERABLE = 1  # violated now, satisfiable within the trust region
    BINDING = 2  # satisfied now, the boundary cuts the trust region
    INACTIVE = 3  # satisfied throughout the trust region
    NO_GRADIENT = 4  # no step changes the cost

    @property
    def feasible(self) -> bool:
        """Whether the old policy satisfies every constraint that a step can change."""
        return self >= Case.BINDING


class Step(NamedTuple):
    """A solved step: where to go, and the multipliers that say why.

    :param x: the step, shape (P,)
    :param case: how the constraints lie to the trust region
    :param lambda_kl: multiplier λ of the trust region, 0 for a step that only recovers
    :param nu: multipliers ν of the constraints, shape (m,)
    :param moves: which constraints a step can change, shape (m,) bool; the others are left out, as
        a violation that the policy has no part in would otherwise end all learning
    """

    x: th.Tensor
    case: Case
    lambda_kl: float
    nu: np.ndarray
    moves: np.ndarray


# No step moves a constraint that changes by less than this share of its violation within the trust
# region.
_NO_REACH = 1e-7
# Share of the reward gradient, squared, that must remain across the constraint to be worth
# following: below it the remainder is rounding error.
_PARALLEL = 1e-8
# The same of several constraints, whose weights multiply the rounding of v and W, in float32.
_PARALLEL_TO_SEVERAL = 1e-6


def constrained_step(
    g: th.Tensor,
    B: th.Tensor,
    c: np.ndarray,
    v: th.Tensor,
    W: th.Tensor,
    delta: float,
    recovery: float = 1.0,
) -> Step:
    """The step of highest linearised reward within the constraints and the trust region.

    One constraint has a closed form (Achiam et al., 2017, theorem 2, here for ascent); several are
    solved through the dual. If no point of the trust region satisfies them, the point of the region
    that minimises ``Σ max(0, c_i + b_iᵀx)²`` takes their place, for one constraint the steepest
    descent of its cost: the step brings a share of the decreases that it brings, and as much reward
    as the region then allows.

    :param g: reward gradient, shape (P,)
    :param B: cost gradients, shape (m, P)
    :param c: violations, shape (m,), in the units of the cost surrogate
    :param v: F⁻¹g, shape (P,)
    :param W: F⁻¹b_i, shape (m, P)
    :param delta: trust-region radius δ > 0
    :param recovery: that share, 1 for nothing but recovery
    """
    rows, images = _double(th.cat([g[None], B])), _double(th.cat([v[None], W]))
    gram = (rows @ images.T).numpy()  # [1 + m, 1 + m]
    c, gram = np.asarray(c, dtype=np.float64), (gram + gram.T) / 2
    moves = _movable(gram[1:, 1:], c, delta)
    a, beta, case, lambda_kl, nu = _solve(gram, c, moves, delta)
    if case is Case.LOST and recovery < 1.0:
        change = beta @ gram[1:, 1:]  # b_iᵀx of the step that only recovers
        asked = np.where(change < 0.0, -recovery * change, -change)
        a, beta, _, lambda_kl, nu = _solve(gram, asked, moves, delta)
    x = a * v + th.as_tensor(beta, dtype=W.dtype).to(W.device) @ W
    return Step(x, case, lambda_kl, nu, moves)


def _reach(S: np.ndarray, delta: float) -> np.ndarray:
    """By how much each constraint changes within the trust region, from b_iᵀF⁻¹b_j."""
    return np.sqrt(2 * delta * np.maximum(np.diag(S), 0.0))


def _movable(S: np.ndarray, c: np.ndarray, delta: float) -> np.ndarray:
    """Which constraints a step within the trust region can change, whatever the unit of cost."""
    return _reach(S, delta) > _NO_REACH * np.abs(c)


def _double(tensor: th.Tensor) -> th.Tensor:
    """In float64, on the CPU: not every device has that type."""
    return tensor.cpu().double()


# Half-spaces count as contradictory if their nearest point is this many times as far as the
# farthest of them alone, and as a step of the trust region: where nearly opposite half-spaces
# meet is then a matter of rounding, and of no use.
_FAR = 100.0
# No float64 knows better whether a point 1/√ of this as far as the farthest half-space exists.
_CONTRADICTION = 1e-10
# A constraint is kept if it is broken by less than this share of what such a step changes.
_BROKEN = 1e-2


def projected_step(
    g: th.Tensor,
    B: th.Tensor,
    c: np.ndarray,
    v: th.Tensor,
    W: th.Tensor,
    delta: float,
    euclidean: bool = False,
) -> tuple[th.Tensor, np.ndarray]:
    """The TRPO step, then the nearest point that satisfies the linearised constraints.

    With ``y = √(2δ / gᵀF⁻¹g) F⁻¹g``, the point x of ``c + Bx ≤ 0`` that minimises
    ``(x - y)ᵀL(x - y)`` (Yang et al., 2020); for one constraint

        x = y - max(0, (bᵀy + c) / bᵀL⁻¹b) · L⁻¹b

    It may lie outside the trust region. If no point satisfies the constraints, or none within a
    hundred times the way to the farthest of them, the step minimises ``Σ max(0, c_i + b_iᵀx)²``
    over the region.

    :param g: reward gradient, shape (P,)
    :param B: cost gradients, shape (m, P)
    :param c: violations, shape (m,), in the units of the cost surrogate
    :param v: F⁻¹g, shape (P,)
    :param W: F⁻¹b_i, shape (m, P)
    :param delta: trust-region radius δ > 0
    :param euclidean: measure distance by L = I instead of L = F, i.e. to first order by the KL
    :return: the step, shape (P,), and how far it was pulled along each ``-L⁻¹b_i``, shape (m,)
    """
    c = np.asarray(c, dtype=np.float64)
    rows, images = _double(B), _double(W)
    q = float(_double(g) @ _double(v))
    y = (v * (np.sqrt(2 * delta / q) if q > 0.0 else 0.0)).cpu()
    gram = (rows @ images.T).numpy()  # [m, m]
    gram = (gram + gram.T) / 2
    moves = _movable(gram, c, delta)
    excess = c + (rows @ y.double()).numpy()
    x, pull = y, np.zeros(len(c))
    possible = True
    if np.any(excess[moves] > 0.0):
        along = rows if euclidean else images
        S = (rows @ along.T).numpy()[np.ix_(moves, moves)]
        normals, lengths = _unit_normals(S)
        offsets = excess[moves] / lengths
        # In units in which the farthest half-space is one away.
        scale = offsets.max()
        u, phi = shortest(normals, offsets / scale)
        step = max(scale, float(y.norm()) if euclidean else np.sqrt(2 * delta))
        possible = phi > max(_CONTRADICTION, 1.0 / (1.0 + (_FAR * step / scale) ** 2))
        if possible:
            pull[moves] = u / phi * scale / lengths
            x = y - (th.as_tensor(pull) @ along).to(W.dtype)
            # One half-space contradicts nothing. Several may seem to meet where they do not.
            broken = (c + (rows @ x.double()).numpy())[moves] / lengths
            possible = len(broken) == 1 or bool(np.all(broken <= _BROKEN * step))
    if not possible:
        pull = _least_violation(gram, c, delta, moves)
        x = -(th.as_tensor(pull) @ images).to(W.dtype)
    return x.to(W.device), pull


_Solution = tuple[float, np.ndarray, float, np.ndarray]


def _solve(
    gram: np.ndarray, c: np.ndarray, moves: np.ndarray, delta: float
) -> tuple[float, np.ndarray, Case, float, np.ndarray]:
    """Coefficients (a, β) of x = a v + Σ β_i w_i, the case, λ and ν.

    :param gram: inner products of (g, b_1, …, b_m) in the metric F⁻¹, shape (1 + m, 1 + m)
    """
    zero = np.zeros(len(c))
    q, reach = gram[0, 0], _reach(gram[1:, 1:], delta)
    trpo = np.sqrt(2 * delta / q) if q > 0.0 else 0.0
    lambda_trpo = np.sqrt(max(0.0, q) / (2 * delta))
    if not moves.any():
        return trpo, zero, Case.NO_GRADIENT, lambda_trpo, zero
    if np.all(c[moves] <= 0.0):
        inactive = bool(np.all(c[moves] + reach[moves] < 0.0))
        case = Case.INACTIVE if inactive else Case.BINDING
    elif _reachable(gram[1:, 1:], c, moves, delta):
        case = Case.RECOVERABLE
    else:
        return 0.0, -_least_violation(gram[1:, 1:], c, delta, moves), Case.LOST, 0.0, zero
    if np.all(c[moves] + trpo * gram[1:, 0][moves] <= 0.0):
        return trpo, zero, case, lambda_trpo, zero
    a, beta, lambda_kl, nu = (_closed_form if len(c) == 1 else _dual)(gram, c, moves, delta)
    return a, beta, case, lambda_kl, nu


def _closed_form(gram: np.ndarray, c: np.ndarray, moves: np.ndarray, delta: float) -> _Solution:
    """One binding constraint: walk to its boundary, use what is left of δ along it."""
    (q, r), (_, s) = gram
    along = q - r**2 / s  # squared length of the reward gradient along the boundary
    if along <= _PARALLEL * q:
        return 0.0, -c / s, 0.0, np.array([max(0.0, r / s)])
    # Twice the KL left once the boundary is reached; kept off zero so that λ stays finite.
    room = max(2 * delta - c[0] ** 2 / s, 1e-12 * delta)
    lambda_kl = np.sqrt(along / room)
    nu = (r + lambda_kl * c) / s
    return 1.0 / lambda_kl, -nu / lambda_kl, lambda_kl, nu


def _unit_normals(S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (rows) whose angles are those of the inner products S, and their lengths."""
    lengths = np.sqrt(np.diag(S))
    values, vectors = np.linalg.eigh(S / np.outer(lengths, lengths))
    return vectors * np.sqrt(np.maximum(values, 0.0)), lengths


def shortest(normals: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, float]:
    """Shortest z with ``normals @ z + offsets ≤ 0`` (Lawson & Hanson, 1974, problem LDP).

    :param normals: shape (m, n)
    :param offsets: shape (m,)
    :return: (u, φ) such that the multipliers are u / φ, ``z = -normalsᵀu / φ`` and
        ``|z|² = 1/φ - 1``; φ is 0 if the half-spaces contradict each other
    """
    target = np.append(np.zeros(normals.shape[1]), 1.0)
    u, _ = nnls(np.vstack([-normals.T, offsets]), target)
    return u, max(0.0, 1.0 - float(offsets @ u))


def _reachable(S: np.ndarray, c: np.ndarray, moves: np.ndarray, delta: float) -> bool:
    """Whether some point of the trust region satisfies every constraint."""
    normals, lengths = _unit_normals(S[np.ix_(moves, moves)])
    # In units in which the trust region is the unit ball.
    _, phi = shortest(normals, c[moves] / (lengths * np.sqrt(2 * delta)))
    return phi >= 0.5


def _dual(gram: np.ndarray, c: np.ndarray, moves: np.ndarray, delta: float) -> _Solution:
    """Several constraints: for a fixed λ, project g/λ on the polyhedron; λ by a scalar search.

    The KL of that projection falls as λ rises, because the dual is convex in λ.
    """
    rewarded = bool(gram[0, 0] > 0.0)
    if not rewarded:
        # Any direction across the constraints stands in: only the way to feasibility remains.
        gram = gram.copy()
        gram[0] = gram[:, 0] = 0.0
        gram[0, 0] = 1.0
    mask = np.append(True, moves)
    points, lengths = _unit_normals(gram[np.ix_(mask, mask)])
    gradient, normals = points[0], points[1:]
    size, lengths, radius = lengths[0], lengths[1:], np.sqrt(2 * delta)
    offsets = c[moves] / (lengths * radius)

    def project(lam: float) -> tuple[np.ndarray, np.ndarray]:
        """The projected point and its multipliers, where the trust region is the unit ball."""
        # Two scalings of one problem: each keeps its numbers near one in its range of λ.
        scale = max(1.0, lam)
        u, phi = shortest(normals, (lam * offsets + normals @ gradient) / scale)
        mu = u / phi * scale / lam
        return gradient / lam - mu @ normals, mu

    def excess(log_lam: float) -> float:
        point, _ = project(np.exp(log_lam))
        return float(point @ point) - 1.0

    def solve() -> tuple[float, np.ndarray]:
        lam = np.exp(_root(excess, np.log(1e-7), np.log(1e7)))
        return lam, project(lam)[1]

    lam, mu = solve()
    beta, nu = np.zeros(len(c)), np.zeros(len(c))
    if not rewarded:
        beta[moves] = -mu * radius / lengths
        return 0.0, beta, 0.0, nu
    a, share, active = radius / (lam * size), np.zeros(len(mu)), mu > 0.0
    if active.any():
        rcond = np.sqrt(_PARALLEL_TO_SEVERAL)
        share[active] = np.linalg.lstsq(normals[active].T, gradient, rcond=rcond)[0]
        across = gradient - share @ normals
        if across @ across <= _PARALLEL_TO_SEVERAL:
            # The reward gradient is a sum of cost gradients: the step is one as well.
            gradient = share @ normals
            lam, mu = solve()
            a, share = 0.0, share / lam
        else:
            share[:] = 0.0
    beta[moves] = (share - mu) * radius / lengths
    nu[moves] = mu * lam * size / lengths
    return a, beta, lam * size / radius, nu


def _root(decreasing: Callable[[float], float], low: float, high: float) -> float:
    """Where a decreasing function is zero, or the nearer end of the interval."""
    if decreasing(low) <= 0.0:
        return low
    if decreasing(high) >= 0.0:
        return high
    return float(brentq(decreasing, low, high, xtol=1e-12))


# The sum of weights is known to less than a millionth if they cancel each other beyond this.
_CANCELLED = 1e9


def _least_violation(S: np.ndarray, c: np.ndarray, delta: float, moves: np.ndarray) -> np.ndarray:
    """Weights p of ``x = -Σ p_i w_i`` that minimise ``Σ max(0, c_i + b_iᵀx)²`` in the region.

    For a fixed multiplier μ of the trust region the dual is a non-negative least-squares problem
    whose solution is p μ, stated in unit normals since gradients may differ in length by orders of
    magnitude; μ by a scalar search, the KL of the step falls as it rises.
    """
    normals, lengths = _unit_normals(S[np.ix_(moves, moves)])
    largest, radius = lengths.max(), np.sqrt(2 * delta)
    offsets = c[moves] / (largest * radius)
    slack = np.diag(largest / lengths)

    def weights(mu: float) -> np.ndarray:
        """Of the unit normals, where the trust region is the unit ball."""
        stacked = np.vstack([slack, normals.T / np.sqrt(mu)])
        scaled, _ = nnls(stacked, np.append(offsets, np.zeros(normals.shape[1])))
        return scaled / mu

    def excess(log_mu: float) -> float:
        along = weights(np.exp(log_mu))
        point = along @ normals
        beyond = float(point @ point) - 1.0
        return max(beyond, 1.0) if along.max() > _CANCELLED else beyond

    # The compromise between contradictory constraints may lie inside the region: then μ is zero.
    low = 1e-9 * (lengths.min() / largest) ** 2
    top = 1e9 * max(1.0, float(np.abs(offsets).max()))
    best = weights(np.exp(_root(excess, np.log(low), np.log(top))))
    p = np.zeros(len(c))
    if len(best) > 1:
        # Opposite normals have large weights that cancel each other, and would not cancel the
        # errors of the w_i: of all weights of this point take the smallest.
        rcond = np.sqrt(_PARALLEL_TO_SEVERAL)
        best = np.linalg.lstsq(normals.T, best @ normals, rcond=rcond)[0]
    p[moves] = best * radius / lengths
    return p

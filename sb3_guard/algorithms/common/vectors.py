"""All parameters as one vector, and the linear system of a natural gradient: pure functions."""

from collections.abc import Callable, Iterable, Sequence

import torch as th


def flatten(tensors: Iterable[th.Tensor]) -> th.Tensor:
    """Lay tensors end to end in one vector, the form in which steps are computed."""
    return th.cat([tensor.reshape(-1) for tensor in tensors])


def unflatten(vector: th.Tensor, like: Sequence[th.Tensor]) -> list[th.Tensor]:
    """Cut a vector into views shaped like the given tensors; undoes :func:`flatten`."""
    pieces = th.split(vector, [tensor.numel() for tensor in like])
    return [piece.view_as(tensor) for piece, tensor in zip(pieces, like, strict=True)]


def assign(parameters: Sequence[th.Tensor], vector: th.Tensor) -> None:
    """Write a flat vector into parameters, in place and outside autograd."""
    with th.no_grad():
        for parameter, piece in zip(parameters, unflatten(vector, parameters), strict=True):
            parameter.copy_(piece)


def conjugate_gradient(
    product: Callable[[th.Tensor], th.Tensor],
    rhs: th.Tensor,
    max_steps: int,
    tolerance: float = 1e-10,
) -> th.Tensor:
    """Solve ``F x = rhs`` knowing only products with F (Hestenes & Stiefel, 1952).

    It starts from zero, so equal inputs give equal answers, and ``rhsᵀx = xᵀFx`` holds at every
    iterate: the step length computed from it is right even if the solution is not exact.

    :param product: maps x to F x; F symmetric and positive definite
    :param rhs: right-hand side, shape (P,)
    :param max_steps: iterations at most
    :param tolerance: stop once the squared residual falls below this fraction of the squared rhs
    :return: the solution, shape (P,); the zero vector for a zero rhs
    """
    x = th.zeros_like(rhs)
    residual, direction = rhs.clone(), rhs.clone()
    square = float(residual @ residual)
    threshold = tolerance * square
    for _ in range(max_steps):
        if not square > threshold:
            break
        image = product(direction)
        curvature = float(direction @ image)
        # Rounding can spend the positive curvature of a nearly solved system.
        if not curvature > 0.0:
            break
        x.add_(direction, alpha=square / curvature)
        residual.sub_(image, alpha=square / curvature)
        previous, square = square, float(residual @ residual)
        direction.mul_(square / previous).add_(residual)
    return x

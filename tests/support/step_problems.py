"""Random problems of a trust-region step, for tests of what solves them."""

import numpy as np
import torch as th


def definite(rng: np.random.Generator, size: int) -> np.ndarray:
    """A random positive definite matrix."""
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.3 * np.eye(size)


class StepProblem:
    """A Fisher matrix, gradients of reward and costs, violations and a radius.

    :param ratios: violation of each constraint as a share of what the trust region can change
    :param scales: the units of each cost; none: all the same
    """

    def __init__(
        self,
        rng: np.random.Generator,
        ratios: np.ndarray,
        scales: np.ndarray | None = None,
        size: int = 6,
    ) -> None:
        self.F = definite(rng, size)
        self.g = rng.normal(size=size)
        self.B = rng.normal(size=(len(ratios), size))
        if scales is not None:
            self.B *= scales[:, None]
        self.delta = 10 ** rng.uniform(-3, -1)
        self.inverse = np.linalg.inv(self.F)
        self.c = self.reach * ratios

    @property
    def reach(self) -> np.ndarray:
        """What the trust region can change of each cost, shape (m,)."""
        return np.sqrt(2 * self.delta * np.diag(self.B @ self.inverse @ self.B.T))

    def tensors(self, dtype: th.dtype = th.float64) -> tuple[th.Tensor, ...]:
        """g, B, F⁻¹g and F⁻¹B, as the solvers take them."""
        arrays = self.g, self.B, self.inverse @ self.g, self.B @ self.inverse
        return tuple(th.as_tensor(array, dtype=dtype) for array in arrays)

"""Batches of tensors, or of dictionaries and tuples of them, in slices that bound the memory."""

from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

# Rows processed at a time: activations of a 64-64 network stay in a core's second-level cache.
CHUNK = 2048


def chunks(n_rows: int, size: int = CHUNK) -> list[slice]:
    """Consecutive slices that cover ``n_rows`` rows."""
    return [slice(start, min(start + size, n_rows)) for start in range(0, n_rows, size)]


def rows(batch: Any, index: slice | th.Tensor) -> Any:
    """Some rows of a batch of tensors, or of dictionaries and tuples of them."""
    if isinstance(batch, dict):
        return {key: rows(value, index) for key, value in batch.items()}
    if isinstance(batch, tuple):
        return tuple(rows(value, index) for value in batch)
    return batch[index]


def n_rows(observations: PyTorchObs) -> int:
    """Length of a batch of observations, dictionaries included."""
    if isinstance(observations, dict):
        return len(next(iter(observations.values())))
    return len(observations)

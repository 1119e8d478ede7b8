"""The algorithms that the commands know, by key."""

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_guard.spelling import did_you_mean
from sb3_guard.zoo.usage import UsageError


def algorithms() -> dict[str, type[BaseAlgorithm]]:
    """Key to class. ``trpo`` is this package's, which logs and can filter by cost."""
    from sb3_guard.algorithms import ALGORITHMS

    return dict(ALGORITHMS)


def algorithm(key: str) -> type[BaseAlgorithm]:
    """
    The class of an algorithm.

    :raises UsageError: there is none of that name
    """
    table = algorithms()
    if key not in table:
        raise UsageError(f"unknown algorithm {key!r}; {did_you_mean(key, table)}")
    return table[key]

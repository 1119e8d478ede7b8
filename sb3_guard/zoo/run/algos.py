"""The algorithms that the commands know, by key: this package's, and RL-Zoo's as baselines."""

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_guard.algorithms import ALGORITHMS
from sb3_guard.fields import did_you_mean
from sb3_guard.zoo.cli.usage import UsageError


def baselines() -> dict[str, type[BaseAlgorithm]]:
    """RL-Zoo's algorithms by key: unconstrained, with their costs logged; ``trpo`` is ours."""
    from rl_zoo3.utils import ALGOS

    # ARS plays whole episodes in workers of its own, past the monitor that counts costs.
    return {key: ALGOS[key] for key in ALGOS if key not in {*ALGORITHMS, "ars"}}


def algorithm(key: str) -> type[BaseAlgorithm]:
    """
    The class of an algorithm.

    :raises UsageError: there is none of that name
    """
    # RL-Zoo, which takes a while to import, is asked only where it must be.
    table = ALGORITHMS if key in ALGORITHMS else {**ALGORITHMS, **baselines()}
    if key not in table:
        hint = f"{did_you_mean(key, table)}, or of a module that --gym-packages names"
        raise UsageError(f"unknown algorithm {key!r}; {hint}")
    return table[key]

"""The costs of a rollout: read from ``info``, and held against their limits."""

import difflib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np


class CostEstimate(NamedTuple):
    """What a rollout says about the costs, m of them.

    :param episode_cost: J_C, mean undiscounted cost of the episodes that ended, shape (m,)
    :param horizon: T, the length of an episode, steps
    :param violation: (J_C - d) / T, in the per-step units of mean(ratio · cost advantage),
        shape (m,)
    """

    episode_cost: np.ndarray
    horizon: float
    violation: np.ndarray


def discounted_limit(limits: np.ndarray, horizon: float, gamma: float) -> np.ndarray:
    """The limits d of an episode's cost as limits of a discounted cost-to-go.

    A constant cost of d/T per step has the discounted sum ``d_γ = (d/T) (1 - γᵀ)/(1 - γ)``.

    :param limits: d, shape (m,)
    :param horizon: T, steps
    :param gamma: discount factor of the costs
    :return: d_γ, shape (m,); d itself where γ is 1
    """
    steps = horizon if gamma == 1.0 else (1.0 - gamma**horizon) / (1.0 - gamma)
    return limits / horizon * steps


def read_costs(
    infos: Sequence[dict[str, Any]], keys: Sequence[str], zero_if_missing: bool
) -> tuple[np.ndarray, bool]:
    """Costs of one step of every environment.

    :param infos: one dictionary per environment
    :param keys: the m entries that hold costs
    :param zero_if_missing: whether an absent entry means that nothing was charged
    :return: costs, shape (n_envs, m), and whether any of the entries was there
    :raises ValueError: an entry is missing and may not be, or is not a finite number
    """
    try:
        rows = [[info[key] for key in keys] for info in infos]
        seen = True
    except KeyError:
        if not zero_if_missing:
            raise _missing(infos, keys) from None
        rows = [[info.get(key, 0.0) for key in keys] for info in infos]
        seen = any(key in info for info in infos for key in keys)
    try:
        if any(isinstance(value, np.ndarray) for row in rows for value in row):
            # Arrays of one number are costs, beside plain numbers too.
            rows = [[np.asarray(value).item() for value in row] for row in rows]
        raw = np.array(rows)
        costs = raw.astype(np.float64).reshape(len(infos), len(keys))
    except (TypeError, ValueError):
        raise _no_number(rows, keys) from None
    # NumPy would read a number from a text, which then is somebody's mistake.
    if raw.dtype.kind in "US" or not np.isfinite(costs).all():
        raise _no_number(rows, keys)
    return costs, seen


def _no_number(rows: Sequence[Sequence[Any]], keys: Sequence[str]) -> ValueError:
    def is_cost(value: Any) -> bool:
        try:
            number = float(np.asarray(value).item())
            return not isinstance(value, str | bytes) and bool(np.isfinite(number))
        except (TypeError, ValueError):
            return False

    places = ((i, j) for i, row in enumerate(rows) for j in range(len(row)))
    i, j = next(((i, j) for i, j in places if not is_cost(rows[i][j])), (0, 0))
    return ValueError(
        f"info[{keys[j]!r}] of environment {i} is {rows[i][j]!r}: a cost must be a finite number"
    )


def _missing(infos: Sequence[dict[str, Any]], keys: Sequence[str]) -> ValueError:
    i, key = next((i, key) for i, info in enumerate(infos) for key in keys if key not in info)
    present = sorted(str(name) for name in infos[i])
    nearest = difflib.get_close_matches(key, present, n=1, cutoff=0.4)
    hint = f" (nearest: {nearest[0]!r})" if nearest else ""
    return ValueError(
        f"info of environment {i} has no cost key {key!r}; its keys are {present}{hint}. "
        "Pass the right names as cost_keys=(...), or missing_cost='zero' if the key appears "
        "only when there is a cost; sb3_guard.common.adapters has wrappers for a cost that is "
        "elsewhere or has to be computed"
    )

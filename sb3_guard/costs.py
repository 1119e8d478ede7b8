"""Costs as environments report them in ``info``: read in one way, refused in one line."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sb3_guard.checks import NumberError
from sb3_guard.spelling import nearest


def number(value: Any, name: str) -> float:
    """One cost as a float: an int, bool, NumPy scalar or array of one number will do.

    :param name: what the message calls it
    :raises NumberError: it is something else, or not finite
    """
    try:
        one = value.item() if isinstance(value, np.ndarray) else value
        number = math.nan if isinstance(one, str | bytes) else float(one)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise NumberError(f"{name} is {value!r}: a cost must be a finite number")
    return number


def verdict(low: float, high: float, limit: float) -> str:
    """Whether a cost keeps a limit, as far as the interval of its mean tells; empty: there is none.

    :param low: lower end of the interval, NaN if there is none
    :param high: upper end
    """
    if math.isnan(low):
        return ""
    return "kept" if high <= limit else "exceeded" if low > limit else "undecided"


def missing(info: Mapping[str, Any], key: str, whose: str = "info") -> ValueError:
    """What to raise where a cost is not in ``info``.

    :param whose: what the message calls ``info``
    """
    present = sorted(map(str, info))
    near = nearest(key, present)
    hint = "" if near is None else f" (nearest: {near!r})"
    return ValueError(
        f"{whose} has no cost key {key!r}; its keys are {present}{hint}. Name the right one, as "
        "with cost_keys=(...), or pass missing_cost='zero' if the key appears only when there is a "
        "cost; sb3_guard.common.adapters has wrappers for a cost that is elsewhere or has to be "
        "computed"
    )


def read_costs(
    infos: Sequence[Mapping[str, Any]], keys: Sequence[str], zero_if_missing: bool = False
) -> tuple[np.ndarray, bool]:
    """Costs of one step of every environment.

    :param infos: one dictionary per environment
    :param keys: the m entries that hold costs
    :param zero_if_missing: whether an absent entry means that nothing was charged
    :return: costs, shape (n_envs, m), and whether any of the entries was there
    :raises ValueError: an entry is missing and may not be
    :raises NumberError: one is not a finite number
    """
    shape, seen = (len(infos), len(keys)), True
    try:
        rows = [[info[key] for key in keys] for info in infos]
    except KeyError:
        for i, info in enumerate(infos):
            for key in keys if not zero_if_missing else ():
                if key not in info:
                    raise missing(info, key, f"info of environment {i}") from None
        rows = [[info.get(key, 0.0) for key in keys] for info in infos]
        seen = any(key in info for info in infos for key in keys)
    try:
        costs = np.array(rows).reshape(shape)
    except ValueError:  # of several shapes
        costs = np.array(None)
    if costs.dtype.kind not in "biuf" or not np.isfinite(costs).all():
        places = [f"info[{key!r}] of environment {i}" for i in range(len(infos)) for key in keys]
        values = itertools.chain(*rows)
        costs = np.array([*map(number, values, places)]).reshape(shape)
    return costs.astype(np.float64), seen

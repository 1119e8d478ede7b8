"""Costs as environments report them in ``info``: read, summed and refused in one way."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from sb3_guard.errors import ContractError, NumberError
from sb3_guard.fields import nearest


def number(value: Any, name: str) -> float:
    """One cost as a float: an int, bool, NumPy scalar or array of one number will do.

    :param name: what the message calls it
    :raises NumberError: it is something else, or not finite
    """
    try:
        scalar = value.item() if isinstance(value, np.ndarray) else value
        number = math.nan if isinstance(scalar, str | bytes) else float(scalar)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise NumberError(f"{name} is {value!r}: a cost must be a finite number")
    return number


def _missing(info: Mapping[str, Any], key: str, whose: str) -> ContractError:
    present = sorted(map(str, info))
    near = nearest(key, present)
    hint = "" if near is None else f" (nearest: {near!r})"
    return ContractError(
        f"{whose} has no cost key {key!r}; its keys are {present}{hint}. Name the right one, as "
        "with cost_keys=(...), or pass missing_cost='zero' if the key appears only when there is a "
        "cost; sb3_guard.common.adapters.CostFromFunction computes a cost"
    )


def read_costs(
    infos: Sequence[Mapping[str, Any]],
    keys: Sequence[str],
    zero_if_missing: bool = False,
    lengths: Sequence[int] | np.ndarray = (),
) -> tuple[np.ndarray, bool]:
    """Costs of one step of every environment.

    :param infos: one dictionary per environment
    :param keys: the m entries that hold costs
    :param zero_if_missing: whether an absent entry means that nothing was charged
    :param lengths: steps of the episodes under way before this one, for messages, shape (n_envs,)
    :return: costs, shape (n_envs, m), and whether any of the entries was there
    :raises ContractError: an entry is missing and may not be
    :raises NumberError: one is not a finite number
    """
    shape, seen = (len(infos), len(keys)), True
    try:
        rows = [[info[key] for key in keys] for info in infos]
    except KeyError:
        for i, info in enumerate(infos):
            for key in keys if not zero_if_missing else ():
                if key not in info:
                    raise _missing(info, key, f"info of {_row(i, lengths)}") from None
        rows = [[info.get(key, 0.0) for key in keys] for info in infos]
        seen = any(key in info for info in infos for key in keys)
    try:
        costs = np.array(rows).reshape(shape)
    except ValueError:  # of several shapes
        costs = np.array(None)
    if costs.dtype.kind not in "biuf" or not np.isfinite(costs).all():
        rows_of = range(len(infos))
        places = [f"info[{key!r}] of {_row(i, lengths)}" for i in rows_of for key in keys]
        values = itertools.chain(*rows)
        costs = np.array([*map(number, values, places)]).reshape(shape)
    return costs.astype(np.float64), seen


def _row(i: int, lengths: Sequence[int] | np.ndarray) -> str:
    step = f" in step {lengths[i] + 1} of its episode" if len(lengths) else ""
    return f"environment {i}{step}"


class EpisodeCost(NamedTuple):
    """What an episode that has ended cost, by each of the m costs.

    :param row: its environment
    :param total: undiscounted sum over its steps, shape (m,)
    :param highest: highest cost of a step, 0 where none is above it, shape (m,)
    :param bounded: the one of these two that the limits bound, shape (m,)
    :param length: its steps
    """

    row: int
    total: np.ndarray
    highest: np.ndarray
    bounded: np.ndarray
    length: int

    def known(self, info: Mapping[str, Any]) -> "EpisodeCost":
        """The same; NaNs of an episode that a physics error ended: nobody knows its cost.

        :param info: of its last step
        """
        if not info.get("physics_error"):
            return self
        nans = np.full_like(self.total, math.nan)
        return self._replace(total=nans, highest=nans, bounded=nans)


class EpisodeCosts:
    """The costs of the episodes under way, in all rows of a vectorised environment.

    :param n_envs: number of rows
    :param n_costs: number m of costs
    :param limit_on: what of an episode's costs the limits bound: their sum, or the highest one of a
        step. Then the charge of a step is what it adds to the highest before it, 0 at first
    """

    def __init__(self, n_envs: int, n_costs: int, limit_on: Literal["sum", "max"] = "sum") -> None:
        self.limit_on = limit_on
        self.totals = np.zeros((n_envs, n_costs))
        self.highest = np.zeros((n_envs, n_costs))
        self.lengths = np.zeros(n_envs, dtype=np.int64)
        #: what the last step added to what the limits bound, [n_envs, m]
        self.charges = np.zeros((n_envs, n_costs))

    def step(self, costs: np.ndarray, dones: np.ndarray) -> list[EpisodeCost]:
        """
        Add a step of every row.

        :param costs: shape (n_envs, m)
        :param dones: rows whose episodes it ended, shape (n_envs,)
        :return: these episodes
        :raises NumberError: a cost is negative where limits bound the highest one
        """
        before = self.highest
        self.highest = np.maximum(before, costs)
        self.charges = costs
        if self.limit_on == "max":
            if np.min(costs) < 0.0:
                raise NumberError(
                    f"a cost is {np.min(costs)}: a limit on the highest cost of a step needs costs "
                    "of at least 0"
                )
            self.charges = self.highest - before
        self.totals += costs
        self.lengths += 1
        return [self.end(row) for row in np.flatnonzero(dones).tolist()]

    def end(self, row: int) -> EpisodeCost:
        """Begin a new episode in a row; return what the last one cost."""
        total, highest = self.totals[row].copy(), self.highest[row].copy()
        bounded = highest if self.limit_on == "max" else total
        length = int(self.lengths[row])
        self.totals[row] = self.highest[row] = self.lengths[row] = 0
        return EpisodeCost(row, total, highest, bounded, length)


def check_cost_keys(keys: Any) -> tuple[str, ...]:
    """
    :return: the keys
    :raises ValueError: ``keys`` is not a sequence of different names
    """
    if (
        isinstance(keys, str)
        or len(keys) < 1
        or not all(isinstance(key, str) for key in keys)
        or len(set(keys)) < len(keys)
    ):
        raise ValueError(
            f"cost_keys={keys!r}: must be a sequence of one or more different names of info "
            "entries, such as ('cost',)"
        )
    return tuple(keys)


def check_per_cost(name: str, value: Any, cost_keys: tuple[str, ...]) -> None:
    """
    :raises ValueError: ``value`` is not one finite number, or one for each cost key
    """
    numbers = np.asarray(value)
    if numbers.ndim > 1 or (numbers.ndim == 1 and len(numbers) != len(cost_keys)):
        raise ValueError(
            f"{name}={value!r}: must be one number, or one for each of the "
            f"{len(cost_keys)} cost keys {cost_keys}"
        )
    if numbers.dtype.kind not in "iuf" or not np.all(np.isfinite(numbers)):
        order = f", in the order of cost_keys={cost_keys}" if len(cost_keys) > 1 else ""
        raise ValueError(f"{name}={value!r}: must be finite numbers{order}")

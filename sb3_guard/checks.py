"""Errors of environments, and checks of what costs are called and of values for each of them."""

from typing import Any

import numpy as np


class NumberError(FloatingPointError, ValueError):
    """A reward, cost, observation, action or loss is a number that nothing can be learnt from."""


class ContractError(ValueError):
    """An environment breaks Gymnasium's contract, or does not report what it must cost."""


class WorldError(Exception):
    """One of our environments can't be: it has no layout, no picture, or a part that is wrong."""


def is_number(value: Any) -> bool:
    """Whether a value is a finite number; booleans are not."""
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return number and bool(np.isfinite(value))


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

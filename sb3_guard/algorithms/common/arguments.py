"""What a constructor takes, said once: signatures and docstrings are composed along the MRO.

A class states its hyperparameters as attributes, each once: name, type, default and range::

    temperature: float = hyperparameter(1.5, ends="()")

A class that has another default states the attribute anew. What else a constructor takes it spells
out, and hands the others on by ``*args, **kwargs``. What ``inspect.signature``, Shift-Tab in a
notebook and the documentation show is the whole list.
"""

import inspect
import re
import types
import typing
from collections.abc import Iterable, Mapping
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np

from sb3_guard.fields import did_you_mean, fit

# Arguments that SB3's own base classes take from the algorithms, not from users.
_INTERNAL = {"supported_action_spaces", "monitor_wrapper", "support_multi_env", "sde_support"}
_ONLY = inspect.Parameter.KEYWORD_ONLY
_HANDS_ON = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


class Hyperparameter(NamedTuple):
    """See :func:`hyperparameter`."""

    default: Any
    low: float | None
    high: float
    ends: str

    def fitted(self, name: str, value: Any, hint: Any) -> Any:
        """
        :return: ``value``, checked if it is a number, a boolean or a literal
        :raises ValueError: it is not what the annotation and the range allow
        """
        kinds = {*(typing.get_args(hint) or (hint,))} - {types.NoneType}
        if kinds not in ({bool}, {int}, {float}) and typing.get_origin(hint) is not typing.Literal:
            return value
        low = float(kinds == {int}) if self.low is None else self.low
        return fit(name, value, hint, low, self.high, self.ends)


def hyperparameter(
    default: Any, low: float | None = None, high: float = np.inf, ends: str = "[)"
) -> Any:
    """A hyperparameter, as an attribute of a class that inherits from ``Constrained``.

    The constructor takes it by name. Integers, numbers and literals are checked by the annotation
    and the range before the model is built; what else has to be checked is for
    ``_check_hyperparameters``.

    :param default: its value where the call says nothing
    :param low: least value; None: 1 for integers, 0 for numbers
    :param high: greatest number
    :param ends: brackets of the interval of numbers
    """
    return Hyperparameter(default, low, high, ends)


def stated(cls: type) -> dict[str, Hyperparameter]:
    """The hyperparameters that a class and its bases state as attributes."""
    return {
        name: one
        for base in reversed(cls.__mro__)
        for name, one in vars(base).items()
        if isinstance(one, Hyperparameter)
    }


def signature(cls: type, fixed: frozenset[str] = frozenset()) -> inspect.Signature:
    """All arguments of a class: its own, then those of the constructors that it hands on to.

    :param cls: a class whose constructors forward ``**kwargs`` along the MRO
    :param fixed: arguments that a class on the way fills in itself
    """
    found: dict[str, inspect.Parameter] = {}
    positional = True
    for base in cls.__mro__:
        hints = inspect.get_annotations(base)
        for name, value in vars(base).items():
            if isinstance(value, Hyperparameter) and name not in fixed:
                hint = hints.get(name, inspect.Parameter.empty)
                parameter = inspect.Parameter(name, _ONLY, default=value.default, annotation=hint)
                found.setdefault(name, parameter)
        if not isinstance(constructor := vars(base).get("__init__"), FunctionType):
            continue
        _, *arguments = inspect.signature(constructor).parameters.values()
        for argument in arguments:
            if argument.kind in _HANDS_ON or argument.name in fixed | _INTERNAL:
                positional &= argument.name not in fixed  # its place is not free
                continue
            kind = argument.kind if positional else _ONLY
            nearest = found.setdefault(argument.name, argument.replace(kind=kind))
            # What comes after an argument that a class takes by name has no position either.
            positional &= argument.kind is _ONLY or nearest.kind is not _ONLY
        kinds = {argument.kind for argument in arguments}
        if inspect.Parameter.VAR_KEYWORD not in kinds:
            break
        positional &= inspect.Parameter.VAR_POSITIONAL in kinds
    # Without a default it comes first; what follows * need not.
    ordered = sorted(found.values(), key=lambda each: each.kind)
    return inspect.Signature(ordered)


def documentation(cls: type, arguments: Mapping[str, inspect.Parameter]) -> str:
    """The class's docstring with the arguments of its bases, each as the nearest base has it."""
    text = inspect.cleandoc(vars(cls).get("__doc__") or cls.__name__)
    entry = re.compile(r"^:param (\w+):.*(?:\n[ \t]+.*)*", re.M)
    entries: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        doc = inspect.cleandoc(vars(base).get("__doc__") or "")
        entries |= {match[1]: match[0] for match in entry.finditer(doc)}
    stated = [*entry.finditer(text)]
    wanted = [name for name in arguments if name in entries and not name.startswith("_")]
    others = [entries[n] for n in wanted if n not in {match[1] for match in stated}]
    # A list of parameters goes on; after other text a new one begins.
    at = stated[-1].end() if stated else len(text)
    return "\n".join([text[:at] + ("" if stated else "\n" * bool(others)), *others]) + text[at:]


def check_names(cls: type, given: Iterable[str]) -> None:
    """
    :raises TypeError: an argument is none of the class's; the nearest one is named
    """
    known = inspect.signature(cls).parameters
    for name in given:
        if name not in known:
            public = [each for each in known if not each.startswith("_")]
            raise TypeError(
                f"{cls.__name__} takes no argument {name!r}; {did_you_mean(name, public)}"
            )


def check_stated(algorithm: Any) -> None:
    """
    Give the stated hyperparameters their types.

    :param algorithm: a new one, or one that has the attributes of a file
    :raises ValueError: one is not what its annotation and range allow, or another algorithm has
        written the file
    """
    cls = type(algorithm)
    if algorithm.saved_as not in {base.__name__ for base in cls.__mro__}:
        raise ValueError(f"the file holds an agent of {algorithm.saved_as}, not of {cls.__name__}")
    arguments = inspect.signature(cls).parameters
    for name, parameter in stated(cls).items():
        if name in arguments:  # else a class on the way fills it in
            hint = arguments[name].annotation
            setattr(algorithm, name, parameter.fitted(name, getattr(algorithm, name), hint))

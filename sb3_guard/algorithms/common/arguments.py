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

from sb3_guard.checks import check_choice, check_integer, check_number
from sb3_guard.spelling import did_you_mean

# Arguments that SB3's own base classes take from the algorithms, not from users.
_INTERNAL = {"supported_action_spaces", "monitor_wrapper", "support_multi_env", "sde_support"}
# The ends of the ranges, from 0 to infinity, of arguments that SB3 does not check.
_THEIRS = {
    "clip_range": "()", "clip_range_vf": "()", "ent_coef": "[)", "target_policy_noise": "[)",
    "target_noise_clip": "[)",
}  # fmt: skip
_ONLY = inspect.Parameter.KEYWORD_ONLY
_HANDS_ON = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


class Hyperparameter(NamedTuple):
    """See :func:`hyperparameter`."""

    default: Any
    low: float | None
    high: float
    ends: str

    def check(self, name: str, value: Any, hint: Any) -> None:
        """
        :raises ValueError: ``value`` is not what the annotation and the range allow
        """
        union = typing.get_origin(hint) in (typing.Union, types.UnionType)
        kinds = {*(typing.get_args(hint) if union else (hint,))} - {types.NoneType}
        if value is None and types.NoneType in typing.get_args(hint):
            return
        if typing.get_origin(hint) is typing.Literal:
            check_choice(name, value, *typing.get_args(hint))
        elif kinds == {bool}:
            if not isinstance(value, bool | np.bool_):
                raise ValueError(f"{name}={value!r}: must be True or False")
        elif kinds == {int}:
            check_integer(name, value, 1 if self.low is None else int(self.low))
        elif kinds == {float}:
            check_number(name, value, self.low or 0.0, self.high, self.ends)


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


def _annotations(cls: type) -> dict[str, Any]:
    """Those written in this very class, evaluated where that is possible."""
    try:
        return inspect.get_annotations(cls, eval_str=True)
    except (NameError, TypeError):  # what only a type checker can resolve
        return inspect.get_annotations(cls)


def own_arguments(cls: type) -> list[inspect.Parameter]:
    """What the constructor written in this very class takes, without ``self``."""
    constructor = cls.__dict__.get("__init__")
    if not isinstance(constructor, FunctionType):
        return []
    try:
        signature = inspect.signature(constructor, eval_str=True)
    except (NameError, TypeError):  # annotations that only a type checker can resolve
        signature = inspect.signature(constructor)
    return list(signature.parameters.values())[1:]


def signature(cls: type, fixed: frozenset[str] = frozenset()) -> inspect.Signature:
    """All arguments of a class: its own, then those of the constructors that it hands on to.

    :param cls: a class whose constructors forward ``**kwargs`` along the MRO
    :param fixed: arguments that a class on the way fills in itself
    """
    found: dict[str, inspect.Parameter] = {}
    positional = True
    for one in cls.__mro__:
        for name, value in vars(one).items():
            if isinstance(value, Hyperparameter) and name not in fixed:
                hint = _annotations(one).get(name, inspect.Parameter.empty)
                parameter = inspect.Parameter(name, _ONLY, default=value.default, annotation=hint)
                found.setdefault(name, parameter)
        own = own_arguments(one)
        for each in own:
            if each.kind in _HANDS_ON or each.name in fixed | _INTERNAL:
                continue
            kind = each.kind if positional else _ONLY
            nearest = found.setdefault(each.name, each.replace(kind=kind))
            # What comes after an argument that a class takes by name has no position either.
            positional &= each.kind is _ONLY or nearest.kind is not _ONLY
        kinds = {each.kind for each in own}
        if own and inspect.Parameter.VAR_KEYWORD not in kinds:
            break
        if own and inspect.Parameter.VAR_POSITIONAL not in kinds:
            positional = False
    # Without a default it comes first; what follows * need not.
    ordered = sorted(found.values(), key=lambda each: each.kind)
    return inspect.Signature(ordered)


def documentation(cls: type, arguments: Mapping[str, inspect.Parameter]) -> str:
    """The class's docstring with the arguments of its bases, each as the nearest base has it."""
    own = inspect.cleandoc(cls.__dict__.get("__doc__") or "")
    known: dict[str, str] = {}
    for one in cls.__mro__:
        text = inspect.cleandoc(one.__dict__.get("__doc__") or "")
        for name, entry in re.findall(r"^:param (\w+): ?((?:.*)(?:\n[ \t]+.*)*)", text, re.M):
            known.setdefault(name, f":param {name}: {entry}")
    stated = set(re.findall(r"^:param (\w+):", own, re.M))
    wanted = [name for name in arguments if name not in stated and not name.startswith("_")]
    others = [known[name] for name in wanted if name in known]
    if not others:
        return own
    # A list of parameters goes on; after other text a new one begins.
    at = [match.end() for match in re.finditer(r"^:param .*(?:\n[ \t]+.*)*", own, re.M)]
    if not at:
        return "\n".join([own or cls.__name__, "", *others])
    return own[: at[-1]] + "\n" + "\n".join(others) + own[at[-1] :]


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


def check_theirs(algorithm: Any) -> None:
    """
    Refuse values of SB3's own arguments that it takes silently, or fails at later.

    :raises ValueError: one is out of its range
    """
    for name, ends in _THEIRS.items():
        value = getattr(algorithm, name, None)
        if isinstance(value, int | float):  # else absent, a schedule, or "auto"
            check_number(name, value, ends=ends)

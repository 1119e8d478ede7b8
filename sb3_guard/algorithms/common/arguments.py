"""What a constructor takes, said once: signatures and docstrings are composed along the MRO.

Every class spells out its own arguments and hands the others on by ``*args, **kwargs``; where only
the values differ from those of its bases it states them in ``defaults``. What
``inspect.signature``, Shift-Tab in a notebook and the documentation show is the whole list.
"""

import inspect
import re
from collections.abc import Mapping
from functools import wraps
from types import FunctionType
from typing import Any

from sb3_guard.spelling import did_you_mean

# Arguments that SB3's own base classes take from the algorithms, not from users.
_INTERNAL = {"supported_action_spaces", "monitor_wrapper", "support_multi_env", "sde_support"}
_HANDS_ON = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)


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


def defaults_of(cls: type) -> dict[str, Any]:
    """Default values that a class and its bases state in ``defaults``, the nearest one's first."""
    stated = (vars(one).get("defaults", {}) for one in reversed(cls.__mro__))
    return {name: value for each in stated for name, value in each.items()}


def taking_defaults(cls: type) -> FunctionType:
    """The constructor of a class, given what ``defaults`` states unless a call says otherwise."""
    construct, defaults = cls.__init__, vars(cls)["defaults"]  # type: ignore[misc]

    @wraps(construct)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        construct(self, *args, **{**defaults, **kwargs})

    return __init__  # type: ignore[return-value]


def signature(cls: type, fixed: frozenset[str] = frozenset()) -> inspect.Signature:
    """All arguments of a class: its own, then those of the constructors that it hands on to.

    :param cls: a class whose constructors forward ``**kwargs`` along the MRO
    :param fixed: arguments that a class on the way fills in itself
    """
    found: dict[str, inspect.Parameter] = {}
    positional = True
    for one in cls.__mro__:
        own = own_arguments(one)
        for each in own:
            if each.kind in _HANDS_ON or each.name in fixed | _INTERNAL:
                continue
            kind = each.kind if positional else inspect.Parameter.KEYWORD_ONLY
            found.setdefault(each.name, each.replace(kind=kind))
        kinds = {each.kind for each in own}
        if own and inspect.Parameter.VAR_KEYWORD not in kinds:
            break
        if own and inspect.Parameter.VAR_POSITIONAL not in kinds:
            positional = False
    for name, default in defaults_of(cls).items():
        if name in found:
            found[name] = found[name].replace(default=default)
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


def check_names(cls: type, given: Mapping[str, Any]) -> None:
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


def with_defaults(function: FunctionType, **defaults: Any) -> FunctionType:
    """A copy of a function with other default values."""
    names = list(inspect.signature(function).parameters)
    old = function.__defaults__ or ()
    new = [
        defaults.get(name, default)
        for name, default in zip(names[len(names) - len(old) :], old, strict=True)
    ]
    copy = FunctionType(
        function.__code__,
        function.__globals__,
        function.__name__,
        tuple(new),
        function.__closure__,
    )
    copy.__annotations__ = function.__annotations__
    copy.__doc__, copy.__module__ = function.__doc__, function.__module__
    copy.__qualname__ = function.__qualname__
    return copy

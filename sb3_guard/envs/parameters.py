"""Parameters that check themselves: the dataclass fields of every part of an environment.

A bad name, type or value fails where the part is made, in one line that names the parameter, the
value and what is allowed. Plain JSON and YAML values are enough: lists become tuples. Where
``param(..., drawn=True)`` says so, a :class:`Range` may stand in place of a number.
"""

import dataclasses
import math
import re
import types
import typing
from collections.abc import Mapping
from dataclasses import field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from sb3_guard.checks import WorldError
from sb3_guard.spelling import did_you_mean


class PartError(WorldError, ValueError):
    """A part does not keep its contract; the message names the part, the verb and the fix."""


def misshapen(what: str, shape: tuple[Any, ...], expected: tuple[Any, ...]) -> str:
    """An error message about an array of a part."""
    words = f"({', '.join(map(str, expected))}{',' * (len(expected) == 1)})"
    return f"{what} has shape {shape}, expected {words}: one row for each simulation of the batch"


def check_count(name: str, value: Any) -> None:
    """Refuse a value that is not an integer of at least 1."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name} = {value!r} must be an integer of at least 1")


class Range(NamedTuple):
    """What a number is drawn from, uniformly, when an episode begins; integers include both ends.

    Users write ``{"low": a, "high": b}``.
    """

    low: float
    high: float


def param(
    default: Any,
    doc: str,
    *,
    above: float | None = None,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[Any, ...] | None = None,
    drawn: bool | str = False,
) -> Any:
    """A dataclass field that is checked on construction and documents itself.

    :param default: the default value
    :param doc: what it is, with its unit
    :param above: the value must be greater than this
    :param low: the value must be at least this
    :param high: the value must be at most this
    :param choices: the value must be one of these
    :param drawn: whether the number may be drawn anew in each episode, from a :class:`Range`;
        ``"mass"`` or ``"friction"``: it may, and multiplies those of the part's bodies
    """
    limits = {"doc": doc, "above": above, "low": low, "high": high, "choices": choices}
    return field(default=default, metadata={**limits, "drawn": drawn})


_WORDS = {  # what an error message calls one value of a type, and several
    float: ("a number", "numbers"),
    int: ("an integer", "integers"),
    bool: ("true or false", "true or false"),
    str: ("text", "texts"),
    dict: ("a mapping", "mappings"),
    types.NoneType: ("null", "null"),
}


def _matches(value: Any, kind: Any) -> bool:
    """Whether ``value`` is of the annotated type ``kind``; a bool is not a number."""
    if kind is Any:
        return True
    if kind is None or kind is types.NoneType:
        return value is None
    origin = typing.get_origin(kind)
    if origin in (typing.Union, types.UnionType):
        return any(_matches(value, k) for k in typing.get_args(kind))
    if origin is tuple:
        args = typing.get_args(kind)
        if not isinstance(value, tuple):
            return False
        if len(args) == 2 and args[1] is Ellipsis:
            return all(_matches(v, args[0]) for v in value)
        return len(value) == len(args) and all(map(_matches, value, args))
    if kind is float:
        return (
            isinstance(value, (int, float, np.integer, np.floating))
            and not isinstance(value, bool)
            and math.isfinite(value)
        )
    if kind is int:
        return isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    return isinstance(value, origin or kind)


def in_words(kind: Any, many: bool = False) -> str:
    """What an error message calls an annotated type, in the words of JSON and YAML."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(in_words(k, many) for k in args)
    if origin is tuple:
        count = "" if args[-1] is Ellipsis else f"{len(args)} "
        return f"{'lists' if many else 'a list'} of {count}{in_words(args[0], many=True)}"
    kind = origin or kind
    return _WORDS[kind][many] if kind in _WORDS else getattr(kind, "__name__", str(kind))


_EXPONENT = re.compile(r"[-+]?\d+\.?\d*[eE][-+]?\d+")


def _plain(value: Any) -> Any:
    """Lists and arrays as tuples; text such as 2e-3, a number that YAML does not know, as one."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return tuple(map(_plain, value))
    return float(value) if isinstance(value, str) and _EXPONENT.fullmatch(value) else value


def _check(label: str, value: Any, kind: Any, limits: Mapping[str, Any]) -> None:
    """
    :raises ValueError: a value of another type, or not within the limits of its field
    """
    if not _matches(value, kind):
        raise ValueError(f"{label} = {value!r} must be {in_words(kind)}")
    if limits.get("choices") is not None and value not in limits["choices"]:
        names = ["null" if c is None else str(c) for c in limits["choices"]]
        raise ValueError(f"{label} = {value!r}: {did_you_mean(value, names)}")
    for v in value if isinstance(value, tuple) else (value,):
        if not isinstance(v, (int, float)):
            continue
        if limits.get("above") is not None and not v > limits["above"]:
            raise ValueError(f"{label} = {value!r} must be greater than {limits['above']}")
        if limits.get("low") is not None and not v >= limits["low"]:
            raise ValueError(f"{label} = {value!r} must be at least {limits['low']}")
        if limits.get("high") is not None and not v <= limits["high"]:
            raise ValueError(f"{label} = {value!r} must be at most {limits['high']}")


class Parameters:
    """A dataclass of parameters that are checked when it is made.

    A parameter that is drawn anew in each episode has the greatest value of its range.

    :raises ValueError: a value of the wrong type or out of range, in one line that names the
        parameter, the value and what is allowed
    """

    name: str = ""  # what messages call it, and users the keyword that sets its parameters
    ranges: Mapping[str, Range] = types.MappingProxyType({})  # of what is drawn, by parameter
    # what to write instead of parameters that it does not have, though others have them
    instead: ClassVar[Mapping[str, str]] = {}

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        ranges: dict[str, Range] = {}
        for f in dataclasses.fields(self):  # type: ignore[arg-type]
            value, kind = _plain(getattr(self, f.name)), hints[f.name]
            label = f"{self.name or type(self).__name__}.{f.name}"
            if isinstance(value, Mapping) and not _matches(value, kind):
                ranges[f.name] = self._range(f, label, value, kind)
                value = ranges[f.name].high
            else:
                _check(label, value, kind, f.metadata)
            object.__setattr__(self, f.name, value)
        if ranges:
            object.__setattr__(self, "ranges", ranges)

    def _range(self, f: Any, label: str, value: Mapping[str, Any], kind: Any) -> Range:
        """The range that a mapping states.

        :raises ValueError: this is no range, or the parameter cannot be drawn
        """
        if not f.metadata.get("drawn"):
            names = [g.name for g in dataclasses.fields(self) if g.metadata.get("drawn")]  # type: ignore[arg-type]
            others = f"; of {self.name} can: {', '.join(names)}" if names else ""
            raise ValueError(
                f"{label} = {value!r} must be {in_words(kind)}: it cannot be drawn anew in each "
                f"episode{others}"
            )
        if set(value) != {"low", "high"}:
            raise ValueError(
                f"{label} = {value!r} must be {in_words(kind)}, or {{'low': a, 'high': b}} to draw "
                "it anew in each episode"
            )
        low, high = _plain(value["low"]), _plain(value["high"])
        for end, limit in (("low", low), ("high", high)):
            _check(f"{label}.{end}", limit, kind, f.metadata)
        if low > high:
            raise ValueError(f"{label} = {value!r}: low must be at most high")
        return Range(low, high) if kind is int else Range(float(low), float(high))

    def span(self, name: str) -> Range:
        """The least and the greatest value of a parameter: the same unless it is drawn."""
        value = getattr(self, name)
        return self.ranges.get(name, Range(value, value))

    @classmethod
    def from_params(cls, params: Mapping[str, Any], name: str | None = None) -> typing.Self:
        """Make one from a mapping of parameter names to values.

        :param name: what it is called; None: as its class says
        :raises ValueError: an unknown name, with the nearest match, or a bad value
        """
        label = name or cls.name or cls.__name__
        if not isinstance(params, Mapping):
            raise ValueError(f"{label} = {params!r} must be a mapping of parameters to values")
        known = [f.name for f in dataclasses.fields(cls) if f.init]  # type: ignore[arg-type]
        for key in params:
            if key not in known:
                hint = cls.instead.get(key) or did_you_mean(key, known)
                raise ValueError(f"{label} has no parameter {key!r}: {hint}")
        made = cls.__new__(cls)
        if name is not None:
            made.name = name  # before the values are checked: it is in the messages
        made.__init__(**params)  # type: ignore[misc]
        return made

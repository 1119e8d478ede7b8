"""Parameters that check themselves: the dataclass fields of every part of an environment.

A bad name, type or value fails where the part is made, in one line that names the parameter, the
value and what is allowed. Plain JSON and YAML values are enough: lists become tuples. Where
``param(..., drawn=True)`` says so, a :class:`Range` may stand in place of a number.
"""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import field
from typing import Any, NamedTuple

from sb3_guard.errors import WorldError
from sb3_guard.fields import did_you_mean, fit, in_words


class PartError(WorldError, ValueError):
    """A part does not keep its contract; the message names the part, the verb and the fix."""


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


def _fit(label: str, value: Any, annotation: Any, limits: Mapping[str, Any]) -> Any:
    """The value of a field, lists as tuples.

    :param limits: of the field, see :func:`param`
    :raises ValueError: a value of another type, or not within the limits
    """
    above, low, high = (limits.get(name) for name in ("above", "low", "high"))
    least = low if above is None else above
    return _frozen(
        fit(
            label,
            _frozen(value),
            annotation,
            -math.inf if least is None else least,
            math.inf if high is None else high,
            ("[" if above is None else "(") + ("]" if high is not None else ")"),
            limits.get("choices"),
        )
    )


def _frozen(value: Any) -> Any:
    """Lists as tuples, at any depth."""
    return tuple(map(_frozen, value)) if isinstance(value, (list, tuple)) else value


class Parameters:
    """A dataclass of parameters that are checked when it is made.

    A parameter that is drawn anew in each episode has the greatest value of its range.

    :raises ValueError: a value of the wrong type or out of range, in one line that names the
        parameter, the value and what is allowed
    """

    name: str = ""  # what messages call it, and users the keyword that sets its parameters
    ranges: Mapping[str, Range] = types.MappingProxyType({})  # of what is drawn, by parameter

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        ranges: dict[str, Range] = {}
        for f in dataclasses.fields(self):  # type: ignore[arg-type]
            value, kind = getattr(self, f.name), hints[f.name]
            label = f"{self.name or type(self).__name__}.{f.name}"
            if isinstance(value, Mapping):
                ranges[f.name] = self._range(f, label, value, kind)
                value = ranges[f.name].high
            object.__setattr__(self, f.name, _fit(label, value, kind, f.metadata))
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
        low, high = (_fit(f"{label}.{end}", value[end], kind, f.metadata) for end in Range._fields)
        if low > high:
            raise ValueError(f"{label} = {value!r}: low must be at most high")
        return Range(low, high)

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
                raise ValueError(f"{label} has no parameter {key!r}: {did_you_mean(key, known)}")
        made = cls.__new__(cls)
        if name is not None:
            made.name = name  # before the values are checked: it is in the messages
        made.__init__(**params)  # type: ignore[misc]
        return made

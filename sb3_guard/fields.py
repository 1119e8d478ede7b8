"""Values of fields: whether an annotation and a range allow them, and in words what they allow.

Hyperparameters, parameters of environments and flags have one rule. Booleans are no numbers, and
NaN is none; a whole float is an integer; text that is a number counts as one, since YAML reads 1e-3
as text. Text of command lines and files is read from its syntax tree and never evaluated; YAML is
plain data. Every error message about a name ends with what a misspelled one may have meant.
"""

import ast
import difflib
import fnmatch
import math
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import yaml

_WORDS: dict[Any, str] = {
    float: "a number",
    int: "an integer",
    bool: "true or false",
    str: "text",
    dict: "a mapping",
    Mapping: "a mapping",
    types.NoneType: "null",
    type: "the dotted name of a class",
    Callable: "a schedule (lin_…)",
}


def fit(
    name: str,
    value: Any,
    annotation: Any = Any,
    low: float = -math.inf,
    high: float = math.inf,
    ends: str = "()",
    choices: Sequence[Any] | None = None,
) -> Any:
    """
    The value of a field, as its annotation, range and choices allow it.

    :param name: of the field, for the message
    :param low: least value of each number
    :param high: greatest value of each number
    :param ends: whether the range includes them, such as ``"[)"``; infinite values never fit
    :param choices: the only values that are allowed; None: a ``Literal`` has its own
    :return: see :func:`typed`
    :raises ValueError: it is not allowed; the message has the name, the value and what is allowed
    """
    if typing.get_origin(annotation) is typing.Literal:
        choices = typing.get_args(annotation)
    if choices is not None:
        for choice in choices:
            if value == choice or str(value) == str(choice):
                return choice
        names = ["null" if choice is None else str(choice) for choice in choices]
        raise ValueError(f"{name} = {value!r}: {did_you_mean(value, names)}")
    try:
        made = typed(value, annotation)
    except TypeError:
        allowed = in_words(annotation, low, high, ends)
        raise ValueError(f"{name} = {value!r} must be {allowed}") from None
    for number in _numbers(made):
        above = number >= low if ends[0] == "[" else number > low
        below = number <= high if ends[1] == "]" else number < high
        if not (above and below):
            allowed = _bounds(low, high, ends) if math.isfinite(number) else "finite"
            raise ValueError(f"{name} = {value!r} must be {allowed}")
    return made


def plain(value: Any) -> Any:
    """A value as a file gives it back: lists for tuples and arrays, dictionaries for mappings."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, list | tuple):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value


def typed(value: Any, annotation: Any) -> Any:
    """
    A value as an annotation allows it, tuples as lists.

    Of several types the one that fits without change counts: 1 stays an integer where integers and
    numbers are allowed. Objects that a file cannot hold, such as classes, are named by text.

    :raises TypeError: it is not allowed
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    kind, args = typing.get_origin(annotation) or annotation, typing.get_args(annotation)
    if kind in (typing.Union, types.UnionType):
        for arm in sorted(args, key=lambda arm: type(value) is not arm):
            with suppress(TypeError):
                return typed(value, arm)
    elif kind in (int, float):
        return _number(value, kind)
    elif kind in (list, tuple, Sequence):
        fixed = kind is tuple and args and args[-1] is not ...  # one annotation for each item
        if isinstance(value, list | tuple) and (not fixed or len(value) == len(args)):
            kinds = args if fixed else [args[0] if args else Any] * len(value)
            return [*map(typed, value, kinds)]
    elif kind in (None, types.NoneType) and value in (None, "null"):
        return None
    elif kind is typing.Literal:
        if value in args:
            return value
    elif kind in (type, Callable):
        if isinstance(value, str) and ("." in value or value.startswith("lin_")):
            return value
    elif isinstance(kind, type) and issubclass(kind, Mapping):
        if isinstance(value, Mapping):
            return {k: typed(item, args[1]) for k, item in value.items()} if args else value
    elif kind in (bool, str):
        if isinstance(value, kind):
            return value
    elif kind is Any or not (
        isinstance(kind, type) and isinstance(value, str | bool | int | float)
    ):
        return value  # an object of a class, or anything
    raise TypeError


def _number(value: Any, kind: type) -> int | float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (ValueError, OverflowError):
        raise TypeError from None
    if math.isnan(number) or (kind is int and not number.is_integer()):
        raise TypeError
    if kind is int:
        return value if isinstance(value, int) else int(number)
    return number


def in_words(
    annotation: Any, low: float = -math.inf, high: float = math.inf, ends: str = "[]"
) -> str:
    """What an annotation and a range allow, in the words of JSON and YAML."""
    kind, args = typing.get_origin(annotation) or annotation, typing.get_args(annotation)
    if kind in (typing.Union, types.UnionType):
        text = " or ".join(dict.fromkeys(map(in_words, args)))
    elif kind is typing.Literal:
        text = " or ".join(map(repr, args))
    elif kind is tuple and args and args[-1] is not ...:
        text = f"a list of {' and '.join(map(in_words, args))}"
    elif kind in (list, tuple, Sequence):
        text = "a list" + (f", each item {in_words(args[0])}" if args else "")
    else:
        text = _WORDS.get(kind) or str(getattr(annotation, "__name__", annotation))
    bounds = _bounds(low, high, ends)
    return f"{text}, {bounds}" if bounds else text


def _bounds(low: float, high: float, ends: str) -> str:
    """A range in words; empty: all numbers."""
    bounds = []
    if math.isfinite(low):
        bounds.append(f"{'at least' if ends[0] == '[' else 'greater than'} {low:.12g}")
    if math.isfinite(high):
        bounds.append(f"{'at most' if ends[1] == ']' else 'less than'} {high:.12g}")
    return " and ".join(bounds)


def read_expression(text: str) -> Any:
    """
    The value of an expression such as ``dict(num=4, activation_fn=nn.ReLU)``.

    :param text: literals, lists, tuples and mappings of them, ``dict(name=value)``; dotted names
        stay text
    :raises ValueError: anything else
    """
    try:
        return _read(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise ValueError(f"{text[:60]!r} is not an expression: {error}") from error


def _read(node: ast.expr) -> Any:
    match node:
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=pairs):
            if all(pair.arg for pair in pairs):  # none is **
                return {pair.arg: _read(pair.value) for pair in pairs}
        case ast.Dict(keys=keys, values=values):
            # A shell takes quotes away, so that {limit:0.4} is what a user typed or what is left.
            names = [
                key.id if isinstance(key, ast.Name) else ast.literal_eval(key or node)
                for key in keys
            ]
            return dict(zip(names, map(_read, values), strict=True))
        case ast.List(elts=items):
            return [*map(_read, items)]
        case ast.Tuple(elts=items):
            return tuple(map(_read, items))
        case ast.Attribute():
            return ast.unparse(node)
        case ast.Constant() | ast.UnaryOp() | ast.BinOp() | ast.Set():
            return ast.literal_eval(node)
    raise ValueError(f"{ast.unparse(node)} is not allowed")


def parse_value(text: str) -> Any:
    """
    The value of ``key:value``: an expression, see :func:`read_expression`, else the text itself.

    So ``cost_limit:25``, ``policy:MlpPolicy``, ``hazards:{num:4}`` and ``learning_rate:lin_1e-3``
    need no further quotes.
    """
    try:
        return read_expression(text)
    except ValueError:
        return text


def is_data(value: Any) -> bool:
    """Whether a YAML file can hold the value."""
    if isinstance(value, Mapping):
        return all(isinstance(key, str) and is_data(item) for key, item in value.items())
    if isinstance(value, list | tuple):
        return all(map(is_data, value))
    return value is None or isinstance(value, str | bool | int | float)


def is_number(value: Any) -> bool:
    """Whether a value is a finite number; booleans are not."""
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return number and bool(np.isfinite(value))


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The allowed name that ``name`` most likely meant, whatever its case; None: nothing is near.

    :param known: allowed names; among equally near ones the first is meant
    """
    wrong = str(name).lower()

    def likeness(allowed: str) -> float:
        return difflib.SequenceMatcher(None, allowed.lower(), wrong).ratio()

    close = max(known, key=likeness, default="")
    return close if likeness(close) >= 0.6 else None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Say what ``name`` may have meant and what is allowed, for an error message.

    :param known: allowed names; among equally near ones the first is meant
    """
    known = list(known)
    close = nearest(name, known)
    hint = "" if close is None else f"did you mean {close!r}? "
    return f"{hint}allowed: {', '.join(known) or 'none'}"


def matching(label: str, pattern: str, known: Iterable[str]) -> list[str]:
    """The names that a pattern matches, such as ``*_knee`` (``*``: any text, ``?``: a character).

    :param label: what an error message calls the place of the pattern
    :param known: allowed names
    :raises ValueError: there is none
    """
    known, pattern = list(known), str(pattern)
    names = fnmatch.filter(known, pattern) or [name for name in known if name == pattern]
    if not names:
        raise ValueError(f"{label} matches no name {pattern!r}: {did_you_mean(pattern, known)}")
    return names


# In C where libyaml is there, ten times as fast: a large grid reads a thousand files.
class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    pass


def _ordered(loader: Any, node: Any) -> dict[Any, Any]:
    """The ordered mapping that RL-Zoo writes: a list of one list of pairs."""
    return dict(*loader.construct_sequence(node, deep=True))


_Loader.add_constructor("tag:yaml.org,2002:python/object/apply:collections.OrderedDict", _ordered)


def load_yaml(text: str) -> Any:
    """
    The plain data of a YAML text.

    :raises yaml.YAMLError: it is no YAML
    """
    return yaml.load(text, _Loader)

"""Values as text, read from the syntax tree, and as annotations of types allow them.

Text comes from command lines, and from files that travel with agents. Nothing here is evaluated,
so reading a value never runs anything.
"""

import ast
import math
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any


def read_expression(text: str, named: Callable[[str], Any] | None = None) -> Any:
    """
    The value of an expression such as ``dict(num=4, places=[(0, 1)])``.

    :param text: literals, lists, tuples and mappings of them, ``dict(name=value)``
    :param named: what a dotted name such as ``nn.ReLU`` stands for; None: names are not allowed
    :raises ValueError: anything else
    """
    try:
        return _value(ast.parse(text.strip(), mode="eval").body, named)
    except (SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise ValueError(f"{text[:60]!r} is not an expression: {error}") from error


def _value(node: ast.expr, named: Callable[[str], Any] | None) -> Any:
    match node:
        case ast.Call(func=ast.Name(id="dict"), args=[], keywords=pairs):
            if all(pair.arg for pair in pairs):  # none is **
                return {pair.arg: _value(pair.value, named) for pair in pairs}
        case ast.Dict(keys=keys, values=values):
            pairs_ = [(key, one) for key, one in zip(keys, values, strict=True) if key is not None]
            if len(pairs_) == len(values):
                return {_key(key): _value(one, named) for key, one in pairs_}
        case ast.List(elts=items):
            return [_value(item, named) for item in items]
        case ast.Tuple(elts=items):
            return tuple(_value(item, named) for item in items)
        case ast.Attribute() if named is not None:
            return named(ast.unparse(node))
        case ast.Constant() | ast.UnaryOp() | ast.BinOp() | ast.Set():
            return ast.literal_eval(node)
    raise ValueError(f"{ast.unparse(node)} is not allowed")


def _key(node: ast.expr) -> Any:
    """A shell takes quotes away, so that ``{limit:0.4}`` is what a user typed or what is left."""
    return node.id if isinstance(node, ast.Name) else ast.literal_eval(node)


def parse_value(text: str) -> Any:
    """
    The value of ``key:value``: a literal or ``dict(a=1)``; anything else is text as it is.

    So ``cost_limit:25``, ``policy:MlpPolicy``, ``hazards:{num:4}`` and ``learning_rate:lin_1e-3``
    need no further quotes, and ``policy_kwargs:dict(activation_fn=nn.ReLU)`` stays text until the
    model is made, as it does in a YAML file.
    """
    try:
        return read_expression(text)
    except ValueError:
        return text


def kind_of(hint: Any) -> tuple[str, Callable[[Any], Any]]:
    """
    What an annotation allows: in words, and what makes it of a value, or raises TypeError.

    Numbers that YAML reads as text (``1e-3``) and whole floats fit; objects that a file can't hold
    are named by text.
    """
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    kind = origin or hint
    names = {bool: "True or False", str: "text", None: "None", types.NoneType: "None"}
    if kind in (typing.Union, types.UnionType):
        return _any_of({arm: kind_of(arm) for arm in args})
    if kind in (int, float):
        return "a whole number" if kind is int else "a number", partial(_number, kind=kind)
    if kind is tuple and args and args[-1] is not ...:
        words, makes = zip(*map(kind_of, args), strict=True)
        is_tuple = _only(lambda value: isinstance(value, list | tuple) and len(value) == len(args))
        made = lambda value: [make(v) for make, v in zip(makes, is_tuple(value), strict=True)]  # noqa: E731
        return f"a list of {' and '.join(words)}", made
    if kind in (list, tuple, Sequence):
        words, make = kind_of(args[0] if args else Any)
        each = f" ({words} each)" if args and args[0] is not ... else ""
        is_list = _only(lambda value: isinstance(value, list | tuple))
        return f"a list{each}", lambda value: [make(one) for one in is_list(value)]
    if kind is typing.Literal:
        return " or ".join(map(repr, args)), _only(lambda value: value in args)
    if kind in names:
        return names[kind], _only(lambda value: isinstance(value, hint or types.NoneType))
    if isinstance(kind, type) and issubclass(kind, Mapping):
        # Text is evaluated when the model is made: `dict(activation_fn=nn.ReLU)`.
        dicts = lambda value: isinstance(value, str) and value.startswith("dict(")  # noqa: E731
        return "a mapping", _only(lambda value: isinstance(value, Mapping) or dicts(value))
    if kind in (type, Callable):
        words = "the dotted name of a class" if kind is type else "a schedule such as lin_0.001"
        named = lambda value: "." in value or value.startswith("lin_")  # noqa: E731
        return words, _only(lambda value: isinstance(value, str) and named(value))
    free = hint is Any or not isinstance(hint, type)
    data = str | bool | int | float
    return getattr(hint, "__name__", str(hint)), _only(lambda v: free or not isinstance(v, data))


def _only(fits: Callable[[Any], bool]) -> Callable[[Any], Any]:
    """What returns values that fit as they are."""

    def make(value: Any) -> Any:
        if not fits(value):
            raise TypeError
        return value

    return make


def _any_of(arms: Mapping[Any, tuple[str, Callable[[Any], Any]]]) -> tuple[str, Callable]:
    """The kind of a union of others."""

    def make(value: Any) -> Any:
        # The arm that fits without change wins: 1 stays an int where int and float are allowed.
        for arm in sorted(arms, key=lambda arm: type(value) is not arm):
            with suppress(TypeError):
                return arms[arm][1](value)
        raise TypeError

    return " or ".join(dict.fromkeys(words for words, _ in arms.values())), make


def _number(value: Any, kind: type) -> int | float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except ValueError:
        raise TypeError from None
    if math.isnan(number) or (kind is int and not number.is_integer()):
        raise TypeError
    return int(number) if kind is int else number


def is_data(value: Any) -> bool:
    """Whether a YAML file can hold the value."""
    if isinstance(value, Mapping):
        return all(isinstance(key, str) and is_data(item) for key, item in value.items())
    if isinstance(value, list | tuple):
        return all(map(is_data, value))
    return value is None or isinstance(value, str | bool | int | float)

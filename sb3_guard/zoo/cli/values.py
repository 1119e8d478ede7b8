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
            if None not in keys:  # none is **
                return {
                    _key(key): _value(value, named)  # type: ignore[arg-type]
                    for key, value in zip(keys, values, strict=True)
                }
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
    need no further quotes; ``policy_kwargs:dict(activation_fn=nn.ReLU)`` is text here, and is read
    with the other hyperparameters.
    """
    try:
        return read_expression(text)
    except ValueError:
        return text


def typed(value: Any, hint: Any) -> Any:
    """
    A value of a file as an annotation allows it.

    Numbers that YAML reads as text (``1e-3``) and whole floats fit; objects that a file can't hold
    are named by text.

    :raises TypeError: it is not allowed
    """
    kind, args = typing.get_origin(hint) or hint, typing.get_args(hint)
    if kind in (typing.Union, types.UnionType):
        # The arm that fits without change wins: 1 stays an int where int and float are allowed.
        for arm in sorted(args, key=lambda arm: type(value) is not arm):
            with suppress(TypeError):
                return typed(value, arm)
    elif kind in (int, float):
        return _number(value, kind)
    elif kind in (list, tuple, Sequence):
        fixed = kind is tuple and args and args[-1] is not ...  # one annotation for each item
        if isinstance(value, list | tuple) and (not fixed or len(value) == len(args)):
            hints = args if fixed else [args[0] if args else Any] * len(value)
            return [typed(item, of) for item, of in zip(value, hints, strict=True)]
    elif _fits(value, kind, args):
        return value
    raise TypeError


def _fits(value: Any, kind: Any, args: Sequence[Any]) -> bool:
    if kind is typing.Literal:
        return value in args
    if kind in (type, Callable):
        return isinstance(value, str) and ("." in value or value.startswith("lin_"))
    if kind in (None, bool, str) or (isinstance(kind, type) and issubclass(kind, Mapping)):
        return isinstance(value, kind or types.NoneType)
    free = kind is Any or not isinstance(kind, type)
    return free or not isinstance(value, str | bool | int | float)


_WORDS: dict[Any, str] = {
    bool: "True or False", str: "text", int: "a whole number", float: "a number", None: "None",
    types.NoneType: "None", dict: "a mapping", type: "the dotted name of a class",
    Callable: "a schedule such as lin_0.001",
}  # fmt: skip


def words(hint: Any) -> str:
    """What an annotation allows, in words."""
    kind, args = typing.get_origin(hint) or hint, typing.get_args(hint)
    if kind in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(words, args)))
    if kind is typing.Literal:
        return " or ".join(map(repr, args))
    if kind is tuple and args and args[-1] is not ...:
        return f"a list of {' and '.join(map(words, args))}"
    if kind in (list, tuple, Sequence):
        return f"a list ({words(args[0])} each)" if args else "a list"
    return _WORDS.get(kind) or str(getattr(hint, "__name__", hint))


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

"""Values as text, read from the syntax tree.

Text comes from command lines, and from files that travel with agents. Nothing here is evaluated,
so reading a value never runs anything.
"""

import ast
from collections.abc import Callable, Mapping
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


def is_data(value: Any) -> bool:
    """Whether a YAML file can hold the value."""
    if isinstance(value, Mapping):
        return all(isinstance(key, str) and is_data(item) for key, item in value.items())
    if isinstance(value, list | tuple):
        return all(map(is_data, value))
    return value is None or isinstance(value, str | bool | int | float)

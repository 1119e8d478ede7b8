"""Values written as text: literals and ``dict(name=value)``, read from the syntax tree.

Text comes from command lines, and from files that travel with agents. Nothing here is evaluated,
so reading a value never runs anything.
"""

import ast
from collections.abc import Callable
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
                return {ast.literal_eval(key): _value(one, named) for key, one in pairs_}
        case ast.List(elts=items):
            return [_value(item, named) for item in items]
        case ast.Tuple(elts=items):
            return tuple(_value(item, named) for item in items)
        case ast.Attribute() if named is not None:
            return named(ast.unparse(node))
        case ast.Constant() | ast.UnaryOp() | ast.BinOp() | ast.Set():
            return ast.literal_eval(node)
    raise ValueError(f"{ast.unparse(node)} is not allowed")


def parse_value(text: str) -> Any:
    """
    The value of ``key:value``: a literal or ``dict(a=1)``; anything else is text as it is.

    So ``cost_limit:25``, ``policy:MlpPolicy``, ``hazards:{'num':4}`` and ``learning_rate:lin_1e-3``
    need no further quotes, and ``policy_kwargs:dict(activation_fn=nn.ReLU)`` stays text until the
    model is made, as it does in a YAML file.
    """
    try:
        return read_expression(text)
    except ValueError:
        return text

"""Code that data names: classes are checked before they are called, strangers need ``--trust``.

Hyper-parameters and flags are data that name code: wrappers, callbacks, policies, modules that
register environments. On a command line, and in a file that it names, that is what the user asks
for. In the files of a run or a grid, which may come from anybody, only classes of this package,
RL-Zoo, Stable-Baselines3 and what they stand on are used; any other needs ``--trust``.
"""

import importlib
import operator
import os
from collections.abc import Iterator, Mapping
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_guard.zoo.usage import UsageError, explained
from sb3_guard.zoo.values import read_expression

KNOWN = {"sb3_guard", "rl_zoo3", "stable_baselines3", "sb3_contrib", "gymnasium", "torch"}
# Files of what differs from an algorithm's own file, which `-conf NAME` reads; not code.
PRESETS = {"paper": "the paper", "omnisafe": "the settings that OmniSafe has published"}
# Hyper-parameters that name classes, one or several, perhaps with arguments; and of what kind.
BASES: dict[str, type] = {
    "env_wrapper": gym.Wrapper, "vec_env_wrapper": VecEnvWrapper, "callback": BaseCallback
}  # fmt: skip


def entries(name: str, value: Any) -> list[tuple[str, dict[str, Any]]]:
    """
    The classes that ``env_wrapper``, ``vec_env_wrapper`` or ``callback`` names.

    :param value: ``module.Class``, ``{module.Class: {argument: value}}``, or a list of such
    :return: dotted names and arguments
    :raises UsageError: it is not of that form
    """
    found: list[tuple[str, dict[str, Any]]] = []
    for one in [] if value is None else value if isinstance(value, list) else [value]:
        path, kwargs = one, None
        if isinstance(one, Mapping) and len(one) == 1:
            path, kwargs = next(iter(one.items()))
        if not isinstance(path, str) or not isinstance(kwargs or {}, Mapping):
            raise UsageError(
                f"hyper-parameter {name}: {one!r} is not allowed; it must be module.Class, or "
                "{module.Class: {argument: value}}"
            )
        found.append((path, dict(kwargs or {})))
    return found


def import_class(name: str, path: str, base: type) -> Any:
    """
    The class of a dotted name, which is checked before anyone calls it.

    :param name: the hyper-parameter, for the message
    :param base: what it must be a subclass of
    :raises UsageError: there is no such class, or it is another kind of thing
    """
    module, _, attribute = path.rpartition(".")
    with explained(f"{name}: there is no class {path!r}"):
        found = getattr(importlib.import_module(module), attribute)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise UsageError(f"{name}: {path!r} is not allowed; it must be a {base.__name__}")
    return found


def classes(name: str, value: Any) -> list[tuple[Any, dict[str, Any]]]:
    """
    What ``env_wrapper``, ``vec_env_wrapper`` or ``callback`` names: classes and their arguments.

    :raises UsageError: one is not there, or not of its kind
    """
    return [(import_class(name, path, BASES[name]), own) for path, own in entries(name, value)]


def torch_class(path: str) -> Any:
    """
    A class or a type of numbers of torch: ``nn.ReLU``, ``th.optim.Adam``, ``th.float32``.

    :raises ValueError: it is anything else
    """
    import torch as th

    root, _, names = path.partition(".")
    try:
        value = operator.attrgetter(names)({"th": th, "torch": th, "nn": th.nn}.get(root))
    except AttributeError as error:
        raise ValueError(f"{path}: {error}") from None
    # torch's modules hold others, such as subprocess: what was found must be torch's own.
    own = isinstance(value, type) and value.__module__.split(".")[0] == "torch"
    if not own and not isinstance(value, th.dtype):
        raise ValueError(f"{path} is not a class of torch")
    return value


def evaluate(name: str, text: str) -> Any:
    """
    The value of a hyper-parameter such as ``dict(activation_fn=nn.ReLU)``.

    :raises UsageError: it is more than literals and classes of torch
    """
    what = f"hyper-parameter {name}: {text!r} can't be evaluated"
    allowed = "allowed: dict(name=value), literals, and classes of torch such as nn.ReLU"
    with explained(what, ValueError, fix=allowed):
        return read_expression(text, torch_class)


def _foreign(args: Mapping[str, Any], values: Mapping[str, Any]) -> Iterator[str]:
    for module in args.get("gym_packages") or []:
        if _in_current_folder(str(module)):
            yield f"gym_packages: {module}"
    envs = args.get("suites") or [args.get("env")]
    for env_id in envs if isinstance(envs, list) else [envs]:
        module, colon, _ = str(env_id or "").partition(":")
        if colon and _in_current_folder(module):
            yield f"env: {env_id}"
    file = args.get("conf_file")
    if file and file not in PRESETS and not str(file).endswith((".yml", ".yaml")):
        yield f"conf_file: {file}"
    for name, value in values.items():
        paths = []
        if name in BASES:
            paths = [path for path, _ in entries(name, value)]
        elif isinstance(value, str) and (name == "policy" or name.endswith("_class")):
            paths = [value] if "." in value else []
        yield from (f"{name}: {one}" for one in paths if one.split(".")[0] not in KNOWN)


def _in_current_folder(module: str) -> bool:
    """Whether a module comes from the current folder; found without importing anything."""
    root = module.split(".")[0]
    return root not in KNOWN and PathFinder.find_spec(root, [os.getcwd()]) is not None


def require_trust(
    where: Path, trusted: bool, args: Mapping[str, Any], values: Mapping[str, Any]
) -> None:
    """
    Refuse files that name code of strangers, before any of it is imported.

    :param where: the folder or file they were read from
    :param trusted: ``--trust`` is given
    :param args: flags that were read there
    :param values: hyper-parameters that were read there
    :raises UsageError: they name other code than that of :data:`KNOWN` packages
    """
    if trusted:
        return
    found = list(_foreign(args, values))
    if found:
        raise UsageError(
            f"{where} names code to run ({'; '.join(found[:3])}); look at it, then add --trust"
        )

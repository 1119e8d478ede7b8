"""The classes that data names: looked up, and checked before anyone calls them.

Hyperparameters name wrappers, callbacks and policies. A module runs code when it is imported, so a
file may name classes of :data:`KNOWN` packages only, and of modules that the command line names
(``--gym-packages``), which are imported by then.
"""

import importlib
import operator
import shlex
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_guard.fields import read_expression
from sb3_guard.zoo.cli.usage import UsageError, explained

if TYPE_CHECKING:
    from sb3_guard.zoo.cli.flags import Command

KNOWN = {"sb3_guard", "rl_zoo3", "stable_baselines3", "sb3_contrib", "gymnasium", "torch"}
PAPER = "paper"  # what `-conf` takes beside files: the paper's table
# Hyperparameters that name classes, one or several, perhaps with arguments; and of what kind.
BASES: dict[str, type] = {
    "env_wrapper": gym.Wrapper, "vec_env_wrapper": VecEnvWrapper, "callback": BaseCallback
}  # fmt: skip
ALLOWED = "allowed: dict(name=value), literals, and classes of torch such as nn.ReLU"
# Flags that name files, folders, modules or a service, which a run's record does not bring back
FOLLOWED = ("gym_packages", "tensorboard_log", "track")


def import_class(name: str, path: str, base: type) -> Any:
    """
    The class of a dotted name, which is checked before anyone calls it.

    :param name: the hyperparameter, for the message
    :param base: what it must be a subclass of
    :raises UsageError: there is no such class, it is another kind of thing, or its module is not
        imported yet and of none of the :data:`KNOWN` packages
    """
    module, _, attribute = path.rpartition(".")
    if module and module.partition(".")[0] not in KNOWN and module not in sys.modules:
        raise UsageError(
            f"{name}: {path!r} is not of {', '.join(sorted(KNOWN))}, nor of a module that the "
            f"command line names; add --gym-packages {module}"
        )
    with explained(f"{name}: there is no class {path!r}"):
        cls = getattr(importlib.import_module(module), attribute)
    if not (isinstance(cls, type) and issubclass(cls, base)):
        raise UsageError(f"{name}: {path!r} is not allowed; it must be a {base.__name__}")
    return cls


def classes(name: str, value: Any) -> list[tuple[Any, dict[str, Any]]]:
    """
    The classes that ``env_wrapper``, ``vec_env_wrapper`` or ``callback`` names.

    :param value: ``module.Class``, ``{module.Class: {argument: value}}``, or a list of such
    :return: classes and their arguments
    :raises UsageError: it is not of that form, or a class is not there, or not of its kind
    """
    result = []
    for entry in [] if value is None else value if isinstance(value, list) else [value]:
        path, arguments = entry, None
        if isinstance(entry, Mapping) and len(entry) == 1:
            path, arguments = next(iter(entry.items()))
        if not isinstance(path, str) or not isinstance(arguments or {}, Mapping):
            raise UsageError(
                f"hyperparameter {name}: {entry!r} is not allowed; it must be module.Class, or "
                "{module.Class: {argument: value}}"
            )
        result.append((import_class(name, path, BASES[name]), dict(arguments or {})))
    return result


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


def as_data(name: str, value: Any) -> Any:
    """
    A hyperparameter as data, of text such as ``dict(activation_fn=nn.ReLU)`` too.

    :return: mappings, lists and literals; classes stay text, see :func:`with_classes`
    :raises UsageError: it is more than literals and names
    """
    if isinstance(value, str) and value.lstrip().startswith(("dict(", "{")):
        with explained(f"hyperparameter {name}: {value!r} can't be evaluated", fix=ALLOWED):
            return read_expression(value)
    return value


def with_classes(name: str, value: Any) -> Any:
    """
    A hyperparameter with the classes of torch that it names, such as ``nn.ReLU``.

    :raises UsageError: torch has no class of a name that begins with ``nn.``, ``th.``, ``torch.``
    """
    if isinstance(value, Mapping):
        return {key: with_classes(name, item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(with_classes(name, item) for item in value)
    if isinstance(value, str) and value.startswith(("nn.", "th.", "torch.")):
        with explained(f"hyperparameter {name}: {value!r} can't be evaluated", fix=ALLOWED):
            return torch_class(value)
    return value


def require_named(where: object, given: "Command", filed: "Command", *names: str) -> None:
    """
    Refuse files and programs that only a file names, before any of them is followed.

    :param where: the folder or file
    :param given: flags of this command line, which replace the file's
    :param filed: those that the file states
    :param names: flags that name files, folders or modules
    :raises UsageError: the file states one of them, and the command line does not
    """
    for name in names:
        value = getattr(filed, name)
        if value and value != PAPER and not getattr(given, name):
            look = ", ".join(value) if isinstance(value, list) else f"its {name}"
            raise UsageError(
                f"{where} needs {name}, which only the command line may name; look at {look}, then "
                f"add {shlex.join(filed.words({name}))}"
            )

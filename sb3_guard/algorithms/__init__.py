"""Safe reinforcement learning as small differences, for any environment that reports a cost."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

#: The class of each algorithm by its key, which is also the name of its module.
CLASSES = {
    "trpo": "TRPO",
    "cpo": "CPO",
    "pcpo": "PCPO",
    "trpo_lag": "TRPOLag",
    "trpo_fac": "TRPOFAC",
    "trpo_ipo": "TRPOIPO",
    "trpo_sl": "TRPOSL",
    "trpo_usl": "TRPOUSL",
    "ppo_lag": "PPOLag",
    "cppo_pid": "CPPOPID",
    "focops": "FOCOPS",
    "cup": "CUP",
    "p3o": "P3O",
    "crpo": "CRPO",
    "rcpo": "RCPO",
    "scpo": "SCPO",
    "sac_lag": "SACLag",
    "td3_lag": "TD3Lag",
    "tqc_lag": "TQCLag",
}
# The module of each public name.
_MODULES = {name: key for key, name in CLASSES.items()} | {
    "Constrained": "common.constrained",
    "CostReplay": "common.replay",
    "CostRollouts": "common.rollouts",
    "FirstOrder": "common.first_order",
    "Lagrangian": "common.lagrangian",
    "TrustRegion": "common.trust_region",
    "hyperparameter": "common.arguments",
}
__all__ = ["ALGORITHMS", "register_algorithm", *_MODULES]

#: The algorithms by the keys that commands and configurations use.
ALGORITHMS: "dict[str, type[BaseAlgorithm]]"


def __getattr__(name: str) -> Any:
    # Importing torch takes seconds, so each class is imported when it is first used.
    if name == "ALGORITHMS":
        value: Any = {key: __getattr__(algorithm) for key, algorithm in CLASSES.items()}
    elif name in _MODULES:
        value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def register_algorithm(key: str, algorithm: "type[BaseAlgorithm]") -> None:
    """Let the commands train, tune and plot an algorithm of yours.

    Tables and figures name it by its ``label`` and draw it by its ``family``. A module that calls
    this is imported by a command with ``--gym-packages MODULE``.

    :param key: its name for ``--algo``: lower-case letters, digits and ``_``
    :param algorithm: any algorithm of Stable-Baselines3; one that inherits from ``Constrained``
        knows of costs, of another they are logged
    :raises ValueError: the key has another form, or names another algorithm already
    :raises TypeError: it is not the class of an algorithm
    """
    from stable_baselines3.common.base_class import BaseAlgorithm

    from sb3_guard.algorithms import ALGORITHMS

    if not key.isidentifier() or key != key.lower():
        raise ValueError(f"key={key!r}: must be lower-case letters, digits and _, such as 'my_ppo'")
    if not (isinstance(algorithm, type) and issubclass(algorithm, BaseAlgorithm)):
        raise TypeError(f"algorithm={algorithm!r}: must be a class derived from SB3's algorithms")
    old = ALGORITHMS.get(key)
    # Imported again, as in a notebook, a class is a new one of the same name.
    ours = key in CLASSES and old is not algorithm
    if old is not None and (ours or old.__qualname__ != algorithm.__qualname__):
        raise ValueError(f"key={key!r} is {old.__name__} already: choose another one")
    ALGORITHMS[key] = algorithm

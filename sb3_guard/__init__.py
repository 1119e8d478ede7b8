"""Safe reinforcement learning for Stable-Baselines3: GUARD's environments and algorithms.

Importing this package registers the environments with Gymnasium; everything else loads when first
used.
"""

import importlib
from typing import Any

from sb3_guard.algorithms import CLASSES

__version__ = "0.1.0"

# module -> the public names that it has
_EXPORTS = {
    "sb3_guard.algorithms": (*CLASSES.values(), "ALGORITHMS", "register_algorithm"),
    "sb3_guard.algorithms.common.warm_start": ("warm_start",),
    "sb3_guard.common.callbacks": ("CostEvalCallback", "LogCosts"),
    "sb3_guard.common.certificate": ("Certificate", "certify"),
    "sb3_guard.common.delivery": ("DeliveryCallback",),
    "sb3_guard.common.evaluation": ("evaluate_policy",),
    "sb3_guard.common.monitor": ("CostMonitor",),
    "sb3_guard.common.native": ("GuardVecEnv",),
    "sb3_guard.common.vec_env": ("make_vec_env",),
    "sb3_guard.deployment.onnx_file": ("export",),
    "sb3_guard.zoo.agents.pretrained": ("load_pretrained",),
    "sb3_guard.zoo.run.make_model": ("make_model",),
    "sb3_guard.envs": (
        "GuardEnv", "GuardVectorEnv", "Scenario", "env_ids", "make", "register",
        "register_constraint", "register_robot", "register_task",
    ),
}  # fmt: skip
_MODULES = {name: module for module, names in _EXPORTS.items() for name in names}
__all__ = ["__version__", *_MODULES]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'sb3_guard' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)


try:
    importlib.import_module("sb3_guard.envs")
except ImportError as error:
    # the algorithms train on any environment, also where MuJoCo is older than the engine needs
    if (error.name or "").split(".")[0] not in {"mujoco", "gymnasium"}:
        raise

"""Safe reinforcement learning for Stable-Baselines3: GUARD's environments and algorithms.

Importing this package registers the environments with Gymnasium; everything else loads when first
used.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

# public name -> the module that has it
_EXPORTS = {
    "CPO": "sb3_guard.algorithms",
    "PCPO": "sb3_guard.algorithms",
    "TRPO": "sb3_guard.algorithms",
    "TRPOFAC": "sb3_guard.algorithms",
    "TRPOIPO": "sb3_guard.algorithms",
    "TRPOLag": "sb3_guard.algorithms",
    "TRPOSL": "sb3_guard.algorithms",
    "TRPOUSL": "sb3_guard.algorithms",
    "PPOLag": "sb3_guard.algorithms",
    "CPPOPID": "sb3_guard.algorithms",
    "FOCOPS": "sb3_guard.algorithms",
    "CUP": "sb3_guard.algorithms",
    "P3O": "sb3_guard.algorithms",
    "CRPO": "sb3_guard.algorithms",
    "RCPO": "sb3_guard.algorithms",
    "SCPO": "sb3_guard.algorithms",
    "SACLag": "sb3_guard.algorithms",
    "TD3Lag": "sb3_guard.algorithms",
    "ALGORITHMS": "sb3_guard.algorithms",
    "register_algorithm": "sb3_guard.algorithms",
    "CostEvalCallback": "sb3_guard.common.callbacks",
    "LogCosts": "sb3_guard.common.callbacks",
    "CostMonitor": "sb3_guard.common.monitor",
    "GuardVecEnv": "sb3_guard.common.vec_env",
    "evaluate_policy": "sb3_guard.common.evaluation",
    "make_vec_env": "sb3_guard.common.vec_env",
    "GuardEnv": "sb3_guard.envs",
    "GuardVectorEnv": "sb3_guard.envs",
    "Scenario": "sb3_guard.envs",
    "env_ids": "sb3_guard.envs",
    "make": "sb3_guard.envs",
    "register": "sb3_guard.envs",
    "register_constraint": "sb3_guard.envs",
    "register_robot": "sb3_guard.envs",
    "register_task": "sb3_guard.envs",
}
__all__ = ["__version__", *_EXPORTS]


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'sb3_guard' has no attribute {name!r}")
    value = getattr(importlib.import_module(_EXPORTS[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_EXPORTS})


try:
    importlib.import_module("sb3_guard.envs")
except ImportError as error:
    # the algorithms train on any environment, also where MuJoCo is older than the engine needs
    if "mujoco" not in str(error) and "gymnasium" not in str(error):
        raise

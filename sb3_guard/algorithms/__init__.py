"""Safe reinforcement learning as small differences, for any environment that reports a cost."""

from importlib import import_module

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.constrained import Constrained
from sb3_guard.algorithms.common.first_order import FirstOrder
from sb3_guard.algorithms.common.lagrangian import Lagrangian
from sb3_guard.algorithms.common.replay import CostReplay
from sb3_guard.algorithms.common.rollouts import CostRollouts
from sb3_guard.algorithms.common.trust_region import TrustRegion
from sb3_guard.algorithms.cpo import CPO
from sb3_guard.algorithms.cppo_pid import CPPOPID
from sb3_guard.algorithms.crpo import CRPO
from sb3_guard.algorithms.cup import CUP
from sb3_guard.algorithms.focops import FOCOPS
from sb3_guard.algorithms.p3o import P3O
from sb3_guard.algorithms.pcpo import PCPO
from sb3_guard.algorithms.ppo_lag import PPOLag
from sb3_guard.algorithms.rcpo import RCPO
from sb3_guard.algorithms.sac_lag import SACLag
from sb3_guard.algorithms.scpo import SCPO
from sb3_guard.algorithms.td3_lag import TD3Lag
from sb3_guard.algorithms.tqc_lag import TQCLag
from sb3_guard.algorithms.trpo import TRPO
from sb3_guard.algorithms.trpo_fac import TRPOFAC
from sb3_guard.algorithms.trpo_ipo import TRPOIPO
from sb3_guard.algorithms.trpo_lag import TRPOLag
from sb3_guard.algorithms.trpo_sl import TRPOSL
from sb3_guard.algorithms.trpo_usl import TRPOUSL

KEYS = (
    "trpo",
    "cpo",
    "pcpo",
    "trpo_lag",
    "trpo_fac",
    "trpo_ipo",
    "trpo_sl",
    "trpo_usl",
    "ppo_lag",
    "cppo_pid",
    "focops",
    "cup",
    "p3o",
    "crpo",
    "rcpo",
    "scpo",
    "sac_lag",
    "td3_lag",
    "tqc_lag",
)

#: The algorithms by the keys that commands and configurations use.
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {}


def register_algorithm(key: str, algorithm: type[BaseAlgorithm]) -> None:
    """Let the commands train, tune and plot an algorithm of yours.

    What tables and figures call it is its ``label``, what it is drawn like its ``family``. A module
    that calls this is imported by a command with ``--gym-packages MODULE``.

    :param key: its name for ``--algo``: lower-case letters, digits and ``_``
    :param algorithm: any algorithm of Stable-Baselines3; one that stands on ``Constrained`` knows
        of costs, of another they are logged
    :raises ValueError: the key has another form, or names another algorithm already
    :raises TypeError: it is not the class of an algorithm
    """
    if not key.isidentifier() or key != key.lower():
        raise ValueError(f"key={key!r}: must be lower-case letters, digits and _, such as 'my_ppo'")
    if not (isinstance(algorithm, type) and issubclass(algorithm, BaseAlgorithm)):
        raise TypeError(f"algorithm={algorithm!r}: must be a class derived from SB3's algorithms")
    old = ALGORITHMS.get(key)
    # Imported again, as in a notebook, a class is a new one of the same name.
    if old is not None and old.__qualname__ != algorithm.__qualname__:
        raise ValueError(f"key={key!r} is {old.__name__} already: choose another one")
    ALGORITHMS[key] = algorithm


def _leaf(key: str) -> type[Constrained]:
    """The class that is defined in the module of that name."""
    module = import_module(f"sb3_guard.algorithms.{key}")
    (leaf,) = (
        one
        for one in vars(module).values()
        if isinstance(one, type)
        and issubclass(one, Constrained)
        and one.__module__ == module.__name__
    )
    return leaf


for _key in KEYS:
    register_algorithm(_key, _leaf(_key))

__all__ = [
    "ALGORITHMS",
    "CPO",
    "CPPOPID",
    "CRPO",
    "CUP",
    "FOCOPS",
    "P3O",
    "PCPO",
    "RCPO",
    "SCPO",
    "TRPO",
    "TRPOFAC",
    "TRPOIPO",
    "TRPOSL",
    "TRPOUSL",
    "Constrained",
    "CostReplay",
    "CostRollouts",
    "FirstOrder",
    "Lagrangian",
    "PPOLag",
    "SACLag",
    "TD3Lag",
    "TQCLag",
    "TRPOLag",
    "TrustRegion",
    "hyperparameter",
    "register_algorithm",
]

"""Safe reinforcement learning as differences from TRPO, for any environment that reports a cost."""

from importlib import import_module

from sb3_guard.algorithms.common.trust_region import TrustRegion
from sb3_guard.algorithms.cpo import CPO
from sb3_guard.algorithms.pcpo import PCPO
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
)


def _leaf(key: str) -> type[TrustRegion]:
    """The class that is defined in the module of that name."""
    module = import_module(f"sb3_guard.algorithms.{key}")
    (leaf,) = (
        one
        for one in vars(module).values()
        if isinstance(one, type)
        and issubclass(one, TrustRegion)
        and one.__module__ == module.__name__
    )
    return leaf


#: The algorithms by the keys that commands and configurations use.
ALGORITHMS: dict[str, type[TrustRegion]] = {key: _leaf(key) for key in KEYS}

__all__ = [
    "ALGORITHMS",
    "CPO",
    "PCPO",
    "TRPO",
    "TRPOFAC",
    "TRPOIPO",
    "TRPOSL",
    "TRPOUSL",
    "TRPOLag",
    "TrustRegion",
]

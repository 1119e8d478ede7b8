"""Safe reinforcement learning as differences from TRPO, for any environment that reports a cost."""

from sb3_guard.algorithms.common.trust_region import TrustRegion
from sb3_guard.algorithms.cpo import CPO
from sb3_guard.algorithms.pcpo import PCPO
from sb3_guard.algorithms.trpo import TRPO
from sb3_guard.algorithms.trpo_fac import TRPOFAC
from sb3_guard.algorithms.trpo_ipo import TRPOIPO
from sb3_guard.algorithms.trpo_lag import TRPOLag
from sb3_guard.algorithms.trpo_sl import TRPOSL
from sb3_guard.algorithms.trpo_usl import TRPOUSL

#: The algorithms by the keys that commands and configurations use.
ALGORITHMS: dict[str, type[TrustRegion]] = {
    "trpo": TRPO,
    "cpo": CPO,
    "pcpo": PCPO,
    "trpo_lag": TRPOLag,
    "trpo_fac": TRPOFAC,
    "trpo_ipo": TRPOIPO,
    "trpo_sl": TRPOSL,
    "trpo_usl": TRPOUSL,
}

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

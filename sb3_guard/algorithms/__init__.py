"""Safe reinforcement learning as differences from TRPO, for any environment that reports a cost."""

from sb3_guard.algorithms.common.trust_region import TrustRegion
from sb3_guard.algorithms.cpo import CPO
from sb3_guard.algorithms.trpo import TRPO

#: The algorithms by the keys that commands and configurations use.
ALGORITHMS: dict[str, type[TrustRegion]] = {"trpo": TRPO, "cpo": CPO}

__all__ = ["ALGORITHMS", "CPO", "TRPO", "TrustRegion"]

"""Tune hyperparameters: ``sb3-guard tune --algo trpo_lag --env Goal_Point_8Hazards``."""

import os
import sys

from sb3_guard.zoo.cli.flags import command
from sb3_guard.zoo.tuning.flags import TuneFlags as Flags


def _tune(flags: Flags) -> int:
    # Read when torch is imported, below.
    os.environ.setdefault("OMP_NUM_THREADS", str(flags.num_threads))

    from sb3_guard.zoo.tuning.search import tune

    return tune(flags)


main = command(Flags, _tune)

if __name__ == "__main__":
    sys.exit(main(None))

"""Train an agent: ``sb3-guard train --algo cpo --env Goal_Point_8Hazards``."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from sb3_guard.zoo.cli.flags import command
from sb3_guard.zoo.run.flags import RunFlags


@dataclass
class Flags(RunFlags):
    """Train an agent, log returns and costs, and keep the best model within the cost limit."""

    prog: ClassVar[str] = "sb3-guard train"
    examples: ClassVar[str] = """examples:
  sb3-guard train --algo cpo --env Goal_Point_8Hazards -n 1e6 --seed 0
  sb3-guard train --algo cpo --env Goal_Point_8Hazards -params cost_limit:5 n_envs:10
  sb3-guard train --env Goal_Point_8Hazards --env-kwargs "hazards:{'num': 4}"
  sb3-guard train -i logs/cpo/Goal_Point_8Hazards-v0_1                   continue a killed run
  sb3-guard train -i logs/cpo/Goal_Point_8Hazards-v0_1 -n 2e6            continue it to 2e6 steps

several seeds: sb3-guard benchmark --algos cpo --envs Goal_Point_8Hazards --seeds 0 1 2
"""


def train(flags: Flags) -> int:
    """Start a run, or continue one."""
    from sb3_guard.zoo.run.folder import CHECKPOINT
    from sb3_guard.zoo.run.run import Run

    path = Path(flags.trained_agent)
    # Any other archive is a model to begin from.
    model = path.suffix == ".zip" and path.name != CHECKPOINT
    return Run.check(flags).start() if model or not flags.trained_agent else Run.resume(flags)


main = command(Flags, train)

if __name__ == "__main__":
    sys.exit(main())

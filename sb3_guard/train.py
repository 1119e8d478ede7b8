"""Train an agent: ``sb3-guard train --algo cpo --env Goal_Point_8Hazards``."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from sb3_guard.zoo.cli.flags import command, flag
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.run.flags import RunFlags


@dataclass
class Flags(RunFlags):
    """
    Train an agent, log returns and costs, and keep the best model within the cost limit.

    What is trained:

    :param seeds: train one run for each of these seeds, in <env>_<seed + 1>, several at once; the
        same command continues with the runs that are not finished

    Running:

    :param jobs: number of runs at once, one process with one thread each (default: number of cores)
    """

    prog: ClassVar[str] = "sb3-guard train"
    examples: ClassVar[str] = """examples:
  sb3-guard train --algo cpo --env Goal_Point_8Hazards -n 1e6 --seed 0
  sb3-guard train --algo cpo --env Goal_Point_8Hazards -params cost_limit:5 n_envs:10
  sb3-guard train --env Goal_Point_8Hazards --env-kwargs "hazards:{'num': 4}"
  sb3-guard train --algo cpo --env Goal_Point_8Hazards --seeds 0 1 2 --jobs 2
  sb3-guard train -i logs/cpo/Goal_Point_8Hazards-v0_1                   continue a killed run
  sb3-guard train -i logs/cpo/Goal_Point_8Hazards-v0_1 -n 2e6            continue it to 2e6 steps
"""
    seeds: list[int] | None = flag(low=0, high=2**32, metavar="K", exclusive="seeds")
    jobs: int | None = flag(low=1, metavar="N")


def train(flags: Flags) -> int:
    """Start a run, continue one, or start one for each of several seeds."""
    flags.check()
    run = RunFlags.shared(flags)
    run.given = flags.given
    if flags.seeds is None:
        if flags.jobs is not None:
            raise UsageError("--jobs goes with several seeds, such as --seeds 0 1 2")

        from sb3_guard.zoo.run.folder import CHECKPOINT
        from sb3_guard.zoo.run.run import Run

        # Any other archive is a model to begin from.
        path = Path(run.trained_agent)
        model = path.suffix == ".zip" and path.name != CHECKPOINT
        new = model or not run.trained_agent
        return Run.check(run).start() if new else Run.resume(run)
    for name, value in (("-i", run.trained_agent), ("--uuid", run.uuid)):
        if value:
            raise UsageError(f"{name} is for a single run; leave it out, or --seeds")

    from sb3_guard.zoo.grids.grid import expand, run_grid, try_out
    from sb3_guard.zoo.run.folder import folder_name

    runs = expand([(run.env, run.algo)], flags.seeds, run)
    try_out(runs)
    stop = f".stop_{run.algo}_{folder_name(run.env)}"  # other grids may be in the same folder
    return run_grid(runs, Path(run.log_folder), flags.jobs, verbose=flags.verbose, stop=stop)


main = command(Flags, train)

if __name__ == "__main__":
    sys.exit(main())

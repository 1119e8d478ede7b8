"""Train a grid, environments × algorithms × seeds: ``sb3-guard benchmark --preset main8``."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from sb3_guard.fields import did_you_mean
from sb3_guard.zoo.cli.flags import command, flag
from sb3_guard.zoo.cli.usage import UsageError, import_packages, read_mapping
from sb3_guard.zoo.run.flags import EvaluationFlags, RunFlags, TrainingFlags

# Flags that no grid file states
HOW = ("grid", "log_folder", "dry_run", "scheduler", "verbose")


@dataclass
class Flags(EvaluationFlags, TrainingFlags):
    """
    Train a grid of environments, algorithms and seeds. Finished runs are skipped, and interrupted
    runs are resumed.

    The grid:

    :param envs: environment ids
    :param preset: grid of the GUARD paper: paper45, main8, q1 … q8, or ladder; replaces --envs
    :param algos: algorithms; all: the paper's eight (default: all, or those of the preset)
    :param seeds: random seeds, one run per seed (default: 0 1)
    :param scale: factor for the length of every run, e.g. 0.1 (default: 1)
    :param grid: YAML file with these flags, e.g. 'envs: [a, b]'

    Files:

    :param log_folder: folder of the grid (default: logs/benchmark)

    Running:

    :param dry_run: list the runs and train nothing
    :param jobs: number of runs at once, one process with one thread each (default: number of cores)
    :param scheduler: address of a Dask scheduler, e.g. tcp://node1:8786, whose workers carry out a
        run each, in place of --jobs (default: this machine); needs the extra sb3-guard[cluster]
    :param verbose: output: 0 errors only, 1 progress (default: 1)
    """

    prog: ClassVar[str] = "sb3-guard benchmark"
    examples: ClassVar[str] = """examples:
  sb3-guard benchmark --envs Goal_Point_8Hazards --algos cpo trpo_lag -n 1e6 --jobs 2
  sb3-guard benchmark --preset main8 --scale 0.1 --dry-run
  sb3-guard benchmark --preset q5 -params cost_limit:25 -f logs/q5
  sb3-guard benchmark --grid my_grid.yml -f logs/mine
  sb3-guard benchmark --preset paper45 --scheduler tcp://node1:8786
"""

    envs: list[str] | None = flag(metavar="ENV", exclusive="what")
    preset: str | None = flag(metavar="NAME", exclusive="what")
    algos: list[str] | None = flag(metavar="ALGO")
    seeds: list[int] = flag(default=[0, 1], low=0, high=2**32, metavar="K")
    scale: float = flag(default=1.0, low=0, ends="()", metavar="X")
    grid: str | None = flag(metavar="FILE")
    log_folder: str = flag("-f", default="logs/benchmark", metavar="DIR")
    dry_run: bool = flag(default=False)
    jobs: int | None = flag(low=1, metavar="N")
    scheduler: str | None = flag(metavar="ADDRESS")
    verbose: Literal[0, 1] = flag(default=1)

    def pairs(self) -> list[tuple[str, str]]:
        """
        The environments and algorithms that are asked for.

        :raises UsageError: nothing says which, or there is no preset of that name
        """
        from sb3_guard.zoo.grids.presets import ALGOS, PRESETS

        if self.preset is None and self.envs is None:
            raise UsageError("which grid? Give --envs, --preset or --grid")
        if self.preset is not None and self.preset not in PRESETS:
            raise UsageError(f"--preset {self.preset}: {did_you_mean(self.preset, PRESETS)}")
        blocks = PRESETS[self.preset] if self.preset else ((self.envs or (), ALGOS),)
        return [
            (env, key)
            for envs, usual in blocks
            for env in envs
            for algo in self.algos or usual
            for key in (ALGOS if algo == "all" else (algo,))
        ]


def with_file(flags: Flags) -> Flags:
    """
    The flags completed by those of the grid file.

    What the command line says wins; of hyperparameters and the like, entry by entry.

    :raises UsageError: the file can't be read, has an unknown entry, or names files or modules that
        the command line does not name
    """
    from sb3_guard.zoo.cli.names import FOLLOWED, require_named

    if flags.grid is None:
        return flags
    path = Path(flags.grid)
    form = "flags to values, such as 'envs: [Goal_Point_8Ghosts]'"
    content = read_mapping(path, "grid file", form)
    filed = Flags.read(content, path, HOW)
    given = {name: getattr(filed, name) for name in filed.given}
    require_named(path, flags, filed, "conf_file", *FOLLOWED)
    for name in flags.given:
        value, old = getattr(flags, name), given.get(name)
        given[name] = {**old, **value} if isinstance(old, dict) else value
    return Flags.of(given)


def benchmark(flags: Flags) -> int:
    """
    Carry out the command.

    :return: exit status, 1 if runs failed
    """
    flags = with_file(flags)
    folder = Path(flags.log_folder)
    if flags.scheduler is not None:
        # Workers have working folders of their own.
        folder = folder.absolute()
        if flags.tensorboard_log:
            flags.tensorboard_log = str(Path(flags.tensorboard_log).absolute())
    of_a_run = RunFlags.shared(flags, log_folder=str(folder), verbose=flags.verbose)

    from sb3_guard.zoo.grids.grid import expand, run_grid, summary

    import_packages(flags.gym_packages)  # which may register algorithms
    runs = expand(flags.pairs(), flags.seeds, of_a_run, flags.scale)
    if flags.dry_run:
        for run in runs:
            print(f"{run.state:<7} {run.path}  {run.steps:,} steps")
        print(f"{summary(runs)}; {sum(run.steps for run in runs):,} steps in all")
        return 0
    for run in {run.flags.env: run for run in runs if run.state != "done"}.values():
        run.try_out()  # of each environment one, so that nothing begins with a wrong name or value
    return run_grid(runs, folder, flags.jobs, flags.scheduler, flags.verbose)


main = command(Flags, benchmark)

if __name__ == "__main__":
    sys.exit(main(None))

"""Train a published run again and compare: ``sb3-guard reproduce ROW``."""

import csv
import hashlib
import json
import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from math import nan
from pathlib import Path
from statistics import fmean
from typing import Any, ClassVar

from sb3_guard.spelling import nearest
from sb3_guard.zoo.cli.flags import Command, command, flag
from sb3_guard.zoo.cli.usage import UsageError

# A row for each run of the grand table, written by scripts/leaderboard.py
ROWS = Path(__file__).parent / "zoo" / "results" / "rows.csv"
MEASURES = {
    "return": "return of the final epoch",
    "cost": "cost of the final epoch",
    "final_return": "return of the final policy, sampled actions",
    "final_cost": "cost of the final policy, sampled actions",
}


@dataclass
class Flags(Command):
    """
    Train a run of the published table, or of a folder, again from its command and seed, and say
    whether it went the same way. The exit status is 0 if all training and final episodes are the
    same.

    :param run: row of the leaderboard, e.g. grand_table/cpo/SafetyPointGoal1-v0_1, or a run folder
    :param log_folder: log folder of the new run (default: logs/reproduced)
    :param gym_packages: modules that the run needs; a program of -conf as the run names it
    """

    prog: ClassVar[str] = "sb3-guard reproduce"
    examples: ClassVar[str] = """examples:
  sb3-guard reproduce grand_table/cpo/SafetyPointGoal1-v0_1
  sb3-guard reproduce logs/cpo/Goal_Point_8Hazards-v0_1
"""

    run: str = flag(default="", positional=True, metavar="ROW|FOLDER")
    log_folder: str = flag("-f", default="logs/reproduced", metavar="DIR")
    gym_packages: list[str] = flag(default=[], metavar="MODULE")


def measures(result: Mapping[str, Any]) -> dict[str, float]:
    """By key of :data:`MEASURES` the numbers of a result; older ones have no final episodes."""
    values = {n: nan if result[n] is None else result[n] for n in ("return", "cost")}
    if played := (result.get("final") or {}).get("stochastic"):
        values |= {f"final_{name}": fmean(played[f"{name}s"]) for name in ("return", "cost")}
    return values


def final_hash(result: Mapping[str, Any]) -> str | None:
    """SHA-256 of the final episodes, from which tiers are made; older results have none."""
    final = result.get("final") or None
    return final and hashlib.sha256(json.dumps(final, sort_keys=True).encode()).hexdigest()


def published(name: str) -> dict[str, Any]:
    """
    ``command``, ``curve``, ``final``, ``commit``, ``seconds`` and :func:`measures` of a run.

    Runs of older versions have neither ``curve`` nor ``final``.

    :param name: of a row of the package's table, or of a run folder
    :raises UsageError: there is neither, or the folder is damaged
    """
    from sb3_guard.zoo.cli.usage import explained
    from sb3_guard.zoo.results.runs import find_runs
    from sb3_guard.zoo.run.folder import RunFolder, is_run

    if is_run(Path(name)):
        run = RunFolder(Path(name))
        result = run.checked_result()
        with explained(f"can't read {run.monitor}", OSError, KeyError, TypeError, ValueError):
            curve = run.curve_hash()
        if result.get("curve") not in (None, curve):
            print(
                f"{run.monitor} is not as the run wrote it (packed logs are rounded): the hash in "
                "result.json is compared."
            )
        with explained(f"{run.result} is damaged"):
            seconds = timedelta(seconds=result.get("seconds") or 0).total_seconds()
            made = {"final": final_hash(result), "seconds": seconds, **measures(result)}
        return result | made | {"command": run.flags().command()}
    with ROWS.open(newline="", encoding="utf-8") as file:
        rows = {row["row"]: row for row in csv.DictReader(file)}
    if name not in rows:
        close = nearest(name, rows)
        hint = f"a row is {next(iter(rows))!r}" if close is None else f"did you mean {close!r}?"
        if below := find_runs(Path(name)):
            hint = f"run folders in it: {', '.join(map(str, below))}"
        raise UsageError(f"{name!r} is no run folder and no row of the leaderboard; {hint}")
    return dict(rows[name])


def differences(row: Mapping[str, Any], result: Mapping[str, Any]) -> list[str]:
    """How a run that was trained again differs from the published one, in lines; none: nothing."""
    hashes = {"training": ("curve", result["curve"]), "final": ("final", final_hash(result))}
    lines = [
        f"Not the same: the {kind} episodes differ."
        for kind, (name, new) in hashes.items()
        if row.get(name) and row[name] != new
    ]
    values = [
        (name, float(row[name]), new)
        for name, new in measures(result).items()
        if row.get(name) not in (None, "")
    ]
    if not row.get("curve") and any(str(before) != str(new) for _, before, new in values):
        lines.append("Not the same: returns or costs differ.")
    return lines and lines + [
        f"  {MEASURES[name]}: before {before:.6g}, now {new:.6g} ({new - before:+.6g})"
        for name, before, new in values
    ]


def reproduce(flags: Flags) -> int:
    """Train the run again and compare."""
    from sb3_guard.zoo.cli.names import is_program, require_named
    from sb3_guard.zoo.run.flags import RunFlags
    from sb3_guard.zoo.run.folder import RunFolder
    from sb3_guard.zoo.run.start import complete, path_of, prepare, standing

    if not flags.run:
        raise UsageError("which run? Give a row of the leaderboard, or a run folder")
    row = published(flags.run)
    run = RunFlags.parse(shlex.split(row["command"])[2:])
    run.log_folder, run.verbose = flags.log_folder, 0
    # The command may come from anyone, so the user has to name the modules that it would import.
    own = run.gym_packages
    require_named(Path(flags.run), flags.gym_packages, own)
    run.gym_packages = flags.gym_packages
    if is_program(program := run.conf_file or ""):
        if program not in flags.gym_packages:
            raise UsageError(
                f"the run has its hyperparameters from a program, {program}; if you trust it: "
                f"--gym-packages {shlex.quote(program)}"
            )
        run.gym_packages = [name for name in flags.gym_packages if name != program or name in own]
    run, values = prepare(run)
    seconds = row.get("seconds")
    took = f", which took {timedelta(seconds=round(float(seconds)))}" if seconds else ""
    steps = f"{values['n_timesteps']:,} steps{took}"
    if path_of(run).resolve() == Path(flags.run).resolve():
        raise UsageError(f"the new run would be in {flags.run} itself: choose another --log-folder")
    print(f"{row['command']}\n{steps}, in {path_of(run)} …", flush=True)
    if standing(run, values) == "done":
        print("This run was trained already; to train it again, remove its folder or change -f.")
    if status := complete(run, values, row["command"], lambda: False):
        print("The same command continues it.")
        return status
    result = RunFolder(path_of(run)).checked_result()
    lines = differences(row, result)
    if result["return"] is None and row.get("curve") == result["curve"]:
        lines = ["No episode has ended: there is nothing to compare."]
    kinds = "training and final" if row.get("final") else "training"
    same = f"The same: all {kinds} episodes agree (curve {result['curve'][:12]}…)."
    if not row.get("curve"):
        same = "The same return and cost; an older version kept no hash of the episodes."
    print("\n".join(lines) or same)
    if (row.get("commit") or None) != result["commit"]:
        print(
            f"The run before is of commit {row.get('commit') or 'unknown'}, the new one of "
            f"{result['commit'] or 'an installed package'}."
        )
    return int(bool(lines))


main = command(Flags, reproduce)

if __name__ == "__main__":
    sys.exit(main(None))

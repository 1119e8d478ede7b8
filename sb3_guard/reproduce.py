"""Train a row of the leaderboard again and compare: ``sb3-guard reproduce ROW``."""

import csv
import hashlib
import json
import math
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, ClassVar

from sb3_guard.fields import nearest
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
SEED = re.compile(r" --seed \d+")


@dataclass
class Flags(Command):
    """
    Train a run of the leaderboard again from its command and seed, and say whether it went the same
    way. The exit status is 0 if all training and final episodes are the same, or, on another
    processor, if return and cost lie where further seeds of the row would.

    :param row: row of the leaderboard, e.g. delivery/cpo/SafetyPointGoal1-v0_3
    :param log_folder: log folder of the new run (default: logs/reproduced)
    """

    prog: ClassVar[str] = "sb3-guard reproduce"
    examples: ClassVar[str] = """examples:
  sb3-guard reproduce delivery/cpo/SafetyPointGoal1-v0_3
"""

    row: str = flag(default="", positional=True, metavar="ROW")
    log_folder: str = flag("-f", default="logs/reproduced", metavar="DIR")


def measures(result: Mapping[str, Any]) -> dict[str, float]:
    """By key of :data:`MEASURES` the numbers of a result."""
    played = result["final"]["stochastic"]
    final = {f"final_{name}": fmean(played[f"{name}s"]) for name in ("return", "cost")}
    return {"return": result["return"], "cost": result["cost"], **final}


def final_hash(result: Mapping[str, Any]) -> str:
    """SHA-256 of the final episodes, from which verdicts are made."""
    return hashlib.sha256(json.dumps(result["final"], sort_keys=True).encode()).hexdigest()


def compare(
    row: Mapping[str, str], result: Mapping[str, Any], seeds: Sequence[Mapping[str, str]]
) -> tuple[bool, list[str]]:
    """
    Whether a run that was trained again is the published one, and in lines what differs.

    A run that rounding led another way could be a further seed of its row: return and cost of its
    final policy lie where 95 % of further seeds would (Student's t on the spread over seeds).

    :param seeds: rows of the same command with any seed; empty: rounding explains nothing
    """
    from scipy.stats import t

    new = {"training": result["curve"], "final": final_hash(result)}
    old = {"training": row["curve"], "final": row["final"]}
    lines = [f"Not the same: the {kind} episodes differ." for kind in new if new[kind] != old[kind]]
    n = len(seeds) if new["training"] != old["training"] else 0
    alike = n > 1
    for name, value in measures(result).items():
        if math.isclose(float(row[name]), value, rel_tol=1e-6, abs_tol=1e-9):
            continue
        line = f"  {MEASURES[name]}: before {float(row[name]):.6g}, now {value:.6g}"
        if n > 1 and name.startswith("final"):
            values = [float(seed[name]) for seed in seeds]
            half = float(t.ppf(0.975, n - 1)) * stdev(values) * math.sqrt(1 + 1 / n)
            alike &= abs(value - fmean(values)) <= half
            line += f"; 95 % of further seeds: {fmean(values):.4g} ± {half:.4g}"
        lines.append(line)
    if n == 1:
        lines.append("Not judged: of one seed nothing tells how far another may differ.")
    elif n:
        lines.append(f"{'Alike' if alike else 'Not alike'}, beside {n} seeds of this row.")
    return alike or not lines, lines


def reproduce(flags: Flags) -> int:
    """Train the run again and compare."""
    from sb3_guard.zoo.run.flags import RunFlags
    from sb3_guard.zoo.run.folder import RunFolder
    from sb3_guard.zoo.run.progress import processor
    from sb3_guard.zoo.run.run import Run

    with ROWS.open(newline="", encoding="utf-8") as file:
        rows = {row["row"]: row for row in csv.DictReader(file)}
    if flags.row not in rows:
        hint = nearest(flags.row, rows) or next(iter(rows))
        raise UsageError(f"the leaderboard has no row {flags.row!r}; did you mean {hint!r}?")
    row = rows[flags.row]
    again = RunFlags.parse(shlex.split(row["command"])[2:])
    again.log_folder, again.verbose = flags.log_folder, 0
    run = Run.check(again)
    here, there = processor(), row["processor"] or "a processor that was not recorded"
    if there != here:
        print(
            f"The run before is of {there}, this is {here}: another processor rounds differently, "
            "and the episodes may be others."
        )
    took, steps = timedelta(seconds=int(row["seconds"])), run.hyperparams["n_timesteps"]
    print(f"{row['command']}\n{steps:,} steps, which took {took}, in {run.path} …")
    if run.standing() == "done":
        print("This run was trained already; to train it again, remove its folder or change -f.")
    if status := run.complete(row["command"]):
        print("The same command continues it.")
        return status
    result = RunFolder(run.path).checked_result()
    other = there != here or row["commit"] != (result["commit"] or "")
    alike = SEED.sub("", row["command"])
    seeds = [one for one in rows.values() if other and SEED.sub("", one["command"]) == alike]
    same, lines = compare(row, result, seeds)
    print("\n".join(lines) or "The same: all training and final episodes agree, and all measures.")
    if row["commit"] != (result["commit"] or ""):
        print(f"The run before is of commit {row['commit']}, the new one of {result['commit']}.")
    return int(not same)


main = command(Flags, reproduce)

if __name__ == "__main__":
    sys.exit(main(None))

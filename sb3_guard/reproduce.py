"""Train a published run again and compare: ``sb3-guard reproduce ROW``."""

import csv
import hashlib
import json
import math
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, ClassVar

from sb3_guard.spelling import nearest
from sb3_guard.zoo.cli.flags import Command, command, flag
from sb3_guard.zoo.cli.usage import UsageError, explained

# A row for each run of the grand table, written by scripts/leaderboard.py
ROWS = Path(__file__).parent / "zoo" / "results" / "rows.csv"
MEASURES = {
    "return": "return of the final epoch",
    "cost": "cost of the final epoch",
    "final_return": "return of the final policy, sampled actions",
    "final_cost": "cost of the final policy, sampled actions",
}
# Entries of a result that say where and how it was made, and the episodes, which have their hashes
MADE = ("command", "seconds", "versions", "commit", "platform", "processor", "curve", "final")
SEED = re.compile(r" --seed \d+")


@dataclass
class Flags(Command):
    """
    Train a run of the published table, or of a folder, again from its command and seed, and say
    whether it went the same way. The exit status is 0 if all training and final episodes are the
    same, or, on another processor, if return and cost lie where further seeds of the row would.

    :param run: row of the leaderboard, e.g. grand_table/cpo/SafetyPointGoal1-v0_3, or a run folder
    :param log_folder: log folder of the new run (default: logs/reproduced)
    :param gym_packages: modules that the run needs
    :param conf_file: file of hyperparameters that the run names
    :param trained_agent: model.zip that the run began with
    """

    prog: ClassVar[str] = "sb3-guard reproduce"
    examples: ClassVar[str] = """examples:
  sb3-guard reproduce grand_table/cpo/SafetyPointGoal1-v0_3
  sb3-guard reproduce logs/cpo/Goal_Point_8Hazards-v0_1
"""

    run: str = flag(default="", positional=True, metavar="ROW|FOLDER")
    log_folder: str = flag("-f", default="logs/reproduced", metavar="DIR")
    gym_packages: list[str] = flag(default=[], metavar="MODULE")
    conf_file: str | None = flag("-conf", metavar="FILE")
    trained_agent: str = flag("-i", default="", metavar="PATH")


def measures(result: Mapping[str, Any]) -> dict[str, float]:
    """By key of :data:`MEASURES` the numbers of a result; older ones have no final episodes."""
    values = {n: math.nan if result[n] is None else result[n] for n in ("return", "cost")}
    if played := (result.get("final") or {}).get("stochastic"):
        values |= {f"final_{name}": fmean(played[f"{name}s"]) for name in ("return", "cost")}
    return values


def final_hash(result: Mapping[str, Any]) -> str | None:
    """SHA-256 of the final episodes, from which tiers are made; older results have none."""
    final = result.get("final") or None
    return final and hashlib.sha256(json.dumps(final, sort_keys=True).encode()).hexdigest()


def unequal(said: Any, got: Any, name: str = "") -> Iterator[str]:
    """What differs in nested mappings, of what ``said`` has: name and both values, in a line."""
    if isinstance(said, Mapping) and isinstance(got, Mapping):
        for key, value in said.items():
            yield from unequal(value, got.get(key), f"{name} {key}".strip())
    elif isinstance(said, float | int) and isinstance(got, float | int):
        both_nan = said != said and got != got
        if not (both_nan or math.isclose(said, got, rel_tol=1e-6, abs_tol=1e-9)):
            yield f"{MEASURES.get(name, name)}: before {said:.6g}, now {got:.6g}"
    elif said != got:
        yield f"{name}: before {said}, now {got}"


def published(name: str) -> dict[str, Any]:
    """
    What a run was and came to: a row of the package's table, or the result of a folder.

    :return: ``command``, ``curve``, ``final`` (hashes), ``commit``, ``processor`` and ``seconds``;
        ``said``, all numbers that are to be the same again; and ``seeds``, :func:`measures` of the
        runs of the same command with any seed
    :raises UsageError: there is neither, or the folder is damaged
    """
    from sb3_guard.zoo.results.runs import find_runs
    from sb3_guard.zoo.run.folder import RunFolder, is_run

    if is_run(Path(name)):
        run = RunFolder(Path(name))
        result, command = run.checked_result(), run.flags().command()
        if not result.get("curve"):
            raise UsageError(f"{run.result} has no hash of the episodes: an older version wrote it")
        with explained(f"{run.result} is damaged"):
            said = {key: value for key, value in result.items() if key not in MADE}
            said |= measures(result)
        others = (RunFolder(path) for path in run.path.parent.glob(f"{run.name}_*") if is_run(path))
        seeds = [
            measures(there)
            for other in others
            if (there := other.read_result())
            and SEED.sub("", other.flags().command()) == SEED.sub("", command)
        ]
        final = final_hash(result)
        return {**result, "command": command, "final": final, "said": said, "seeds": seeds}
    with ROWS.open(newline="", encoding="utf-8") as file:
        rows = {row["row"]: row for row in csv.DictReader(file)}
    if name not in rows:
        hint = f"did you mean {nearest(name, rows) or next(iter(rows))!r}?"
        if below := find_runs(Path(name)):
            hint = f"run folders in it: {', '.join(map(str, below))}"
        raise UsageError(f"{name!r} is no run folder and no row of the leaderboard; {hint}")
    numbers = {
        key: {name: float(row[name]) for name in MEASURES if row.get(name)}
        for key, row in rows.items()
        if SEED.sub("", row["command"]) == SEED.sub("", rows[name]["command"])
    }
    return {**rows[name], "said": numbers[name], "seeds": [*numbers.values()]}


def differences(row: Mapping[str, Any], result: Mapping[str, Any]) -> list[str]:
    """How a run that was trained again differs from the published one, in lines; none: nothing."""
    hashes = {"training": ("curve", result["curve"]), "final": ("final", final_hash(result))}
    lines = [
        f"Not the same: the {kind} episodes differ."
        for kind, (name, new) in hashes.items()
        if row.get(name) and row[name] != new
    ]
    said = row["said"]
    if lines:  # then only what is worth knowing
        said = {name: said[name] for name in MEASURES if name in said}
    numbers = [f"  {line}" for line in unequal(said, {**result, **measures(result)})]
    if numbers and not lines:
        lines = ["Not the same: the episodes agree, but not what is said of them."]
    return lines + numbers


def as_another_seed(
    seeds: Sequence[Mapping[str, float]], new: Mapping[str, float]
) -> tuple[bool, list[str]]:
    """
    Whether a run that rounding led another way could be a further seed of its row.

    :param seeds: :func:`measures` of each
    :param new: those of the new run
    :return: whether return and cost lie where 95 % of further seeds do (Student's t on the spread
        over seeds), of the final policy if all runs have it; and that in lines
    """
    from scipy.stats import t

    if (n := len(seeds)) < 2:
        return False, ["Not judged: of one seed nothing tells how far another may differ."]
    final = all("final_return" in values for values in (*seeds, new))
    lines, within = [], []
    for name in ("final_return", "final_cost") if final else ("return", "cost"):
        values = [values[name] for values in seeds]
        half = float(t.ppf(0.975, n - 1)) * stdev(values) * math.sqrt(1 + 1 / n)
        low, high = fmean(values) - half, fmean(values) + half
        within.append(low <= new[name] <= high)
        where = "within" if within[-1] else "outside"
        lines.append(f"  {MEASURES[name]}: {new[name]:.4g}, {where} [{low:.4g}, {high:.4g}]")
    word = "Alike" if all(within) else "Not alike"
    return all(within), [f"{word}: where 95 % of further seeds beside these {n} would be,", *lines]


def reproduce(flags: Flags) -> int:
    """Train the run again and compare."""
    from sb3_guard.zoo.cli.names import refuse_places, require_named
    from sb3_guard.zoo.run.flags import RunFlags
    from sb3_guard.zoo.run.folder import RunFolder
    from sb3_guard.zoo.run.progress import processor
    from sb3_guard.zoo.run.run import Run

    row = published(flags.run)
    again = RunFlags.parse(shlex.split(row["command"])[2:])
    again.log_folder, again.verbose = flags.log_folder, 0
    # The command may come from anyone: the user names the files and modules that it leads to.
    followed = ("gym_packages", "conf_file", "trained_agent")
    require_named(flags.run, flags, again, *followed)
    refuse_places(flags.run, again.hyperparams or {})
    for name in followed:
        setattr(again, name, getattr(flags, name) or getattr(again, name))
    run = Run.check(again)
    if run.path.resolve() == Path(flags.run).resolve():
        raise UsageError(f"the new run would be in {flags.run} itself: choose another --log-folder")
    here, there = processor(), row.get("processor") or "a processor that was not recorded"
    if there != here:
        print(
            f"The run before is of {there}, this is {here}: another processor rounds differently, "
            "and the episodes may be others."
        )
    took = timedelta(seconds=round(float(row.get("seconds") or 0)))
    print(f"{row['command']}\n{run.setup.n_timesteps:,} steps, which took {took}, in {run.path} …")
    if run.standing() == "done":
        print("This run was trained already; to train it again, remove its folder or change -f.")
    if status := run.complete(row["command"]):
        print("The same command continues it.")
        return status
    result = RunFolder(run.path).checked_result()
    lines = differences(row, result)
    if result["return"] is None and row.get("curve") == result["curve"]:
        lines = ["No episode has ended: there is nothing to compare."]
    same = not lines
    if there != here and row["curve"] != result["curve"]:
        same, judged = as_another_seed(row["seeds"], measures(result))
        lines += judged
    kinds = "training and final" if row.get("final") else "training"
    print("\n".join(lines) or f"The same: all {kinds} episodes agree, and all measures.")
    if (row.get("commit") or None) != result["commit"]:
        print(
            f"The run before is of commit {row.get('commit')}, the new one of {result['commit']}."
        )
    return int(not same)


main = command(Flags, reproduce)

if __name__ == "__main__":
    sys.exit(main(None))

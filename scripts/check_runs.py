"""Check runs that are to be sent in for the leaderboard: ``python scripts/check_runs.py FOLDER``.

The script prints the faults of each run of the folder. With ``--pack NAME`` it packs a folder
without faults as ``docs/data/sent_NAME.tar.xz``.
"""

import argparse
import csv
import re
from collections.abc import Iterator, Mapping
from math import isfinite
from pathlib import Path
from typing import Any

import pandas as pd
from archives import DATA, pack
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_guard.envs.suites import SUITES
from sb3_guard.reproduce import ROWS, faults
from sb3_guard.zoo.cli.names import PRESETS
from sb3_guard.zoo.cli.usage import UsageError, one_line
from sb3_guard.zoo.results.curves import read_episodes
from sb3_guard.zoo.results.runs import find_runs, label_of, read_run
from sb3_guard.zoo.results.splits import FINAL
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.folder import EPOCH, RunFolder
from sb3_guard.zoo.run.run import FINAL_EPISODES

MILLION = 1_000_000
BUDGETS = (1, 2, 10)  # millions of steps
SEEDS = 3  # from which on a certified row has a place
ENVIRONMENTS = {env_id for suite in SUITES.values() for env_id in suite.scenarios}
# Keys of config.yml that change the task, and flags in args.yml that change what is run.
TASK = ("env_kwargs", "env_wrapper", "vec_env_wrapper", "callback", "cost_keys", "monitor_kwargs")
FLAGS = {
    "gym_packages": "modules that are not the package's",
    "trained_agent": "an agent that was trained before",
    "eval_env_kwargs": "final episodes in another environment",
}


def limit_of(env_id: str) -> float:
    """The cost limit that the rows of an environment are judged by."""
    return 25.0 if env_id.startswith("Safety") else 2.0


def problems(path: Path) -> Iterator[str]:
    """What is wrong with a run."""
    run = RunFolder(path)
    result, config = run.checked_result(), run.hyperparams()
    for name in ("command", "curve", "final", "seconds", "versions", "processor"):
        if result.get(name) in (None, ""):
            yield f"result.json has no {name}: train it with this version"
    if result.get("curve") != run.curve_hash():
        yield "curve in result.json is not the hash of 0.monitor.csv (packed logs are rounded)"
    with ROWS.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            same = row["row"].split("/")[1] == run.path.resolve().parent.name
            if same and row["curve"] == result.get("curve"):
                yield f"it has the episodes of {row['row']}"
    yield from faults(run)
    if "command" in result and result["command"] != run.flags().command():
        yield "command in result.json is not that of args.yml"
    if result.get("learned"):
        yield "it went on after it had finished: a run of that length from the start may be another"
    if str(result.get("commit")).endswith("-dirty"):
        yield "it was trained with changes that are not committed"
    yield from _wrong_flags(run, result)
    for name in TASK:
        if config.get(name):
            yield f"config.yml has {name}: {config[name]}, which changes the task"
    yield from _wrong_limit(run, result, config)
    yield from _wrong_length(run, result, config)
    for split in FINAL:
        played = (result.get("final") or {}).get(split, {})
        values = [played.get(key, []) for key in ("returns", "costs", "lengths")]
        counts = sorted({len(numbers) for numbers in values})
        if counts != [FINAL_EPISODES]:
            there = " or ".join(map(str, counts))
            yield f"final {split} has {there} episodes, not {FINAL_EPISODES}"
        elif not all(isinstance(v, int | float) and isfinite(v) for n in values for v in n):
            yield f"final {split} has values that are no finite numbers"
        elif min(values[1]) < 0 or min(values[2]) < 1:
            yield f"final {split} has negative costs, or lengths below 1"


def _wrong_flags(run: RunFolder, result: Mapping[str, Any]) -> Iterator[str]:
    """Flags that are not those of the folder and the result, or that change what is run."""
    args = run.args()
    for name, named in (("algo", run.path.resolve().parent.name), ("env", run.name)):
        if not named == args[name] == result.get(name, named):
            names = f"{args[name]} in args.yml, {result.get(name)} in result.json"
            yield f"{name} is {names}, {named} by the folder's name"
    if result.get("label") not in (None, label_of(args["algo"])):
        yield f"label is {result['label']!r}, not {label_of(args['algo'])!r}"
    if run.name not in ENVIRONMENTS:
        yield f"{run.name} is no environment of `sb3-guard list`"
    for name, what in FLAGS.items():
        if args.get(name):
            yield f"args.yml has {name}: {args[name]}, {what}"
    if args.get("conf_file") not in (None, *PRESETS):
        allowed = ", ".join(PRESETS)
        yield f"args.yml has conf_file: {args['conf_file']}, which others lack; allowed: {allowed}"


def _wrong_limit(
    run: RunFolder, result: Mapping[str, Any], config: Mapping[str, Any]
) -> Iterator[str]:
    """Another cost limit than the rows of the environment have, or one on something else."""
    limit = limit_of(run.name)
    if not getattr(algorithm(run.args()["algo"]), "constrained", False):
        if result.get("cost_limit") is not None:
            yield f"cost_limit is {result['cost_limit']} in result.json, but there is none"
        return
    for name, of in (("config.yml", config), ("result.json", result)):
        if of.get("cost_limit") != limit:
            yield f"cost_limit is {of.get('cost_limit')} in {name}, not {limit}"
    if "limit_on" in result:
        yield "its limit is on an episode's worst step, the page's on the sum"
    if result.get("cut"):
        yield "episodes of the training were cut"


def _wrong_length(
    run: RunFolder, result: Mapping[str, Any], config: Mapping[str, Any]
) -> Iterator[str]:
    """Lengths that the page does not have, or that differ from one another."""
    asked, done = config["n_timesteps"], result["n_timesteps"]
    if asked not in [MILLION * budget for budget in BUDGETS]:
        yield f"n_timesteps is {asked:,}; allowed: {', '.join(map(str, BUDGETS))} million"
    if not asked <= done <= 1.05 * asked:
        yield f"result.json has {done:,} steps of {asked:,}"
    episodes = read_episodes(run.path)
    steps, longest = int(episodes["step"].iloc[-1]), int(episodes["step"].diff().max())
    if not 0 <= done - steps <= config["n_envs"] * longest:
        yield f"0.monitor.csv has {steps:,} steps of {done:,}"
    yield from _wrong_epoch(run, result, config, episodes)


def _wrong_epoch(
    run: RunFolder, result: Mapping[str, Any], config: Mapping[str, Any], episodes: pd.DataFrame
) -> Iterator[str]:
    """
    A number of final episodes, or a cost rate, that no run with these episodes can have.

    Episodes are in the order of their ends. The log does not have those that did not end, nor the
    step of an end: it lies at most the steps of the other environments' open episodes after the sum
    of lengths so far.
    """
    done, envs = result["n_timesteps"], config["n_envs"]
    off_policy = issubclass(algorithm(run.args()["algo"]), OffPolicyAlgorithm)
    epoch = EPOCH if off_policy else envs * config.get("n_steps", 2048)
    open_steps = (envs - 1) * episodes["step"].diff().max()
    least, most = ((episodes["step"] + late > done - epoch).sum() for late in (0, open_steps))
    if not least <= result["episodes"] <= most:
        there = result["episodes"]
        yield f"{there} episodes ended in the final epoch by result.json, {least} to {most} in fact"
    total, ended = result["cost_rate"] * done, episodes["M_c"].sum()
    if not 0.999999 * ended <= total <= 1.000001 * ended + envs * episodes["M_c"].max():
        yield f"cost_rate is {result['cost_rate']}, by the episodes about {ended / done:.6g}"


def problems_together(runs: pd.DataFrame) -> Iterator[str]:
    """What is wrong with the seeds of a row, of runs that can be read."""
    for (algo, suite), group in runs.groupby(["algo", "suite"]):
        if group[["config", "steps"]].drop_duplicates().shape[0] > 1:
            yield f"{algo} on {suite}: the seeds differ in length or in hyperparameters"
    for _, group in runs.groupby("curve"):
        if group["seed"].nunique() > 1:
            yield f"the same episodes under several seeds: {', '.join(group['path'])}"


def check(folder: Path) -> bool:
    """
    Print what is wrong with the runs of a folder.

    :return: whether there are runs, and nothing is wrong
    """
    paths, runs, fine = find_runs(folder), [], True
    for path in paths:
        try:
            found = [*problems(path)]
            runs.append(read_run(path) | {"curve": RunFolder(path).curve_hash()})
        except (UsageError, OSError, AttributeError, KeyError, ValueError, TypeError) as error:
            found = [one_line(error)]
        fine = fine and not found
        print(f"{path}: {'; '.join(found) or 'fine'}")
    if not paths:
        print(f"no finished run in {folder}")
    if runs:
        table = pd.DataFrame(runs)
        for problem in problems_together(table):
            fine = False
            print(problem)
        for (algo, suite), seeds in table.groupby(["algo", "suite"])["seed"].nunique().items():
            if seeds < SEEDS:
                print(f"{algo} on {suite}: {seeds} of the {SEEDS} seeds that a place needs")
    return fine and bool(paths)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="log folder, or a run")
    parser.add_argument("--pack", metavar="NAME", help="pack the folder if nothing is wrong")
    args = parser.parse_args()
    if args.pack is not None:
        if any(Path(path).parents[1] != args.folder for path in find_runs(args.folder)):
            parser.error("--pack needs a log folder, which has a folder per algorithm")
        if not re.fullmatch(r"\w+", args.pack):
            parser.error(f"--pack takes letters, digits and _, not {args.pack!r}")
        if (DATA / f"sent_{args.pack}.tar.xz").exists():
            parser.error(f"docs/data has sent_{args.pack}.tar.xz; choose another name")
    if not check(args.folder):
        raise SystemExit(1)
    if args.pack:
        pack(args.folder, f"sent_{args.pack}")


if __name__ == "__main__":
    main()

"""Train algorithms on problems whose constrained optimum is known, and say how close they come.

``python scripts/known_optima.py --algos cpo trpo_lag --seeds 11 12`` uses the defaults of every
algorithm: nothing is set but the limit, and the problem's number of steps and environments. Every
run becomes a line of ``docs/data/known_optima.csv`` as soon as it has ended, is not repeated, and
goes into the tables of ``docs/notes/known_optima.md``. ``--seeds`` without a number only writes
that page. Algorithms whose defaults or updates of ``bandit`` have changed since their lines were
written, by ``known_optima.json``, are refused until ``--drop-stale`` has removed these lines; where
the runs are the same (an argument is new), enter the new value in that file instead. The script
does not notice changes of the code.

Return is a share of the constrained optimum and costs are shares of their limits, over the last
fifth of the training, by the policy that explores; ± is the standard error over seeds.
``--scale 100 0.01`` multiplies costs and limits.
"""

import argparse
import csv
import inspect
import itertools
import json
import os
import sys
import time
from collections.abc import Collection, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # one thread per process; read by torch's import

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

import numpy as np
import torch
from gymnasium import spaces
from known_optima import Outcome, budget, problems, solve

from sb3_guard.algorithms import ALGORITHMS, CostReplay
from sb3_guard.algorithms.common.filtering import FilteredTrustRegion

Run = tuple[str, str, float, int]  # problem, algorithm, scale, seed
DOCS = Path(__file__).parents[1] / "docs"
RESULTS, PAGE = DOCS / "data" / "known_optima.csv", DOCS / "notes" / "known_optima.md"
SETTINGS = RESULTS.with_suffix(".json")  # of each algorithm, the defaults that its lines are of
NO_EFFECT = ("verbose", "device", "seed", "tensorboard_log", "stats_window_size")
MARKS = "<!-- known optima: begin -->", "<!-- known optima: end -->"
#: A limit that is not one of an episode's mean cost, and whose it is.
STATEWISE = {
    "contexts": ("trpo_fac", "trpo_sl", "trpo_usl"),
    "wall": ("scpo", "trpo_sl", "trpo_usl"),
}
#: Problems with a limit of 0, and who is tried on them.
ZERO = {"brink": ("cpo", "pcpo", "trpo_lag", "trpo_ipo", "trpo_fac", "trpo_sl", "trpo_usl")}
KEPT = 0.8  # share of the optimum that those need that act within a limit
NONE = 0.05  # at a limit of 0: share of what the unconstrained optimum costs


def fits(algo: str, name: str) -> bool:
    """Whether an algorithm is meant for a problem."""
    cls, problem = ALGORITHMS[algo], problems()[name]
    box = isinstance(problem.world().action_space, spaces.Box)
    chosen = {**STATEWISE, **ZERO}
    if name in chosen:
        return algo in chosen[name]
    if issubclass(cls, FilteredTrustRegion) or algo in ("trpo", "scpo"):
        return False
    return box or not issubclass(cls, CostReplay)


def train(run: Run) -> tuple[Run, Outcome, float]:
    torch.set_num_threads(1)
    name, algo, scale, seed = run
    cls, began = ALGORITHMS[algo], time.process_time()
    outcome = solve(cls, budget(cls, problems()[name]), seed, scale)
    return run, outcome, time.process_time() - began


def read() -> dict[Run, Outcome]:
    """What has been measured."""
    results: dict[Run, Outcome] = {}
    with RESULTS.open() as file:
        for row in csv.DictReader(file):
            run = row["problem"], row["algorithm"], float(row["scale"]), int(row["seed"])
            costs = np.array([float(cost) for cost in row["costs"].split()])
            results[run] = Outcome(float(row["return"]), costs)
    return results


def settings() -> str:
    """JSON, a line per algorithm: the default of every argument, and the updates of a problem."""
    lines = []
    for algo, cls in ALGORITHMS.items():
        arguments = inspect.signature(cls).parameters.values()
        values = {
            each.name: repr(each.default)
            for each in arguments
            if each.default is not each.empty and each.name not in NO_EFFECT
        }
        values["updates of bandit"] = repr(budget(cls, problems()["bandit"]).updates)
        lines.append(f'"{algo}": ' + json.dumps(values))
    return "{\n" + ",\n".join(lines) + "\n}\n"


def stale() -> dict[str, list[str]]:
    """Algorithms with lines of other settings than today's, and which settings differ."""
    recorded, current = (json.loads(text) for text in (SETTINGS.read_text(), settings()))
    differing = {}
    for algo in sorted({run[1] for run in read()}):
        before, today = recorded.get(algo, {}), current.get(algo, {})
        names = [name for name in {**before, **today} if before.get(name) != today.get(name)]
        if names:
            differing[algo] = names
    return differing


def drop(algos: Collection[str]) -> None:
    """Remove the lines of algorithms."""
    lines = RESULTS.read_text().splitlines(keepends=True)
    RESULTS.write_text("".join(line for line in lines if line.split(",")[1] not in algos))


def keep(run: Run, outcome: Outcome, seconds: float) -> None:
    """A line more."""
    name, algo, scale, seed = run
    costs = " ".join(f"{cost:.4f}" for cost in outcome.cost)
    values = [name, algo, f"{scale:g}", seed, f"{outcome.value:.4f}", costs, f"{seconds:.0f}"]
    with RESULTS.open("a", newline="") as file:
        csv.writer(file, lineterminator="\n").writerow(values)


def passes(outcome: Outcome, algo: str, name: str) -> bool:
    """Whether that solves a problem."""
    if name in ZERO:
        return outcome.value >= 0.9 and outcome.cost.max() <= NONE
    if issubclass(ALGORITHMS[algo], FilteredTrustRegion):
        return outcome.value >= KEPT and outcome.cost.max() <= 1.0
    return outcome.good


def mean_of(outcomes: Sequence[Outcome]) -> Outcome:
    """Their mean return and costs."""
    value = float(np.mean([each.value for each in outcomes]))
    return Outcome(value, np.mean([each.cost for each in outcomes], axis=0))


def cell(outcomes: Sequence[Outcome], algo: str, name: str) -> str:
    """Mean ± standard error of return and costs over seeds, and whether the mean passes."""
    n = len(outcomes)

    def mean(values: np.ndarray) -> str:
        error = f"{values.std(ddof=1) / np.sqrt(n):.2f}" if n > 1 else "0.00"
        return f"{values.mean():.2f}" + ("" if error == "0.00" else f" ± {error}")

    values = np.array([each.value for each in outcomes])
    costs = np.array([each.cost for each in outcomes])  # [seeds, m]
    good = passes(mean_of(outcomes), algo, name)
    shown = ", ".join(mean(column) for column in costs.T)
    return f"{mean(values)}; {shown}{' ✓' if good else ''} ({n})"


def tables(results: dict[Run, Outcome]) -> str:
    """Markdown: a row per algorithm, a column per problem, costs × 1."""
    cells = {
        (algo, name): [value for run, value in results.items() if run[:3] == (name, algo, 1.0)]
        for algo, name in itertools.product(ALGORITHMS, problems())
    }
    names = [name for name in problems() if any(cells[algo, name] for algo in ALGORITHMS)]
    lines = ["| | " + " | ".join(names) + " |", "|" + "---|" * (len(names) + 1)]
    for algo in ALGORITHMS:
        row = {name: cells[algo, name] for name in names}
        if any(row.values()):
            shown = (
                cell(outcomes, algo, name) if outcomes else "" for name, outcomes in row.items()
            )
            lines.append(f"| `{algo}` | " + " | ".join(shown) + " |")
    return "\n".join(lines)


def failing(results: dict[Run, Outcome]) -> str:
    """Markdown: the single seeds that fail where the mean over several passes, costs × 1."""
    cells: dict[tuple[str, str], dict[int, Outcome]] = {}
    for (name, algo, scale, seed), outcome in results.items():
        if scale == 1.0:
            cells.setdefault((algo, name), {})[seed] = outcome
    lines = []
    for (algo, name), outcomes in sorted(cells.items()):
        failed = {seed: each for seed, each in outcomes.items() if not passes(each, algo, name)}
        if failed and passes(mean_of([*outcomes.values()]), algo, name):
            shown = (
                f"seed {seed}: {cell([each], algo, name).removesuffix(' (1)')}"
                for seed, each in failed.items()
            )
            lines.append(f"* `{algo}` on `{name}`: {', '.join(shown)}")
    return "\n".join(lines)


def pages() -> dict[Path, str]:
    """The page as the results make it."""
    before, _, rest = PAGE.read_text().partition(MARKS[0])
    _, end, after = rest.partition(MARKS[1])
    if not end:
        raise SystemExit(f"{PAGE} has no lines {MARKS[0]} and {MARKS[1]} for the tables")
    results = read()
    failed = f"Single seeds that fail where the mean passes:\n\n{failing(results)}"
    page = f"{before}{MARKS[0]}\n{tables(results)}\n\n{failed}\n{MARKS[1]}{after}"
    return {PAGE: page, SETTINGS: settings()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--algos", nargs="+", choices=list(ALGORITHMS), default=list(ALGORITHMS))
    parser.add_argument("--problems", nargs="+", choices=list(problems()), default=list(problems()))
    parser.add_argument("--seeds", nargs="*", type=int, default=[11, 12, 13, 14, 15])
    parser.add_argument("--scale", nargs="+", type=float, default=[1.0])
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--drop-stale", action="store_true", help="remove lines of other defaults")
    arguments = parser.parse_args()

    if others := stale():
        for algo, names in others.items():
            print(f"{algo}: changed since its lines were written: {', '.join(names)}")
        if not arguments.drop_stale:
            raise SystemExit(f"--drop-stale removes these lines; or edit {SETTINGS.name}")
        drop(others)
        SETTINGS.write_text(settings())
    results = read()
    # A seed of everything before the next one: a table that is cut short is even.
    wanted = [
        (name, algo, scale, seed)
        for seed, scale, name, algo in itertools.product(
            arguments.seeds, arguments.scale, arguments.problems, arguments.algos
        )
        if fits(algo, name) and (name, algo, scale, seed) not in results
    ]
    pool = ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn"))
    with pool:
        if arguments.workers == 1:
            done = map(train, wanted)
        else:
            done = (each.result() for each in as_completed([pool.submit(train, r) for r in wanted]))
        for run, outcome, seconds in done:
            keep(run, outcome, seconds)
            print(
                *run, f"{outcome.value:.3f}", outcome.cost.round(3), f"{seconds:.0f} s", flush=True
            )
    for path, text in pages().items():
        path.write_text(text)


if __name__ == "__main__":
    main()

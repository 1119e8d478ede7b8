"""Train algorithms on problems whose constrained optimum is known, and say how close they come.

``python scripts/known_optima.py --algos cpo trpo_lag --seeds 11 12`` uses the defaults of every
algorithm: nothing is set but the limit, and the problem's number of steps and environments. Every
run becomes a line of ``docs/data/known_optima.csv`` as soon as it has ended, is not repeated, and
goes into the tables of ``lab/known_optima.md``. ``--seeds`` without a number only writes
that page. After a change of defaults or code, remove the algorithm's lines first.

Return is a share of the constrained optimum and costs are shares of their limits, over the last
fifth of the training, by the policy that explores.
``--scale 100 0.01`` multiplies costs and limits.
"""

import argparse
import csv
import itertools
import os
import sys
import time
from collections.abc import Sequence
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
RESULTS, PAGE = DOCS / "data" / "known_optima.csv", DOCS.parent / "lab" / "known_optima.md"
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
    """Whether the mean over seeds passes, else its return and costs; how many seeds do."""
    mean = mean_of(outcomes)
    if not passes(mean, algo, name):
        return f"{mean.value:.2f}; {', '.join(f'{cost:.2f}' for cost in mean.cost)}"
    good = sum(passes(outcome, algo, name) for outcome in outcomes)
    return "✓" if good == len(outcomes) else f"✓ {good}/{len(outcomes)}"


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


def pages() -> dict[Path, str]:
    """The page as the results make it."""
    before, _, rest = PAGE.read_text().partition(MARKS[0])
    _, end, after = rest.partition(MARKS[1])
    if not end:
        raise SystemExit(f"{PAGE} has no lines {MARKS[0]} and {MARKS[1]} for the tables")
    return {PAGE: f"{before}{MARKS[0]}\n{tables(read())}\n{MARKS[1]}{after}"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--algos", nargs="+", choices=list(ALGORITHMS), default=list(ALGORITHMS))
    parser.add_argument("--problems", nargs="+", choices=list(problems()), default=list(problems()))
    parser.add_argument("--seeds", nargs="*", type=int, default=[11, 12, 13, 14, 15])
    parser.add_argument("--scale", nargs="+", type=float, default=[1.0])
    parser.add_argument("--workers", type=int, default=1, help="processes")
    arguments = parser.parse_args()

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

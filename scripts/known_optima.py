"""Train algorithms on problems whose constrained optimum is known, and print how close they come.

``python scripts/known_optima.py --algos cpo trpo_lag --seeds 0 1 2`` uses the defaults of every
algorithm: nothing is set but the limit, and the problem's number of steps and environments. Return
is given as a share of the constrained optimum and costs as shares of their limits, over the last
fifth of the training, by the policy that explores; ± is the standard error over seeds. An algorithm
passes with at least 90 % of the optimum and costs between 0.85 and 1.05 of a limit that binds.
``--scale 1 100 0.01`` multiplies costs and limits; ``--write docs/known_optima.md`` puts the table
between the page's marks.
"""

import argparse
import itertools
import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # one thread per process; read by torch's import

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
import torch
from known_optima import EPISODE, Outcome, problems, solve

from sb3_guard.algorithms import ALGORITHMS

Run = tuple[str, str, float, int]  # problem, algorithm, scale, seed
MARKS = "<!-- known optima: begin -->", "<!-- known optima: end -->"


def train(run: Run) -> tuple[Run, Outcome]:
    torch.set_num_threads(1)
    name, algo, scale, seed = run
    return run, solve(ALGORITHMS[algo], problems()[name], seed, scale)


def cell(outcomes: Sequence[Outcome]) -> str:
    """Mean ± standard error of return and costs over seeds, and whether the mean passes."""

    def mean(values: np.ndarray) -> str:
        error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
        return f"{values.mean():.2f} ± {error:.2f}"

    values = np.array([each.value for each in outcomes])
    costs = np.array([each.cost for each in outcomes])  # [seeds, m]
    good = Outcome(values.mean(), costs.mean(axis=0)).good
    shown = ", ".join(mean(column) for column in costs.T)
    return f"{mean(values)}; {shown}{' ✓' if good else ''}"


def table(results: dict[Run, Outcome], names: Sequence[str], algos: Sequence[str]) -> str:
    """Markdown: a row per problem and scale, a column per algorithm."""
    lines = ["| problem | " + " | ".join(algos) + " |", "|" + "---|" * (len(algos) + 1)]
    for scale, name in itertools.product(sorted({run[2] for run in results}), names):
        row = [
            [value for run, value in results.items() if run[:3] == (name, algo, scale)]
            for algo in algos
        ]
        label = name if scale == 1 else f"{name}, costs × {scale:g}"
        lines.append(
            f"| {label} | " + " | ".join(cell(each) if each else "" for each in row) + " |"
        )
    return "\n".join(lines)


def write(path: Path, text: str) -> None:
    before, _, rest = path.read_text().partition(MARKS[0])
    _, end, after = rest.partition(MARKS[1])
    if not end:
        raise SystemExit(
            f"{path} has no lines {MARKS[0]} and {MARKS[1]} for the table to go between"
        )
    path.write_text(f"{before}{MARKS[0]}\n{text}\n{MARKS[1]}{after}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--algos", nargs="+", choices=list(ALGORITHMS), default=["cpo", "trpo_lag"])
    parser.add_argument("--problems", nargs="+", choices=list(problems()), default=list(EPISODE))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--scale", nargs="+", type=float, default=[1.0])
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--write", type=Path, metavar="PAGE", help="put the table into a page")
    parser.add_argument(
        "--results", type=Path, metavar="JSON", help="keep every run there, and skip those it has"
    )
    arguments = parser.parse_args()

    results: dict[Run, Outcome] = {}
    if arguments.results and arguments.results.exists():
        for *run, value, cost in json.loads(arguments.results.read_text()):
            results[tuple(run)] = Outcome(value, np.array(cost))  # type: ignore[index]
    wanted = list(
        itertools.product(arguments.problems, arguments.algos, arguments.scale, arguments.seeds)
    )
    with ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(train, run) for run in wanted if run not in results]
        for future in as_completed(futures):
            run, outcome = future.result()
            results[run] = outcome
            print(*run, f"{outcome.value:.3f}", outcome.cost.round(3), file=sys.stderr, flush=True)
            if arguments.results:
                kept = [[*run, each.value, each.cost.tolist()] for run, each in results.items()]
                arguments.results.write_text(json.dumps(kept))
    results = {run: outcome for run, outcome in results.items() if run in wanted}
    text = table(results, arguments.problems, arguments.algos)
    print(text)
    if arguments.write:
        write(arguments.write, text)


if __name__ == "__main__":
    main()

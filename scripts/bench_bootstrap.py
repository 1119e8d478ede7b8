"""Measure whether costs at time limits should be bootstrapped: the table of ``docs/concepts.md``.

``python scripts/bench_bootstrap.py --seeds 61 62 63`` trains CPO and TRPO-Lagrangian on the known
optima whose episodes are cut, with their defaults but ``cost_gamma``, with and without
:math:`\\gamma V_C` of the last observation, and prints return as a share of the optimum and cost as
a share of the limit: means over seeds and their standard errors, over the last fifth of a training.
"""

import argparse
import itertools
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # one thread per process; read by torch's import

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import numpy as np
import torch
from known_optima import budget, problems, solve

from sb3_guard.algorithms import CPO, TRPOLag

Case = tuple[str, float, type, bool]  # problem, cost_gamma, algorithm, bootstrapped


class Unbootstrapped:
    """A time limit ends the cost of an episode."""

    def value_rollout(self) -> None:
        kept, self._timeouts = self._timeouts, []
        super().value_rollout()
        self._timeouts = kept


class CPOAlone(Unbootstrapped, CPO):
    pass


class TRPOLagAlone(Unbootstrapped, TRPOLag):
    pass


ALONE = {CPO: CPOAlone, TRPOLag: TRPOLagAlone}


def train(case: Case, seed: int) -> tuple[float, float]:
    """Return and cost, as shares of what is best and of the limit."""
    torch.set_num_threads(1)
    name, gamma, cls, bootstrapped = case
    cls = cls if bootstrapped else ALONE[cls]
    outcome = solve(cls, budget(cls, problems()[name]), seed, cost_gamma=gamma)
    print(name, gamma, cls.__name__, seed, outcome, file=sys.stderr, flush=True)
    return outcome.value, float(outcome.cost.max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problems", nargs="+", default=["chain", "street"])
    parser.add_argument("--gammas", nargs="+", type=float, default=[0.99, 0.999, 0.9999])
    parser.add_argument("--seeds", nargs="+", type=int, default=[61, 62, 63])
    parser.add_argument("--workers", type=int, default=2, help="processes")
    args = parser.parse_args()
    cases: list[Case] = list(
        itertools.product(args.problems, args.gammas, (CPO, TRPOLag), (True, False))
    )
    with ProcessPoolExecutor(args.workers, mp_context=get_context("spawn")) as pool:
        runs = {case: [pool.submit(train, case, seed) for seed in args.seeds] for case in cases}
        for case, futures in runs.items():
            results = np.array([future.result() for future in futures])
            mean = results.mean(axis=0)
            error = results.std(axis=0, ddof=1) / len(results) ** 0.5
            name, gamma, cls, bootstrapped = case
            told = "; ".join(f"{m:.2f} ± {e:.2f}" for m, e in zip(mean, error, strict=True))
            print(f"| `{name}` | {gamma} | {cls.__name__} | {bootstrapped} | {told} |", flush=True)


if __name__ == "__main__":
    main()

"""The data of tables and figures: runs, means, scores, curves, and the look of each algorithm.

Colours are readable on white and on black; the first eight are in the manner of Okabe and Ito's
told apart by colour-blind readers, and line styles and markers tell algorithms apart without them.
"""

from functools import cached_property
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sb3_guard.zoo.results.runs import REFERENCE, read_curve
from sb3_guard.zoo.results.statistics import (
    SCORES,
    aggregate,
    by_family,
    judge,
    normalize,
)

# Text, axes and the reference; a grey that is readable on white and on black. No other colour is
# the same, so a page can replace it by its own.
INK = "#7b7b7b"
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (5, 1, 1, 1)))
LOOSE = (0, (4, 2.5))  # baselines, which are of no family
# An algorithm has its colour and marker in every figure, and a family its line style.
MARKS: dict[str, tuple[str, Any]] = {
    "cpo": ("#0072B2", "D"), "pcpo": ("#D55E00", "d"), "trpo_lag": ("#009E73", "s"),
    "ppo_lag": ("#CC79A7", "v"), "focops": ("#C08A00", "^"), "cup": ("#3D9BD6", "P"),
    "cppo_pid": ("#8F6FD1", "*"), "p3o": ("#8A8A00", "X"), "crpo": ("#8F5000", "p"),
    "ppo": ("#187068", "h"), "sac_lag": ("#C70028", (4, 1, 0)), "td3_lag": ("#087000", (5, 0, 180)),
    "tqc_lag": ("#5038FF", (6, 1, 0)), "trpo_fac": ("#FF00FF", "<"), "trpo_ipo": ("#B70080", ">"),
    "trpo_sl": ("#00AF00", "H"), "trpo_usl": ("#A700FF", "8"), "rcpo": ("#FF0868", (3, 1, 0)),
    "scpo": ("#3078FF", (4, 1, 45)), "sac": ("#805087", (8, 1, 0)), "td3": ("#CF48C7", (7, 0, 0)),
    "tqc": ("#7840C7", (3, 1, 60)),
}  # fmt: skip
COLORS = [color for color, _ in MARKS.values()]
OTHERS = [*MARKS.values()][::-1]  # of algorithms that are not among them
FAMILIES = ("CPO-based", "Lagrangian", "hierarchical", "First-order", "Primal", "State-wise")


class Look(NamedTuple):
    """How an algorithm, or a family, is drawn wherever it is drawn."""

    label: str
    color: str
    dashes: Any
    marker: Any

    @property
    def line(self) -> dict[str, Any]:
        """Arguments of a line without markers."""
        return {"label": self.label, "color": self.color, "linestyle": self.dashes}


class Data:
    """
    What tables and figures are made from, worked out when one asks.

    :param runs: see :func:`~sb3_guard.zoo.results.runs.select`
    """

    def __init__(self, runs: pd.DataFrame):
        self.runs = runs

    def runs_of(self, suite: str, algo: str) -> pd.DataFrame:
        """The seeds of an algorithm on an environment."""
        return self.runs[(self.runs["suite"] == suite) & (self.runs["algo"] == algo)]

    @cached_property
    def means(self) -> pd.DataFrame:
        """Means over seeds, see :func:`~sb3_guard.zoo.results.statistics.aggregate`."""
        return aggregate(self.runs)

    @cached_property
    def scores(self) -> pd.DataFrame:
        """
        Means with scores, of algorithms and of families; index environment and either's key.

        Of several environments, ``all environments`` has the means over those that have a score.
        """
        scores = normalize(self.means)
        scores = pd.concat([scores, by_family(scores)])
        groups = scores.groupby(["algo", "label"], sort=False)[[*SCORES.values()]]
        every = groups.mean().reset_index().assign(suite="all environments")
        parts = [scores, every] if len(self.suites) > 1 else [scores]
        return pd.concat(parts).set_index(["suite", "algo"])

    @cached_property
    def splits(self) -> pd.DataFrame:
        """How limits are kept, see :func:`~sb3_guard.zoo.results.statistics.judge`."""
        return judge(self.runs)

    @cached_property
    def looks(self) -> dict[str, Look]:
        """By key of an algorithm, the reference first and family by family, then by family."""
        table = self.runs.drop_duplicates("algo").fillna({"family": ""})
        table = table.assign(first=table["algo"] != REFERENCE)
        looks: dict[str, Look] = {}
        families = dict.fromkeys([*FAMILIES, *sorted({*table["family"]} - {""})])
        dashes = dict(zip(families, cycle(DASHES), strict=False)) | {"": LOOSE}
        others = sorted({*table["algo"]} - {*MARKS, REFERENCE})
        marks = MARKS | dict(zip(others, cycle(OTHERS), strict=False)) | {REFERENCE: (INK, "o")}
        for row in table.sort_values(["first", "family", "label"]).to_dict("records"):
            color, marker = marks[row["algo"]]
            line = "-" if row["algo"] == REFERENCE else dashes[row["family"]]
            looks[row["algo"]] = Look(row["label"], color, line, marker)
        for family in sorted({*table["family"]} - {""}):
            first = table.loc[table["family"] == family, "algo"].min()
            looks[family] = looks[first]._replace(label=family)
        return looks

    @property
    def families(self) -> list[str]:
        """The families of constrained algorithms."""
        return [key for key in self.looks if key not in {*self.runs["algo"]}]

    @property
    def suites(self) -> list[str]:
        """The environments that there are runs of."""
        return list(dict.fromkeys(self.runs["suite"]))

    def algos(self, suite: str) -> list[str]:
        """The algorithms that there are runs of."""
        have = {*self.runs.loc[self.runs["suite"] == suite, "algo"]}
        return [algo for algo in self.looks if algo in have]

    @cached_property
    def _curves(self) -> dict[str, pd.DataFrame]:
        """The learning curve of each run, by its path."""
        runs = self.runs[["path", "epoch"]].itertuples(index=False)
        return {path: read_curve(path, epoch) for path, epoch in runs}

    def curves(self, suite: str, algo: str) -> list[pd.DataFrame]:
        """The seeds' learning curves."""
        return [self._curves[path] for path in self.runs_of(suite, algo)["path"]]

    def costs(self, suite: str) -> list[str]:
        """Columns of episode costs: the total, and those that have limits of their own."""
        runs = self.runs[self.runs["suite"] == suite].dropna(axis=1, how="all")
        return ["M_c", *runs.filter(regex="^M_c/")]

    def panels(self, suite: str) -> list[str]:
        """Columns that have a learning curve."""
        curves = [self._curves[path] for path in self.runs.loc[self.runs["suite"] == suite, "path"]]
        names = ["J_r", *self.costs(suite), "rho_c"]
        return [name for name in names if any(name in curve for curve in curves)]

    def score(self, suite: str, algo: str, name: str) -> float:
        """A score of an algorithm or a family, NaN if there is none."""
        return float(self.scores[name].get((suite, algo), np.nan))

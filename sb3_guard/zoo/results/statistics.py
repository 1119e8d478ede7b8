"""Statistics of runs: their last epochs, means over seeds, and scores as the GUARD paper has them.

Scores are relative to TRPO's (arXiv 2305.13681).
"""

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd

from sb3_guard.zoo.results.runs import REFERENCE, compared
from sb3_guard.zoo.run.folder import EPOCH

SCORES = {"J_r": "reward", "M_c": "cost", "rho_c": "cost_rate"}
EPOCHS = 10  # at the end of a run, that its training is judged by


# One run


def last_epochs(episodes: pd.DataFrame, epoch: float) -> pd.DataFrame:
    """
    The episodes of the last ten epochs of a run, with their ``epoch``'s number.

    :param episodes: see :func:`~sb3_guard.zoo.results.runs.read_episodes`
    :param epoch: steps; NaN, or too few to end an episode: 30,000, or a twentieth of a shorter run
    """
    total = episodes["step"].iloc[-1]
    size = epoch if epoch * len(episodes) >= total else min(EPOCH, total / 20)
    numbered = episodes.assign(epoch=np.ceil(episodes["step"] / size))
    return numbered[numbered["epoch"] > numbered["epoch"].iloc[-1] - EPOCHS]


def judging_limits(runs: pd.DataFrame) -> "pd.Series[float]":
    """
    The limit that each run is judged by, NaN: none.

    That of an unconstrained run is the limit of the others on its suite, if it is the same for all.
    """
    common = runs.groupby("suite")["cost_limit"].transform(
        lambda limits: limits.max() if limits.nunique() == 1 else math.nan
    )
    return runs["cost_limit"].where(runs["limits"].notna(), common).astype(float)


# Over seeds


def aggregate(runs: pd.DataFrame) -> pd.DataFrame:
    """
    Means over seeds, a row per environment and algorithm.

    :param runs: see :func:`~sb3_guard.zoo.results.runs.select`
    :return: ``suite``, ``algo``, ``label``, ``family``, ``limits``, ``seeds``, ``steps``, and for
        each other number that the runs have its mean and ``_std`` (of the sample; NaN for one seed)
    """
    groups = runs.groupby(["suite", "algo"], sort=False)
    numbers = runs.select_dtypes("number").columns.drop(["seed", "steps"])
    parts = [
        groups[["label", "family", "limits"]].first(),
        groups["seed"].nunique().rename("seeds"),
        groups["steps"].max(),
        groups[[*numbers]].mean(),
        groups[[*numbers]].std().add_suffix("_std"),
    ]
    return pd.concat(parts, axis=1).reset_index()


def mean_curve(curves: Sequence[pd.DataFrame], name: str) -> pd.DataFrame:
    """
    The mean over seeds of one column of their curves.

    :return: index ``step``, as far as all seeds go; ``mean`` and ``std`` (of the sample)
    """
    columns = [curve.set_index("step")[name] for curve in curves]
    table = pd.concat(columns, axis=1).sort_index().interpolate(method="index", limit_area="inside")
    table = table.dropna()
    return pd.DataFrame({"mean": table.mean(axis=1), "std": table.std(axis=1)})


# Scores


def normalize(means: pd.DataFrame) -> pd.DataFrame:
    """
    Scores relative to TRPO's, by the paper's three equations and its rule for negative returns.

    ``reward`` is min(J_r / J_r(TRPO), 1), ``cost`` is M_c / M_c(TRPO), ``cost_rate`` is
    ρ_c / ρ_c(TRPO), not capped. If any mean return of an environment is negative, the least one
    less 1 % of their range (if all are equal: less their size) is first subtracted from all of its
    returns.

    :param means: see :func:`aggregate`; unconstrained baselines do not count for the shift
    :return: the same with the scores; NaN where TRPO has no runs or its value is 0
    """
    ours = means[compared(means)].groupby("suite")["J_r"]
    low, high = ours.min(), ours.max()
    margin = (0.01 * (high - low)).where(high > low, -low)
    shift = (margin - low).where(low < 0, 0.0)
    suites, reference = means["suite"], means[means["algo"] == REFERENCE].set_index("suite")
    scores = {}
    for name, score in SCORES.items():
        offset = suites.map(shift) if name == "J_r" else 0.0
        unit = suites.map(reference[name]) + offset
        scores[score] = ((means[name] + offset) / unit.where(unit != 0)).astype(float)
    return means.assign(**scores | {"reward": scores["reward"].clip(upper=1.0)})


def by_family(scores: pd.DataFrame) -> pd.DataFrame:
    """
    Mean scores of each family's algorithms, per suite.

    :param scores: what :func:`normalize` makes of means
    :return: ``suite``, ``family``, ``algorithms`` (how many), and the scores
    """
    table = scores[(scores["family"].fillna("") != "") & (scores["algo"] != REFERENCE)]
    groups = table.groupby(["suite", "family"], sort=False)
    means = groups[list(SCORES.values())].mean()
    means.insert(0, "algorithms", groups["algo"].nunique())
    return means.reset_index()

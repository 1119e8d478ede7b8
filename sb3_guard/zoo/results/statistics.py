"""Statistics of runs: how they keep their limits, means over seeds, and the GUARD paper's scores.

Agents are judged by three kinds of episodes; share of violations, D⁺ and verdicts follow SafeRLEval
(arXiv 2609.15315). Scores are relative to TRPO's (arXiv 2305.13681).
"""

import json
import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import ttest_ind

from sb3_guard.algorithms import CLASSES
from sb3_guard.judging import kept, named
from sb3_guard.zoo.results.runs import REFERENCE, read_episodes
from sb3_guard.zoo.run.folder import EPOCH, PLAYED

SCORES = {"J_r": "reward", "M_c": "cost", "rho_c": "cost_rate"}
EPOCHS = 10  # at the end of a run, that its training is judged by
#: Labels of the episodes by key; those played after the training are in ``result.json``.
SPLITS = {
    "training": "training episodes",
    **{split: f"final, {actions}" for split, actions in PLAYED.items()},
}


# Limits


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


def read_splits(path: str | Path, epoch: float = math.nan) -> dict[str, pd.DataFrame]:
    """
    The episodes of a run by split.

    :param path: the run folder
    :param epoch: steps, as for :func:`last_epochs`
    :return: for each of :data:`SPLITS` that the run has, its episodes' ``J_r``, ``M_c`` and, of
        several costs or a limit on the worst step, ``M_c/<name>``: of training those of the last
        ten epochs, if no wrapper ended them early
    :raises UsageError: there is no ``0.monitor.csv``, or it is damaged
    """
    result = json.loads((Path(path) / "result.json").read_bytes())
    splits, limit_on = {}, result.get("limit_on", "sum")
    if not result.get("cut"):
        splits["training"] = last_epochs(read_episodes(path), epoch).filter(regex="^(J_r|M_c)")
    for split, episodes in result["final"].items():
        bounded = episodes.get("bounded", {}).items()
        keys = {f"M_c/{named(key, limit_on)}": costs for key, costs in bounded}
        costs = {"M_c": episodes["costs"], **keys}
        # NaN: a physics error ended it
        splits[split] = pd.DataFrame({"J_r": episodes["returns"], **costs}, dtype=float)
    return splits


def violations(costs: np.ndarray, limit: float) -> tuple[float, float]:
    """
    How often and how far single episodes exceed a limit.

    :param costs: of episodes, [E]
    :param limit: d
    :return: the share of the episodes with C > d; and D⁺, the mean of (C − d)/|d| over those, or of
        C − d where d = 0; NaN if there are none
    """
    excess = costs[costs > limit] - limit
    if not len(excess):
        return 0.0, math.nan
    return len(excess) / len(costs), float(excess.mean()) / (abs(limit) or 1.0)


def nested_interval(seeds: Sequence[np.ndarray], resamples: int = 10_000) -> tuple[float, float]:
    """
    A 95 % percentile bootstrap interval of the mean over seeds and episodes.

    Seeds are drawn with replacement, then episodes of each drawn seed; every seed weighs the same.
    Of few seeds, each of the possible draws is taken equally often. Of a single seed the interval
    tells nothing about another.

    :param seeds: costs of the episodes of each seed, [E_s] each, at least one seed
    :param resamples: least number of bootstrap samples
    """
    rng, n = np.random.default_rng(0), len(seeds)
    if n**n <= resamples:
        every = np.indices([n] * n).reshape(n, -1).T
        drawn = np.tile(every, (math.ceil(resamples / n**n), 1))
    else:
        drawn = rng.integers(n, size=(resamples, n))
    means = np.zeros(drawn.shape)
    for number, costs in enumerate(seeds):
        parts = 1 + resamples * len(costs) // 10**7  # so many at once as fit into memory
        for here in np.array_split(np.argwhere(drawn == number), parts):
            rows = rng.integers(len(costs), size=(len(here), len(costs)))
            means[tuple(here.T)] = costs[rows].mean(axis=1)
    low, high = np.quantile(means.mean(axis=1), [0.025, 0.975])
    return float(low), float(high)


def judge(runs: pd.DataFrame) -> pd.DataFrame:
    """
    How agents of an algorithm keep their limits, a row per suite, algorithm, split and cost.

    :param runs: see :func:`~sb3_guard.zoo.results.runs.select`; judged by :func:`judging_limits`
    :return: ``suite``, ``algo``, ``label``, ``split``, ``key`` of a cost with a limit of its own
        (empty: the total), ``seeds``, ``limit`` (NaN: none), ``return`` and ``cost``, means over
        seeds of their episodes' means, with ``_std`` (over seeds; NaN for one), ``low`` and
        ``high`` of the cost (:func:`nested_interval`), ``verdict``
        (:func:`~sb3_guard.judging.kept`, SafeRLEval's tier; empty: no limit), ``diverged``
        (further episodes, which a physics error ended), ``above`` and ``excess``
        (:func:`violations`, of all seeds' episodes)
    """
    rows = []
    limited = runs.assign(judged_by=judging_limits(runs))
    for (suite, algo), group in limited.groupby(["suite", "algo"], sort=False):
        seeds = group[["path", "epoch"]].itertuples(index=False)
        played = [read_splits(path, epoch) for path, epoch in seeds]
        names = {"suite": suite, "algo": algo, "label": group["label"].iloc[0]}
        columns = {"": group["judged_by"].iloc[0]}
        own = group.filter(regex="^cost_limit/").dropna(axis=1, how="all")
        columns |= {name.removeprefix("cost_limit"): own[name].iloc[0] for name in map(str, own)}
        for split in SPLITS:
            episodes = [splits[split] for splits in played if split in splits]
            for end, limit in columns.items():
                if episodes and all(f"M_c{end}" in seed for seed in episodes):
                    row = _row(episodes, f"M_c{end}", limit)
                    rows.append({**names, "split": split, "key": end[1:], **row})
    empty = ["suite", "algo", "split", "key", "verdict"]
    return pd.DataFrame(rows, columns=None if rows else empty)


def _row(seeds: Sequence[pd.DataFrame], column: str, limit: float) -> dict[str, object]:
    """The statistics of a cost in a split."""
    means = pd.DataFrame([episodes.mean() for episodes in seeds])
    costs = [episodes[column].dropna().to_numpy(float) for episodes in seeds]
    diverged = sum(map(len, seeds)) - sum(map(len, costs))
    low, high = nested_interval(costs) if all(map(len, costs)) else (math.nan, math.nan)
    if min(abs(low - limit), abs(high - limit)) < 0.02 * (high - low):  # else the draw decides
        low, high = nested_interval(costs, 1_000_000)
    above, excess = violations(np.concatenate(costs), limit)
    return {
        "seeds": len(seeds),
        "limit": limit,
        "return": means["J_r"].mean(),
        "return_std": means["J_r"].std(),
        "cost": means[column].mean(),
        "cost_std": means[column].std(),
        "low": low,
        "high": high,
        "verdict": "" if math.isnan(limit) else kept(low, high, limit, diverged),
        "diverged": diverged,
        "above": math.nan if math.isnan(limit) else above,
        "excess": excess,
    }


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


def differences(runs: pd.DataFrame) -> pd.DataFrame:
    """
    How far apart two algorithms are, a row per environment that has runs of exactly two.

    The 95 % intervals are Welch's, of the seeds' means. A bootstrap of so few seeds is too narrow:
    of two against two it has nine values in all.

    :return: ``suite``, ``label`` ("one − other"), ``split``, ``seeds``, ``steps``, and the
        differences ``return`` and ``cost`` with ``_low`` and ``_high`` (NaN for a single seed)
    """
    rows = []
    for suite, group in runs.groupby("suite", sort=False):
        pair = [seeds for _, seeds in group.groupby("algo", sort=False)][::-1]
        if len(pair) != 2:
            continue
        pair.sort(key=lambda seeds: seeds["algo"].iloc[0] in CLASSES)  # a user's less ours
        played = [[*map(read_splits, seeds["path"], seeds["epoch"])] for seeds in pair]
        shared = set(SPLITS).intersection(*(splits for seeds in played for splits in seeds))
        split = "stochastic" if "stochastic" in shared else "training"
        if split not in shared:
            continue
        means = [pd.DataFrame([splits[split].mean() for splits in seeds]) for seeds in played]
        row = {
            "suite": suite,
            "label": " − ".join(seeds["label"].iloc[0] for seeds in pair),
            "split": split,
            "seeds": ", ".join(str(len(seeds)) for seeds in means),
            "steps": ", ".join({f"{seeds['steps'].iloc[0]:,}": None for seeds in pair}),
        }
        for name, column in (("return", "J_r"), ("cost", "M_c")):
            one, other = (seeds[column] for seeds in means)
            with warnings.catch_warnings(action="ignore"):  # of what has no interval
                low, high = ttest_ind(one, other, equal_var=False).confidence_interval(0.95)
            row |= {name: one.mean() - other.mean(), f"{name}_low": low, f"{name}_high": high}
        rows.append(row)
    return pd.DataFrame(rows)


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
    baseline = (means["family"].fillna("") == "") & (means["algo"] != REFERENCE)
    ours = means[~baseline].groupby("suite")["J_r"]
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

    :param scores: see :func:`normalize`
    :return: ``suite``, ``algo`` and ``label`` (both the family), and the scores
    """
    table = scores[scores["family"].fillna("") != ""]
    means = table.groupby(["suite", "family"], sort=False)[[*SCORES.values()]].mean().reset_index()
    return means.assign(label=means["family"]).rename(columns={"family": "algo"})

"""What trained runs reached: run folders in, tidy tables out.

A table of runs has a row per run folder. Means over its seeds are compared with TRPO's as the GUARD
paper does (arXiv 2305.13681); ``docs/results.md`` states the rules, ours among them.

Intervals and interquartile means follow Agarwal et al. 2021 (arXiv 2108.13264). Their library,
rliable, saw its last release in 2024 and does not import beside pandas 3 (through ``arch``), so the
stratified bootstrap, the one piece needed, is :func:`interval`.
"""

import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import trim_mean

from sb3_guard.common.files import replacing
from sb3_guard.spelling import did_you_mean
from sb3_guard.zoo.run_folder import MEASURES, RunFolder
from sb3_guard.zoo.tables import table
from sb3_guard.zoo.usage import UsageError, one_line

# Columns of the figures of merit: their key in result.json, and the score made from them
METRICS = dict(zip(("J_r", "M_c", "rho_c"), MEASURES, strict=True))
SCORES = {"J_r": "reward", "M_c": "cost", "rho_c": "cost_rate"}
LABELS = {
    "trpo": "TRPO",
    "cpo": "CPO",
    "pcpo": "PCPO",
    "trpo_lag": "TRPO-Lagrangian",
    "trpo_fac": "TRPO-FAC",
    "trpo_ipo": "TRPO-IPO",
    "trpo_sl": "TRPO-SL",
    "trpo_usl": "TRPO-USL",
}
CATEGORIES = {
    "Lagrangian": ("trpo_lag", "trpo_fac", "trpo_ipo"),
    "CPO-based": ("cpo", "pcpo"),
    "hierarchical": ("trpo_sl", "trpo_usl"),
}
# The paper's suites for its overview and for its radar charts
MAIN8 = (
    "Goal_Point_8Hazards", "Goal_Walker_8Hazards", "Goal_Arm3_8Hazards", "Goal_Drone_8Hazards",
    "Goal_Point_8Ghosts", "Push_Point_8Hazards", "Chase_Point_8Hazards", "Defense_Point_8Hazards",
)  # fmt: skip
RADAR4 = ("Goal_Point_8Hazards", "Goal_Point_8Ghosts", "Goal_Ant_8Hazards", "Goal_Ant_8Ghosts")
VERSIONS = ("sb3_guard", "mujoco", "gymnasium", "stable_baselines3", "torch", "numpy", "python")
TEXTS = (
    "suite", "robot", "task", "constraint", "algo", "limits", "world", "started_from", "settings",
    "config", "commit", "platform", *VERSIONS,
)  # fmt: skip
COLUMNS = (
    "suite", "robot", "task", "constraint", "algo", "seed", "steps", "J_r", "M_c", "rho_c",
    "cost_limit", "limits", "episodes", "physics_errors", "seconds", "epoch", "world",
    "started_from", "settings", "config", *VERSIONS, "commit", "platform", "path",
)  # fmt: skip
_SUITE = re.compile(r"([A-Za-z][A-Za-z0-9]*)_([A-Za-z][A-Za-z0-9]*)_(\d+[A-Za-z]\w*)-v0")
# Runs that agree in these are the same run, made again.
_SAME = ["suite", "world", "algo", "limits", "seed", "steps", "started_from", "config"]
# What TRPO and those compared with it should share
SETTINGS = (
    "n_envs", "n_steps", "gamma", "gae_lambda", "target_kl", "policy_kwargs", "normalize",
)  # fmt: skip
RESAMPLES = 2000
CURVE_POINTS = 200  # at most as many per run, of epochs taken together


@dataclass
class Results:
    """
    What a log folder holds.

    :param runs: a row per finished run, columns :data:`COLUMNS`; see :func:`read_run`
    :param left_out: why a folder could not be read, by its path
    """

    runs: pd.DataFrame
    left_out: dict[str, str]


def read_results(folders: Sequence[str | Path]) -> Results:
    """
    Read all runs at or below some folders; one that can't be read is left out, with the reason.

    :raises UsageError: a folder does not exist, or holds no trace of a run
    """
    rows: list[dict[str, Any]] = []
    left_out: dict[str, str] = {}
    seen: set[Path] = set()
    for folder in dict.fromkeys(map(Path, folders)):
        if not folder.is_dir():
            raise UsageError(f"there is no folder {str(folder)!r}; give one that train wrote to")
        found = find_runs(folder)
        if not found:
            raise UsageError(
                f"there is no run below {str(folder)!r}: a run is <algo>/<env>_<k>/, as train "
                "writes it"
            )
        for path in found:
            if path.resolve() in seen:  # folders may hold one another
                continue
            seen.add(path.resolve())
            try:
                rows.append(read_run(path))
            except (UsageError, OSError) as error:
                left_out[str(path)] = one_line(error)
    runs = pd.DataFrame(rows, columns=list(COLUMNS))
    for name in TEXTS:
        runs[name] = runs[name].astype("string")
    order = {algo: rank for rank, algo in enumerate(LABELS)}
    runs["_rank"] = runs["algo"].map(order).fillna(len(order))
    runs = runs.sort_values(["suite", "_rank", "algo", "cost_limit", "seed"], kind="stable")
    return Results(runs.drop(columns="_rank").reset_index(drop=True), left_out)


def find_runs(folder: Path) -> list[Path]:
    """The run folders at or below a folder, whole or not, in the order of their numbers."""
    marks = {"result.json": 0, "0.monitor.csv": 0, "error.txt": 0, "args.yml": 1, "command.txt": 1}
    found = {path.parents[up] for name, up in marks.items() for path in folder.rglob(name)}

    def natural(path: Path) -> list[tuple[int, str]]:
        parts = re.split(r"(\d+)", str(path))
        return [(int(part), "") if part.isdigit() else (0, part) for part in parts]

    return sorted(found, key=natural)


def read_run(path: Path) -> dict[str, Any]:
    """
    One run as a row of the table.

    :return: by column: ``J_r``, ``M_c`` (means over the episodes of the final epoch; NaN if none
        ended), ``rho_c`` (cumulative cost ÷ steps), ``cost_limit`` (NaN: unconstrained, or several
        costs), ``limits`` (of all costs, "1 2"; missing: unconstrained), ``seconds`` of training,
        ``epoch`` (steps of a rollout), ``world`` (``env_kwargs``), ``started_from`` (the model that
        training went on from), ``settings`` (:data:`SETTINGS`) and ``config`` (the same for the
        same hyper-parameters). What runs of older versions did not write is missing
    :raises UsageError: the run is not finished, or damaged
    """
    if not (path / "result.json").exists():
        raise UsageError("unfinished: it has no result.json" + _last_words(path))
    folder = RunFolder(path)
    result = folder.checked_result()
    steps = result["n_timesteps"]
    args, config = folder.args(), folder.hyperparams()
    env, algo, seed = args.get("env"), args.get("algo"), args.get("seed")
    if not isinstance(env, str) or not isinstance(algo, str) or not isinstance(seed, int):
        raise UsageError(f"{folder.params / 'args.yml'} is damaged: it has no env, algo or seed")
    known = _SUITE.fullmatch(env)
    task, robot, constraint = known.groups() if known else (None, None, None)
    limit = result.get("cost_limit", config.get("cost_limit"))
    limits = limit if isinstance(limit, list) else [] if limit is None else [limit]
    limits = [_number({"cost_limit": one}, "cost_limit") for one in limits]
    world = config.get("env_kwargs")
    settings = {name: config.get(name) for name in SETTINGS}
    versions = result.get("versions")
    versions = versions if isinstance(versions, dict) else {}
    rollout = [config.get(name) for name in ("n_envs", "n_steps")]
    whole = all(isinstance(one, int) for one in rollout)
    return {
        "suite": env.removesuffix("-v0") if known else env,
        "robot": robot,
        "task": task,
        "constraint": constraint,
        "algo": algo,
        "seed": seed,
        "steps": steps,
        **{name: _number(result, key) for name, key in METRICS.items()},
        "cost_limit": limits[0] if len(limits) == 1 else math.nan,
        "limits": _limits(limits) if limits else None,
        "episodes": _number(result, "episodes"),
        "physics_errors": _number(result, "physics_errors"),
        "seconds": _number(result, "seconds"),
        "epoch": math.prod(rollout) if whole else math.nan,
        "world": json.dumps(world, sort_keys=True, default=str) if world else None,
        "started_from": args.get("trained_agent") or None,
        "settings": json.dumps(settings, default=str),
        "config": _digest(config, result.get("learned")),
        **{name: versions.get(name) for name in VERSIONS},
        "commit": result.get("commit"),
        "platform": result.get("platform"),
        "path": str(path),
    }


def _last_words(path: Path) -> str:
    """What a grid noted when the run failed."""
    try:
        lines = (path / "error.txt").read_text(errors="replace").strip().splitlines()
    except OSError:
        return ""
    return f"; its error.txt ends in {lines[-1]!r}" if lines else ""


def _number(result: Mapping[str, Any], key: str) -> float:
    value = result.get(key)
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UsageError(f"result.json is damaged: {key} = {value!r} should be a number")
    return float(value)


def _limits(limits: Iterable[float]) -> str:
    """Limits as ``--cost-limit`` takes them."""
    return " ".join(f"{one:.12g}" for one in limits)


def _digest(config: Mapping[str, Any], learned: Any = None) -> str:
    """
    The same for runs that differ in nothing but what has a column of its own.

    :param learned: step counts of earlier calls of ``learn``: a warm-up or a schedule is stretched
        over one call, so an extended run is not the run that was as long from the start
    """
    columns = ("n_timesteps", "cost_limit", "env_kwargs")
    own = {k: v for k, v in config.items() if k not in columns}
    scheduled = any(isinstance(one, str) and one.startswith("lin_") for one in own.values())
    if learned and (scheduled or "warmup" in own):
        own["learned"] = learned
    text = json.dumps(own, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def choose(
    runs: pd.DataFrame,
    suites: Sequence[str] | None = None,
    cost_limit: float | Sequence[float] | None = None,
    steps: int | None = None,
) -> pd.DataFrame:
    """
    The runs that are asked for.

    :param suites: None: all. The version may be left out
    :param cost_limit: runs of this limit, or of these limits on several costs, and the
        unconstrained ones; None: all
    :param steps: where an algorithm has runs of several lengths on a suite, those of this one;
        None: all
    :raises UsageError: a suite, limit or length without runs
    """
    if suites is not None:
        wanted = [name.removesuffix("-v0") for name in suites]
        known = sorted({*runs["suite"]})
        for name in {*wanted} - {*known} - {f"{one}-v0" for one in known}:
            raise UsageError(f"there is no run of {name!r}; {did_you_mean(name, known)}")
        runs = runs[runs["suite"].str.removesuffix("-v0").isin(wanted)]
    if cost_limit is not None:
        limit = _limits([cost_limit] if isinstance(cost_limit, (int, float)) else cost_limit)
        known = _limits_of(runs)
        if limit not in known:
            raise UsageError(
                f"there is no run at cost limit {limit}; there are runs at "
                f"{', '.join(known) or 'none'}"
            )
        runs = runs[runs["limits"].isna() | (runs["limits"] == limit)]
    if steps is not None:
        lengths = sorted(runs["steps"].unique())
        if steps not in lengths:
            raise UsageError(
                f"there is no run of {steps} steps; there are runs of {_joined(lengths)} steps"
            )
        several = runs.groupby(["suite", "algo"])["steps"].transform("nunique") > 1
        runs = runs[~several | (runs["steps"] == steps)]
    return runs.reset_index(drop=True)


def select(
    runs: pd.DataFrame,
    suites: Sequence[str] | None = None,
    cost_limit: float | Sequence[float] | None = None,
    steps: int | None = None,
) -> pd.DataFrame:
    """
    The runs that may be averaged: those asked for, see :func:`choose`, if they are alike.

    Of runs that are the same, seed included, the last one stands.

    :raises UsageError: as :func:`choose`; or what is left has several cost limits, several lengths
        of an algorithm on a suite, or several ``env_kwargs`` on a suite
    """
    runs = choose(runs, suites, cost_limit, steps)
    limits = _limits_of(runs)
    if len(limits) > 1:
        raise UsageError(
            f"there are runs at several cost limits, {', '.join(limits)}, which can't be averaged; "
            f"choose one, such as --cost-limit {limits[0]}"
        )
    for suite, group in runs.groupby("suite"):
        worlds = group.drop_duplicates("world")
        if len(worlds) > 1:
            named = "; ".join(
                f"{'none' if pd.isna(world) else world} in {path}"
                for world, path in zip(worlds["world"], worlds["path"], strict=True)
            )
            raise UsageError(
                f"runs on {suite} differ in env_kwargs and can't be compared: {named}; give the "
                "folders of one kind only"
            )
    for (where, algo), own in runs.groupby(["suite", "algo"]):
        lengths = sorted(own["steps"].unique())
        if len(lengths) > 1:
            raise UsageError(
                f"runs of {algo} on {where} differ in length, {_joined(lengths)} steps, and can't "
                f"be averaged; choose one, such as --steps {lengths[-1]}"
            )
    return runs.drop_duplicates(_SAME, keep="last").reset_index(drop=True)


def _limits_of(runs: pd.DataFrame) -> list[str]:
    """All limits there are, in the order of their numbers."""
    known = runs["limits"].dropna().unique()
    return sorted(known, key=lambda text: [float(one) for one in text.split()])


def _joined(lengths: Iterable[int]) -> str:
    return ", ".join(map(str, lengths))


def notices(runs: pd.DataFrame, selected: pd.DataFrame) -> list[str]:
    """
    What a reader of the means should know: repeated runs, and in what those compared differ.

    :param runs: see :func:`choose`
    :param selected: what :func:`select` made of them
    """
    again = runs[runs.duplicated(_SAME, keep="last") & runs["suite"].isin({*selected["suite"]})]
    lines = [f"{path} was repeated with the same seed: the later run counts"
             for path in again["path"]]  # fmt: skip
    for suite, group in selected.groupby("suite"):
        lines += [f"{suite}: {line}" for line in _differences(group)]
        none = group.loc[group["J_r"].isna(), "path"]
        if len(none):
            lines.append(f"{suite}: no episode ended in {', '.join(none)}")
    return lines


def _differences(group: pd.DataFrame) -> Iterable[str]:
    """In what the runs of one suite differ."""
    if group["steps"].nunique() > 1:
        yield f"runs differ in length: {_joined(sorted(group['steps'].unique()))} steps"
    if group["started_from"].nunique(dropna=False) > 1:
        warm = group.loc[group["started_from"].notna(), "path"]
        yield f"some runs went on from a model, others from none or another: {', '.join(warm)}"
    for name in ("sb3_guard", "mujoco", "commit"):
        values = sorted(group[name].fillna("unknown").unique())
        if len(values) > 1:
            yield f"runs differ in {name}: {', '.join(values)}"
    for algo, own in group.groupby("algo"):
        if own["config"].nunique() > 1:
            paths = ", ".join(own.drop_duplicates("config")["path"])
            yield f"runs of {algo} differ in hyper-parameters or in how they were extended: {paths}"
        twice = sorted(own.loc[own.duplicated("seed"), "seed"].unique())
        if twice:
            yield f"runs of {algo} count twice or more for one seed: {_joined(twice)}"
    # RL-Zoo's baselines have settings of their own.
    ours = group[group["algo"].isin(list(LABELS))]
    settings = [json.loads(text) for text in ours["settings"]]
    for name in SETTINGS:
        users: dict[str, list[str]] = {}
        for algo, own_settings in zip(ours["algo"], settings, strict=True):
            users.setdefault(json.dumps(own_settings[name], sort_keys=True), []).append(algo)
        if len(users) > 1 and len({*ours["algo"]}) > 1:
            named = "; ".join(
                f"{'default' if value == 'null' else value} ({', '.join(dict.fromkeys(algos))})"
                for value, algos in users.items()
            )
            yield f"algorithms differ in {name}: {named}"


# Statistics over seeds


def interval(
    groups: Sequence[np.ndarray],
    statistic: Callable[..., np.ndarray] = np.mean,
    level: float = 0.95,
) -> tuple[Any, Any]:
    """
    A percentile bootstrap interval, stratified: each group is resampled by itself.

    :param groups: values of independent runs, [n_g] each; NaN are left out
    :param statistic: called with ``axis=1`` on [B, Σ n_g] resamples; returns [B, …]
    :param level: part of the resamples inside
    :return: lower and upper end, each of the statistic's shape; NaN where no group has two values,
        since one seed says nothing about another
    """
    groups = [group[~np.isnan(group)] for group in map(np.asarray, groups)]
    if not any(len(group) > 1 for group in groups):
        return math.nan, math.nan
    rng = np.random.default_rng(0)
    draws = [
        group[rng.integers(len(group), size=(RESAMPLES, len(group)))]
        for group in groups
        if len(group)
    ]
    values = statistic(np.concatenate(draws, axis=1), axis=1)
    low, high = np.quantile(values, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return low, high


def aggregate(runs: pd.DataFrame) -> pd.DataFrame:
    """
    Means over seeds, a row per suite and algorithm.

    :param runs: see :func:`select`
    :return: ``suite``, ``algo``, ``limits``, ``seeds``, ``steps``, and for each of
        :data:`METRICS` its mean, ``_std`` (of the sample; NaN for one seed), ``_low`` and ``_high``
        (95 % bootstrap interval of the mean)
    """
    rows = []
    for (suite, algo), group in runs.groupby(["suite", "algo"], sort=False):
        row = {
            "suite": suite,
            "algo": algo,
            "limits": group["limits"].iloc[0],
            "seeds": group["seed"].nunique(),
            "steps": int(group["steps"].max()),
        }
        for name in METRICS:
            low, high = interval([group[name].to_numpy()])
            row |= {name: group[name].mean(), f"{name}_std": group[name].std()}
            row |= {f"{name}_low": low, f"{name}_high": high}
        rows.append(row)
    columns = ["suite", "algo", "limits", "seeds", "steps"]
    columns += [name + end for name in METRICS for end in ("", "_std", "_low", "_high")]
    return pd.DataFrame(rows, columns=columns)


def normalize(rows: pd.DataFrame, means: pd.DataFrame) -> pd.DataFrame:
    """
    Scores relative to TRPO's, by the paper's three equations and its rule for negative returns.

    ``reward`` is min(J_r / J_r(TRPO), 1), ``cost`` is M_c / M_c(TRPO), ``cost_rate`` is
    ρ_c / ρ_c(TRPO), not capped. If any mean return of a suite is negative, the least one less 1 %
    of their range (if all are equal: less their size) is first subtracted from all returns of the
    suite.

    :param rows: a table with ``suite``, ``algo`` and :data:`METRICS`, of means or of runs
    :param means: the means, of :func:`aggregate`, that TRPO's values and the shift come from; only
        the paper's algorithms count for the shift
    :return: ``rows`` with the scores; NaN where TRPO has no runs or its value is 0
    """
    rows = rows.copy()
    ours = means[means["algo"].isin(list(LABELS))].groupby("suite")["J_r"]
    low, high = ours.min(), ours.max()
    margin = (0.01 * (high - low)).where(high > low, -low)
    shift = (margin - low).where(low < 0, 0.0)
    trpo = means[means["algo"] == "trpo"].set_index("suite")
    for name, score in SCORES.items():
        offset = rows["suite"].map(shift) if name == "J_r" else 0.0
        unit = rows["suite"].map(trpo[name]) + offset
        rows[score] = ((rows[name] + offset) / unit.where(unit != 0)).astype(float)
    rows["reward"] = rows["reward"].clip(upper=1.0)
    return rows


def by_category(scores: pd.DataFrame) -> pd.DataFrame:
    """
    Mean scores of each category's algorithms, per suite.

    :param scores: what :func:`normalize` makes of means
    :return: ``suite``, ``category``, ``algorithms`` (how many), and the scores
    """
    category = {algo: name for name, algos in CATEGORIES.items() for algo in algos}
    table = scores.assign(category=scores["algo"].map(category)).dropna(subset="category")
    groups = table.groupby(["suite", "category"], sort=False)
    means = groups[list(SCORES.values())].mean()
    means.insert(0, "algorithms", groups["algo"].nunique())
    return means.reset_index()


def overall(runs: pd.DataFrame, means: pd.DataFrame) -> pd.DataFrame:
    """
    Scores of each algorithm over all suites.

    :return: ``algo``; for each score its mean over suites, ``_n`` (suites that have one), ``_iqm``
        (interquartile mean over runs and suites) with ``_low`` and ``_high`` (95 % stratified
        bootstrap interval)
    """
    scores, single = normalize(means, means), normalize(runs, means)
    rows: list[dict[str, Any]] = []
    for algo, own in scores.groupby("algo", sort=False):
        row: dict[str, Any] = {"algo": algo}
        each = single[single["algo"] == algo]
        for score in SCORES.values():
            groups = [group.dropna().to_numpy() for _, group in each.groupby("suite")[score]]
            values = np.concatenate(groups)
            low, high = interval(groups, iqm)
            row |= {score: own[score].mean(), f"{score}_n": int(own[score].notna().sum())}
            row[f"{score}_iqm"] = iqm(values) if len(values) else math.nan
            row |= {f"{score}_low": low, f"{score}_high": high}
        rows.append(row)
    order = {algo: rank for rank, algo in enumerate(LABELS)}
    rows.sort(key=lambda row: order.get(row["algo"], len(order)))
    return pd.DataFrame(rows)


def iqm(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """The mean of the middle half of the values along an axis."""
    return trim_mean(values, 0.25, axis=axis)


# Learning curves


def read_curve(path: str | Path, epoch: float = math.nan) -> pd.DataFrame:
    """
    How a run went, from its episodes.

    :param path: the run folder
    :param epoch: steps per point; NaN or too few: 1/200 of the run
    :return: ``step`` (the end of an epoch), ``J_r`` and ``M_c`` (means over the episodes that ended
        in it), ``rho_c`` (cumulative cost ÷ steps of all episodes until then), ``episodes`` and
        ``variance`` (of their returns)
    :raises UsageError: there is no ``0.monitor.csv``, or it is damaged
    """
    file = Path(path) / "0.monitor.csv"
    try:
        table = pd.read_csv(file, skiprows=1)[["r", "l", "c"]].astype(float)
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(f"can't read {file}: {one_line(error)}") from error
    if not len(table) or table.isna().any(axis=None):
        raise UsageError(f"can't draw {file}: it has no episodes, or cut ones")
    steps = table["l"].cumsum()
    total = steps.iloc[-1]
    rollout = epoch if epoch > 0 else total / CURVE_POINTS
    size = rollout * max(1, math.ceil(total / rollout / CURVE_POINTS))
    groups = table.assign(rate=table["c"].cumsum() / steps).groupby(np.ceil(steps / size) * size)
    curve = groups.agg(
        J_r=("r", "mean"),
        M_c=("c", "mean"),
        rho_c=("rate", "last"),
        episodes=("r", "size"),
        variance=("r", "var"),
    )
    return curve.rename_axis("step").reset_index()


def mean_curve(curves: Sequence[pd.DataFrame], name: str) -> pd.DataFrame:
    """
    The mean over seeds of one column of their curves.

    :return: index ``step``, as far as all seeds go; ``mean`` and ``std`` (of the sample)
    """
    columns = [curve.set_index("step")[name] for curve in curves]
    table = pd.concat(columns, axis=1).sort_index().interpolate(method="index", limit_area="inside")
    table = table.dropna()
    return pd.DataFrame({"mean": table.mean(axis=1), "std": table.std(axis=1)})


def learning(runs: pd.DataFrame, epochs: int = 5) -> pd.DataFrame:
    """
    First and last epochs of each run, and by how many standard errors their returns differ.

    :param runs: runs whose curves can be read
    :param epochs: how many count as first and as last
    """
    rows = []
    for run in runs.to_dict("records"):
        curve = read_curve(run["path"], run["epoch"])
        first, last = curve.head(epochs), curve.tail(epochs)
        variance = sum(
            (part["variance"] / part["episodes"]).sum() / len(part) ** 2 for part in (first, last)
        )
        gain = last["J_r"].mean() - first["J_r"].mean()
        rows.append(
            {
                "suite": run["suite"],
                "algorithm": label(run["algo"]),
                "seed": run["seed"],
                "steps": f"{run['steps']:,}",
                "return, first": f"{first['J_r'].mean():.2f}",
                "last": f"{last['J_r'].mean():.2f}",
                "gain, s.e.": f"{gain / math.sqrt(variance):.1f}" if variance > 0 else "–",
                "cost, first": f"{first['M_c'].mean():.2f}",
                "cost, last": f"{last['M_c'].mean():.2f}",
                "cost rate": f"{run['rho_c']:.5f}",
            }
        )
    return pd.DataFrame(rows)


# Tables for people


def label(algo: str) -> str:
    """An algorithm's name in tables and figures."""
    return LABELS.get(algo, algo.upper())


def tables(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """
    The tables of a report as text, by title.

    :param runs: see :func:`select`
    """
    means = aggregate(runs)
    scores = normalize(means, means)
    result = {"Results": _spelled(scores)}
    if scores["reward"].notna().any() or scores["cost"].notna().any():
        categories = by_category(scores)
        if len(categories):
            result["Categories, relative to TRPO"] = pd.DataFrame(
                {
                    "suite": categories["suite"],
                    "category": categories["category"],
                    "algorithms": categories["algorithms"].map(str),
                    **{
                        heading: categories[score].map(_plain)
                        for score, heading in _SCORE_HEADINGS.items()
                    },
                }
            )
        if scores["suite"].nunique() > 1:
            result["All suites, relative to TRPO"] = _overall_spelled(overall(runs, means))
    return result


_SCORE_HEADINGS = {"reward": "reward / TRPO", "cost": "cost / TRPO", "cost_rate": "rate / TRPO"}
_DIGITS = {"J_r": 2, "M_c": 2, "rho_c": 5}
_HEADINGS = {"J_r": "return J_r", "M_c": "episode cost M_c", "rho_c": "cost rate ρ_c"}


def _plain(value: float, digits: int = 2) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}".replace("-", "−")


def _spelled(scores: pd.DataFrame) -> pd.DataFrame:
    def cell(row: Any, name: str) -> str:
        digits = _DIGITS[name]
        text = _plain(row[name], digits)
        if math.isnan(row[f"{name}_std"]):
            return text
        text += f" ± {_plain(row[f'{name}_std'], digits)}"
        return (
            f"{text} [{_plain(row[f'{name}_low'], digits)}, {_plain(row[f'{name}_high'], digits)}]"
        )

    def column(name: str) -> list[str]:
        return [cell(row, name) for _, row in scores.iterrows()]

    return pd.DataFrame(
        {
            "suite": scores["suite"],
            "algorithm": scores["algo"].map(label),
            "limit": ["–" if pd.isna(text) else text for text in scores["limits"]],
            "seeds": scores["seeds"].map(str),
            "steps": [f"{n:,}" for n in scores["steps"]],
            **{heading: column(name) for name, heading in _HEADINGS.items()},
            **{heading: scores[name].map(_plain) for name, heading in _SCORE_HEADINGS.items()},
        }
    )


def _overall_spelled(table: pd.DataFrame) -> pd.DataFrame:
    columns: dict[str, Any] = {"algorithm": table["algo"].map(label)}
    for score, heading in _SCORE_HEADINGS.items():
        columns[heading] = [
            f"{_plain(m)} ({n})" for m, n in zip(table[score], table[f"{score}_n"], strict=True)
        ]
        cells = []
        for value, low, high in zip(
            table[f"{score}_iqm"], table[f"{score}_low"], table[f"{score}_high"], strict=True
        ):
            ends = "" if math.isnan(low) else f" [{_plain(low)}, {_plain(high)}]"
            cells.append(_plain(value) + ends)
        columns[f"{heading}, IQM"] = cells
    return pd.DataFrame(columns)


def markdown(data: pd.DataFrame) -> str:
    """A table of text in Markdown, aligned for the terminal."""
    return table(list(data.columns), data.astype(str).to_numpy().tolist())


_LATEX = {
    "\\": r"\textbackslash{}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "±": r"$\pm$", "−": "$-$", "ρ": r"$\rho$", "–": "--",
}  # fmt: skip


def latex(table: pd.DataFrame) -> str:
    """A table of text in LaTeX; it needs ``\\usepackage{booktabs}``."""

    def line(cells: Iterable[str]) -> str:
        escaped = ("".join(_LATEX.get(char, char) for char in str(cell)) for cell in cells)
        return " & ".join(escaped) + r" \\"

    header = line(table.columns)
    for plain, symbol in (("J\\_r", "$J_r$"), ("M\\_c", "$M_c$"), (r"$\rho$\_c", r"$\rho_c$")):
        header = header.replace(plain, symbol)
    rows = [line(row) for row in table.astype(str).to_numpy().tolist()]
    return "\n".join(
        [rf"\begin{{tabular}}{{{'l' * len(table.columns)}}}", r"\toprule", header, r"\midrule",
         *rows, r"\bottomrule", r"\end{tabular}"]
    )  # fmt: skip


TABLE_FORMATS = (".md", ".tex", ".csv", ".parquet")


def check_table(path: Path) -> None:
    """
    Find out before work is done whether a table can be written in the format its name asks for.

    :raises UsageError: the format is unknown, or Parquet without pyarrow
    """
    if path.suffix not in TABLE_FORMATS:
        raise UsageError(
            f"--table {str(path)!r}: unknown format {path.suffix!r}; "
            f"{did_you_mean(path.suffix, TABLE_FORMATS)}"
        )
    if path.suffix == ".parquet" and find_spec("pyarrow") is None:
        raise UsageError(
            f"--table {str(path)!r}: Parquet needs pyarrow; run pip install pyarrow, or write .csv"
        )


def write_table(path: Path, runs: pd.DataFrame, notes: Sequence[str] = ()) -> None:
    """
    Write a table in the format that the file's name says.

    :param path: ``.csv`` and ``.parquet`` get a row per run; ``.md`` and ``.tex`` the means over
        seeds and the scores, see :func:`tables`
    :param runs: for means, those that may be averaged, see :func:`select`
    :param notes: what a reader of the means should know, see :func:`notices`; written below them
    :raises UsageError: see :func:`check_table`; or the file can't be written
    """
    check_table(path)
    if path.suffix == ".md":
        parts = [f"## {title}\n\n{markdown(table)}" for title, table in tables(runs).items()]
        parts += ["\n".join(f"- {note}" for note in notes)] if notes else []
    elif path.suffix == ".tex":
        parts = [f"% {title}\n{latex(table)}" for title, table in tables(runs).items()]
        parts += ["\n".join(f"% {note}" for note in notes)] if notes else []
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            if path.suffix == ".csv":
                runs.to_csv(file, index=False)
            elif path.suffix == ".parquet":
                runs.to_parquet(file, index=False)
            else:
                file.write(("\n\n".join(parts) + "\n").encode())
    except OSError as error:
        raise UsageError(
            f"can't write to {str(path)!r}: {error.strerror}; choose another file"
        ) from error

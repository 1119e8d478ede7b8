"""What trained runs reached: run folders in, a table with a row per run out.

``docs/plotting.md`` states the rules: which runs are read, which may be averaged, and what a reader
of the averages is told.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from sb3_guard.spelling import did_you_mean
from sb3_guard.zoo.cli.usage import UsageError, one_line
from sb3_guard.zoo.run.folder import MEASURES, RunFolder

REFERENCE = "trpo"  # scores are relative to it
# Columns of the figures of merit, and their key in result.json
METRICS = dict(zip(("J_r", "M_c", "rho_c"), MEASURES, strict=True))
VERSIONS = ("sb3_guard", "mujoco", "gymnasium", "stable_baselines3", "torch", "numpy", "python")
NUMBERS = (
    "seed", "steps", *METRICS, "cost_limit", "episodes", "physics_errors", "seconds", "epoch",
)  # fmt: skip
TEXTS = (
    "suite", "robot", "task", "constraint", "algo", "label", "family", "limits", "verdict", "world",
    "started_from", "settings", "config", *VERSIONS, "commit", "platform", "path",
)  # fmt: skip
COLUMNS = (*TEXTS[:7], *NUMBERS, *TEXTS[7:])
_SUITE = re.compile(r"([A-Za-z][A-Za-z0-9]*)_([A-Za-z][A-Za-z0-9]*)_(\d+[A-Za-z]\w*)-v0")
# Runs that agree in these are the same run, made again.
_SAME = ["suite", "world", "algo", "limits", "seed", "steps", "started_from", "config"]
# What algorithms that are compared should share
SETTINGS = (
    "n_envs", "n_steps", "gamma", "gae_lambda", "target_kl", "policy_kwargs", "normalize",
)  # fmt: skip
VERDICTS = ("exceeded", "undecided", "kept")  # the worst one first


class Results(NamedTuple):
    """
    What log folders hold.

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
    rows: dict[Path, dict[str, Any]] = {}
    left_out: dict[str, str] = {}
    for folder in map(Path, folders):
        if not folder.is_dir():
            raise UsageError(f"there is no folder {str(folder)!r}; give one that train wrote to")
        found = find_runs(folder)
        if not found:
            raise UsageError(
                f"there is no run below {str(folder)!r}: a run is <algo>/<env>_<k>/, as train "
                "writes it"
            )
        for path in found:
            if path.resolve() in rows:  # folders may contain one another
                continue
            try:
                rows[path.resolve()] = read_run(path)
            except (UsageError, OSError, ValueError, TypeError) as error:
                left_out[str(path)] = one_line(error)
    keys = sorted({name for row in rows.values() for name in row} - {*COLUMNS})
    runs = pd.DataFrame([*rows.values()], columns=[*COLUMNS, *keys])
    texts = [*TEXTS, *(name for name in keys if name.startswith("verdict"))]
    runs = runs.astype(dict.fromkeys(texts, "string"))
    # The reference comes first, then family by family.
    order = ["suite", "_first", "family", "label", "algo", "cost_limit", "seed"]
    runs = runs.assign(_first=runs["algo"] != REFERENCE).sort_values(order, kind="stable")
    return Results(runs.drop(columns="_first").reset_index(drop=True), left_out)


def find_runs(folder: Path) -> list[Path]:
    """The run folders at or below a folder, complete or not, in the order of their numbers."""
    marks = {"result.json": 0, "0.monitor.csv": 0, "error.txt": 0, "args.yml": 1, "command.txt": 1}
    found = {path.parents[up] for name, up in marks.items() for path in folder.rglob(name)}

    def natural(path: Path) -> list[tuple[int, str]]:
        parts = re.split(r"(\d+)", str(path))
        return [(int(part), "") if part.isdigit() else (0, part) for part in parts]

    return sorted(found, key=natural)


def read_run(path: Path) -> dict[str, Any]:
    """
    One run as a row of the table.

    :return: by column: ``label`` and ``family`` of the algorithm (empty: unconstrained), ``J_r``,
        ``M_c`` (means over the episodes of the final epoch; NaN if none ended), ``rho_c``
        (cumulative cost ÷ steps),
        ``cost_limit`` (of the total cost; NaN: there is none), ``limits`` (of all costs, "1 2";
        missing: unconstrained), ``verdict`` on them (of several the worst), ``seconds`` of
        training, ``epoch`` (steps of a rollout), ``world`` (``env_kwargs``), ``started_from`` (the
        model that training started from), ``settings`` (:data:`SETTINGS`) and ``config`` (the same
        for the same hyperparameters). If the limits are on other costs than the total, there are
        ``M_c/<key>``, ``cost_limit/<key>`` and ``verdict/<key>`` of each. What runs of older
        versions did not write is missing
    :raises UsageError: the run is not finished, or damaged
    """
    if not (path / "result.json").exists():
        raise UsageError("unfinished: it has no result.json" + _last_words(path))
    folder = RunFolder(path)
    result, args, config = folder.checked_result(), folder.args(), folder.hyperparams()
    env, algo, seed = args.get("env"), args.get("algo"), args.get("seed")
    if not isinstance(env, str) or not isinstance(algo, str) or not isinstance(seed, int):
        raise UsageError(f"{folder.params / 'args.yml'} is damaged: it has no env, algo or seed")
    known = _SUITE.fullmatch(env)
    limit = result.get("cost_limit", config.get("cost_limit"))
    limits = limit if isinstance(limit, list) else [] if limit is None else [limit]
    limits = [_number(one) for one in limits]
    by_key, verdicts = _by_key(result)
    other = by_key or "limit_on" in result  # not the total is limited
    settings = {name: config.get(name) for name in SETTINGS}
    rollout = [config.get(name) for name in ("n_envs", "n_steps")]
    whole = all(isinstance(one, int) for one in rollout)
    names = {key: result.get(key) or "" for key in ("label", "family")}
    names = names if names["label"] else described(algo)
    versions = result.get("versions") or {}
    numbers = {**METRICS, **{k: k for k in ("episodes", "physics_errors", "seconds")}}
    return {
        "suite": env.removesuffix("-v0") if known else env,
        **dict(zip(("task", "robot", "constraint"), known.groups() if known else (), strict=False)),
        "algo": algo,
        "label": str(names["label"]),
        "family": str(names["family"]).replace("unconstrained", ""),
        "seed": seed,
        "steps": result["n_timesteps"],
        **{name: _number(result.get(key)) for name, key in numbers.items()},
        "cost_limit": limits[0] if len(limits) == 1 and not other else math.nan,
        "limits": _limits(limits) if limits else None,
        "verdict": min(verdicts, key=VERDICTS.index, default=None),
        **by_key,
        "epoch": math.prod(rollout) if whole else math.nan,
        "world": json.dumps(config["env_kwargs"], sort_keys=True, default=str)
        if config.get("env_kwargs")
        else None,
        "started_from": args.get("trained_agent") or None,
        "settings": json.dumps(settings, default=str),
        "config": _digest(config, result.get("learned")),
        **{name: versions.get(name) for name in VERSIONS},
        "commit": result.get("commit"),
        "platform": result.get("platform"),
        "path": str(path),
    }


def _by_key(result: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """What a result says of its costs: columns of those that are not the total, and verdicts."""
    costs = result["costs"]
    verdicts = [cost["verdict"] for cost in costs.values() if cost.get("verdict")]
    columns: dict[str, Any] = {}
    total = [cost["mean"] for cost in costs.values()] == [result["cost"]]
    for key, cost in {}.items() if total or "limit_on" in result else costs.items():
        columns[f"M_c/{key}"] = _number(cost["mean"])
        columns[f"cost_limit/{key}"] = _number(cost["limit"])
        columns[f"verdict/{key}"] = cost.get("verdict")
    return columns, verdicts


@cache
def described(algo: str) -> dict[str, str]:
    """``label`` and ``family`` of an algorithm, from its class; for runs that do not state them."""
    from sb3_guard.zoo.run.algos import algorithm

    try:
        cls: Any = algorithm(algo)
    except UsageError:  # a user's own, which is not imported here
        cls = None
    return {
        "label": getattr(cls, "label", None) or algo.upper().replace("_", "-"),
        "family": getattr(cls, "family", ""),
    }


def _last_words(path: Path) -> str:
    """What a grid noted when the run failed."""
    try:
        lines = (path / "error.txt").read_text(errors="replace").strip().splitlines()
    except OSError:
        return ""
    return f"; its error.txt ends in {lines[-1]!r}" if lines else ""


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


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
    limits = config.get("cost_limit")
    texts = [*own.values(), *(limits if isinstance(limits, list) else [limits])]
    scheduled = any(isinstance(text, str) and text.startswith("lin_") for text in texts)
    if learned and (scheduled or "warmup" in own):
        own["learned"] = learned
    text = json.dumps(own, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


# Which runs


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
    :param steps: only runs of this length, where an algorithm has several on an environment;
        None: all
    :raises UsageError: an environment, limit or length without runs
    """
    if suites is not None:
        names: dict[str, list[str]] = {}  # an environment, with and without its version
        for suite in sorted({*runs["suite"]}):
            for name in {suite, f"{suite}-v0", re.sub(r"-v\d+$", "", suite)}:
                names.setdefault(name, []).append(suite)
        for name in suites:
            if name not in names:
                known = sorted({*runs["suite"]})
                raise UsageError(f"there is no run of {name!r}; {did_you_mean(name, known)}")
        runs = runs[runs["suite"].isin({suite for name in suites for suite in names[name]})]
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


def select(runs: pd.DataFrame) -> pd.DataFrame:
    """
    The runs that may be averaged: of runs that are the same, seed included, the last one counts.

    :raises UsageError: an environment has several cost limits or ``env_kwargs``, or an algorithm
        on it several lengths
    """
    for suite, group in runs.groupby("suite"):
        limits = _limits_of(group)
        if len(limits) > 1:
            raise UsageError(
                f"there are runs on {suite} at several cost limits, {', '.join(limits)}, which "
                f"can't be averaged; choose one, such as --cost-limit {limits[0]}"
            )
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


def _joined(values: Iterable[Any]) -> str:
    return ", ".join(map(str, values))


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
            lines.append(f"{suite}: no episode ended in {_joined(none)}")
    return lines


def _differences(group: pd.DataFrame) -> Iterable[str]:
    """In what the runs of one environment differ."""
    if group["steps"].nunique() > 1:
        yield f"runs differ in length: {_joined(sorted(group['steps'].unique()))} steps"
    if group["started_from"].nunique(dropna=False) > 1:
        warm = group.loc[group["started_from"].notna(), "path"]
        yield f"some runs started from a model, others from none or another: {_joined(warm)}"
    for name in ("sb3_guard", "mujoco", "commit"):
        values = sorted(group[name].fillna("unknown").unique())
        if len(values) > 1:
            yield f"runs differ in {name}: {_joined(values)}"
    for algo, own in group.groupby("algo"):
        if own["config"].nunique() > 1:
            paths = _joined(own.drop_duplicates("config")["path"])
            yield f"runs of {algo} differ in hyperparameters or in how they were extended: {paths}"
        twice = sorted(own.loc[own.duplicated("seed"), "seed"].unique())
        if twice:
            yield f"runs of {algo} count twice or more for one seed: {_joined(twice)}"
    # Unconstrained baselines have settings of their own.
    ours = group[compared(group)]
    settings = [json.loads(text) for text in ours["settings"]]
    for name in SETTINGS if ours["algo"].nunique() > 1 else ():
        texts = [json.dumps(own[name], sort_keys=True) for own in settings]
        stated = pd.Series(texts, index=ours.index, dtype="string")
        if stated.nunique() > 1:
            users = ours["algo"].groupby(stated, sort=False).unique()
            named = "; ".join(
                f"{'default' if value == 'null' else value} ({_joined(algos)})"
                for value, algos in users.items()
            )
            yield f"algorithms differ in {name}: {named}"


def compared(table: pd.DataFrame) -> "pd.Series[bool]":
    """Which rows are of the reference or of constrained algorithms, rather than of baselines."""
    return (table["algo"] == REFERENCE) | (table["family"].fillna("") != "")

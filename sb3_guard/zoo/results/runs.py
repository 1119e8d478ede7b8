"""What trained runs reached: run folders in, a table with a row per run out.

``docs/plotting.md`` states the rules: which runs are read, which may be averaged, and what a reader
of the averages is told.
"""

import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sb3_guard.fields import did_you_mean
from sb3_guard.judging import named
from sb3_guard.zoo.cli.usage import UsageError, explained, one_line
from sb3_guard.zoo.run.folder import RunFolder

REFERENCE = "trpo"  # scores are relative to it
# Columns of numbers, and their key in result.json
NUMBERS = {
    "J_r": "return", "M_c": "cost", "rho_c": "cost_rate", "episodes": "episodes",
    "physics_errors": "physics_errors", "seconds": "seconds",
}  # fmt: skip
CURVE_POINTS = 200  # at most as many per run, of epochs taken together
VERSIONS = ("sb3_guard", "mujoco", "gymnasium", "stable_baselines3", "torch", "numpy", "python")
_SUITE = re.compile(r"[A-Za-z][A-Za-z0-9]*_[A-Za-z][A-Za-z0-9]*_\d+[A-Za-z]\w*-v0")


class Results(NamedTuple):
    """
    What log folders hold.

    :param runs: a row per finished run, see :func:`read_run`
    :param left_out: why a folder could not be read, by its path
    """

    runs: pd.DataFrame
    left_out: dict[str, str]


def read_results(folders: Sequence[str | Path]) -> Results:
    """
    Read all runs at or below some folders; one that can't be read is left out, with the reason.

    :raises UsageError: a folder holds no trace of a run
    """
    paths: dict[Path, Path] = {}  # folders may contain one another
    for folder in map(Path, folders):
        below = find_runs(folder)
        if not below:
            raise UsageError(
                f"there is no run below {str(folder)!r}: a run is <algo>/<env>_<k>/, as train "
                "writes it"
            )
        for path in below:
            paths.setdefault(path.resolve(), path)
    rows: list[dict[str, Any]] = []
    left_out: dict[str, str] = {}
    for path in paths.values():
        try:
            rows.append(read_run(path))
        except (UsageError, OSError, ValueError, TypeError) as error:
            left_out[str(path)] = one_line(error)
    if not rows:
        return Results(pd.DataFrame(), left_out)
    runs = pd.DataFrame(rows)
    runs = runs.astype(dict.fromkeys(runs.select_dtypes(exclude="number"), "string"))
    # The reference comes first, then family by family.
    order = ["suite", "_first", "family", "label", "algo", "cost_limit", "seed"]
    runs = runs.assign(_first=runs["algo"] != REFERENCE).sort_values(order, kind="stable")
    return Results(runs.drop(columns="_first").reset_index(drop=True), left_out)


def find_runs(folder: Path) -> list[Path]:
    """The run folders at or below a folder, complete or not, in the order of their numbers."""
    return sorted({path.parents[1] for path in folder.rglob("args.yml")}, key=_natural)


def _natural(value: Any) -> list[tuple[int, str]]:
    """The key of an order in which numbers within texts count as numbers."""
    parts = re.split(r"(\d+)", str(value))
    return [(int(part), "") if part.isdigit() else (0, part) for part in parts]


def read_run(path: Path) -> dict[str, Any]:
    """
    One run as a row of the table.

    :return: by column: ``label`` and ``family`` of the algorithm (empty: unconstrained), ``J_r``,
        ``M_c`` (means over the episodes of the final epoch; NaN if none ended), ``rho_c``
        (cumulative cost ÷ steps), ``delivered`` (1 or 0: whether ``--certify`` found an agent),
        ``cost_limit`` (of the total cost; NaN: there is none), ``limits`` (of all costs, "1 2";
        missing: unconstrained), ``seconds`` of training, ``epoch`` (steps of a rollout), ``world``
        (``env_kwargs``) and ``config`` (the same for the same hyperparameters and start). If the
        limits are on other costs than the total, there are ``M_c/<key>`` and ``cost_limit/<key>``
        of each
    :raises UsageError: the run is not finished, or damaged
    """
    folder = RunFolder(path)
    result, args, config = folder.checked_result(), folder.args(), folder.hyperparams()
    env, algo, seed = args.get("env"), args.get("algo"), args.get("seed")
    if not isinstance(env, str) or not isinstance(algo, str) or not isinstance(seed, int):
        raise UsageError(f"{folder.params / 'args.yml'} is damaged: it has no env, algo or seed")
    read_episodes(path)  # raises if there are none
    limit = result.get("cost_limit")
    limits = limit if isinstance(limit, list) else [] if limit is None else [limit]
    costs, limit_on, by_key = result["costs"], result.get("limit_on", "sum"), {}
    if len(costs) > 1 or limit_on != "sum":  # limits are on other costs than the total
        for key, cost in costs.items():
            name = named(key, limit_on)
            by_key[f"M_c/{name}"] = _number(cost["mean"])
            by_key[f"cost_limit/{name}"] = _number(cost["limit"])
    rollout = [config.get(name) for name in ("n_envs", "n_steps")]
    versions = result.get("versions") or {}
    return {
        "suite": env.removesuffix("-v0") if _SUITE.fullmatch(env) else env,
        "algo": algo,
        "label": result.get("label") or algo.upper().replace("_", "-"),
        "family": (result.get("family") or "").replace("unconstrained", ""),
        "seed": seed,
        "steps": result["n_timesteps"],
        **{name: _number(result.get(key)) for name, key in NUMBERS.items()},
        "cost_limit": _number(limits[0] if len(limits) == 1 and not by_key else None),
        "limits": _limits(limits) if limits else None,
        **by_key,
        "epoch": math.nan if None in rollout else math.prod(rollout),
        "world": _text(config.get("env_kwargs") or {}),
        "delivered": float(result["delivered"] is not None) if "delivered" in result else math.nan,
        "config": _digest(config, args.get("trained_agent") or ""),
        **{name: versions.get(name) for name in VERSIONS},
        "commit": result.get("commit"),
        "platform": result.get("platform"),
        "path": str(path),
    }


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True, default=str)


def _limits(limits: Iterable[float]) -> str:
    """Limits as ``--cost-limit`` takes them."""
    return " ".join(f"{limit:.12g}" for limit in limits)


def _digest(config: Mapping[str, Any], start: str) -> str:
    """
    The same for runs that differ in nothing but what has a column of its own.

    :param start: the model that training started from
    """
    columns = ("n_timesteps", "cost_limit", "env_kwargs")
    rest = {name: value for name, value in config.items() if name not in columns}
    return hashlib.sha256(_text([rest, start]).encode()).hexdigest()[:8]


# One run's episodes


def read_episodes(path: str | Path) -> pd.DataFrame:
    """
    All training episodes of a run.

    :return: ``step`` at which the episode ended, ``J_r``, ``M_c`` (NaN where a physics error ended
        it), of several costs also ``M_c/<key>``, and ``rho_c`` (cumulative cost ÷ steps until then)
    :raises UsageError: there is no ``0.monitor.csv``, or it is damaged
    """
    file = Path(path) / "0.monitor.csv"
    with explained(f"can't read {file}", OSError, ValueError, KeyError):
        text = pd.read_csv(file, skiprows=1, keep_default_na=False, dtype=str)
        text = text.filter(regex="^([rlc]|c_.*)$")
        table = text.astype(float)
        steps = table.pop("l").cumsum()
        rate = table["c"].cumsum() / steps
    if not len(table) or text.isna().any(axis=None) or table["r"].isna().any():
        raise UsageError(f"can't use {file}: it has no episodes, or is truncated")
    names = {"r": "J_r", "c": "M_c"}
    table.columns = [names.get(name, f"M_c/{name[2:]}") for name in map(str, table)]
    return table.assign(step=steps, rho_c=rate)


def read_curve(path: str | Path, epoch: float = math.nan) -> pd.DataFrame:
    """
    How a run went, epoch by epoch.

    :param path: the run folder
    :param epoch: steps per point; NaN or too few: 1/200 of the run
    :return: ``step`` (the end of an epoch), ``J_r``, ``M_c`` and ``M_c/<key>`` (means over the
        episodes that ended in it), and ``rho_c`` (cumulative cost ÷ steps of all episodes until
        then)
    :raises UsageError: see :func:`read_episodes`
    """
    table = read_episodes(path)
    total = table["step"].iloc[-1]
    rollout = epoch if epoch > 0 else total / CURVE_POINTS
    size = rollout * max(1, math.ceil(total / rollout / CURVE_POINTS))
    epochs = table.groupby(np.ceil(table["step"] / size) * size)
    return epochs.mean().assign(rho_c=epochs["rho_c"].last()).drop(columns="step").reset_index()


# Which runs


def choose(
    runs: pd.DataFrame,
    suites: Sequence[str] | None = None,
    cost_limit: Sequence[float] | None = None,
) -> pd.DataFrame:
    """
    The runs that are asked for.

    :param suites: None: all. The version may be left out
    :param cost_limit: runs of this limit for each cost, and the unconstrained ones; None: all
    :raises UsageError: an environment or limit without runs
    """
    if suites is not None:
        names = {suite: _names(suite) for suite in sorted({*runs["suite"]})}
        for suite in suites:
            if suite not in set().union(*names.values()):
                raise UsageError(f"there is no run of {suite!r}; {did_you_mean(suite, names)}")
        runs = runs[[not names[suite].isdisjoint(suites) for suite in runs["suite"]]]
    if cost_limit is not None:
        limit = _limits(cost_limit)
        if limit not in {*runs["limits"]}:
            hint = did_you_mean(limit, map(str, _values(runs["limits"])))
            raise UsageError(f"there is no run at cost limit {limit}; {hint}")
        runs = runs[runs["limits"].isna() | (runs["limits"] == limit)]
    return runs.reset_index(drop=True)


def shorter(runs: pd.DataFrame) -> dict[str, str]:
    """By its path, the length of a run of whose algorithm and environment there is a longer one."""
    longest = runs.groupby(["suite", "algo"])["steps"].transform("max")
    short = runs[runs["steps"] < longest]
    why = "{:,} steps, where the longest run of this algorithm here has {:,}".format
    return dict(zip(short["path"], map(why, short["steps"], longest[short.index]), strict=True))


def _names(suite: str) -> set[str]:
    """An environment with and without its version."""
    return {suite, f"{suite}-v0", re.sub(r"-v\d+$", "", suite)}


def select(runs: pd.DataFrame) -> pd.DataFrame:
    """
    The runs that may be averaged: of runs that are the same, seed included, the last one counts.

    :raises UsageError: an environment has several cost limits or ``env_kwargs``, or an algorithm
        on it several lengths, hyperparameters or models that training started from
    """
    other = "give the folders of one kind only"
    for column, name, keys, fix in (
        ("limits", "cost limit", ["suite"], "choose one, such as --cost-limit {}"),
        ("world", "env_kwargs", ["suite"], other),
        ("steps", "length", ["suite", "algo"], other),
        ("config", "hyperparameters or the model they started from", ["suite", "algo"], other),
    ):
        for key, group in runs.groupby(keys):
            values = _values(group[column])
            if len(values) > 1:
                where, there = " of ".join(map(str, key)), ", ".join(map(str, values))
                raise UsageError(
                    f"runs on {where} differ in {name}, {there}, and can't be averaged; "
                    + fix.format(values[-1])
                )
    return runs.drop_duplicates(["suite", "algo", "seed"], keep="last").reset_index(drop=True)


def _values(column: "pd.Series[Any]") -> list[Any]:
    """The values that there are."""
    return sorted(column.dropna().unique(), key=_natural)

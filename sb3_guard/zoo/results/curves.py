"""How a run went: the episodes of its monitor file, and its learning curve."""

import math
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_guard.zoo.cli.usage import UsageError, explained

CURVE_POINTS = 200  # at most as many per run, of epochs taken together


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

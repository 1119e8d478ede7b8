"""Learning curves, and figures to read safety off at a glance; ``paper.py`` has the paper's."""

import html
import io
from collections.abc import Callable, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_guard.zoo.results.figure_data import INK, Data
from sb3_guard.zoo.results.statistics import mean_curve
from sb3_guard.zoo.results.tables import HEADINGS, written

FORMATS = ("png", "svg", "pdf")
WIDTH = 8.0  # inches: at the width of a page, text has the size of the page's
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 9,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.axisbelow": True,
    "figure.constrained_layout.wspace": 0.03,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "svg.hashsalt": "sb3_guard",  # the same figure is the same file
    **{
        key: INK
        for key in ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color",
                    "grid.color")
    },
}  # fmt: skip


# Elements


def fit_costs(axis: Axes, limit: float, way: str = "y") -> None:
    """
    Let a cost axis have 0 and the limit, and end at five times the limit if costs go beyond.

    :param limit: the cost limit; nan without one
    :param way: which axis, ``x`` or ``y``
    """
    lowest, high = getattr(axis.dataLim, f"{way}0"), getattr(axis, f"get_{way}lim")()[1]
    end = min(high, 5 * limit) if limit > 0 else high
    getattr(axis, f"set_{way}lim")(1.1 * min(lowest, 0.0), end)


def name_of(column: str) -> str:
    """What an axis calls a column."""
    return HEADINGS.get(column, f"episode cost, {column[4:]}")


def draw_limit(line: Callable[..., Any], data: Data, suite: str, cost: str) -> float:
    """Mark the cost limit of an environment's runs with an axis's axhline or axvline."""
    column = cost.replace("M_c", "cost_limit", 1)
    limits = data.runs.loc[data.runs["suite"] == suite, column].dropna()
    if not len(limits):
        return np.nan
    name = f"{'cost' if cost == 'M_c' else cost[4:]} limit, {limits.iloc[0]:g}"
    line(limits.iloc[0], color=INK, linewidth=1.2, linestyle=(0, (1, 2)), label=name)
    return float(limits.iloc[0])


def draw_curves(axis: Axes, data: Data, suite: str, metric: str) -> None:
    """Draw one figure of merit against steps: means of the seeds, shaded ± their deviation."""
    for algo in data.algos(suite):
        curves = [curve for curve in data.curves(suite, algo) if metric in curve]
        if not curves:
            continue
        table, look = mean_curve(curves, metric), data.looks[algo]
        steps = table.index.to_numpy()
        axis.plot(steps, table["mean"], linewidth=1.5, **look.line)
        if len(curves) > 1:
            low, high = table["mean"] - table["std"], table["mean"] + table["std"]
            axis.fill_between(steps, low, high, color=look.color, alpha=0.15, linewidth=0)
    axis.set(xlabel="steps", ylabel=name_of(metric).replace(", ", ",\n"))
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.set_xlim(left=0)
    if metric.startswith("M_c"):
        fit_costs(axis, draw_limit(axis.axhline, data, suite, metric))


def draw_pareto(axis: Axes, data: Data, suite: str, cost: str = "M_c") -> None:
    """Return against an episode cost: means ± deviations, and the seeds as small marks."""
    means = data.means[(data.means["suite"] == suite)].dropna(subset=[cost, "J_r"])
    limit = draw_limit(axis.axvline, data, suite, cost)
    for row in means.to_dict("records"):
        look, seeds = data.looks[row["algo"]], data.runs_of(suite, row["algo"])
        style: dict[str, Any] = {"color": look.color, "marker": look.marker}
        axis.scatter(seeds[cost], seeds["J_r"], s=14, alpha=0.6, **style)
        axis.errorbar(
            row[cost], row["J_r"], row["J_r_std"], row[f"{cost}_std"], markersize=8.5,
            elinewidth=0.9, capsize=2, zorder=3, linestyle="none", label=look.label, **style,
        )  # fmt: skip
    axis.set(xlabel=name_of(cost), ylabel="return", title=title_of(data, suite))
    axis.margins(0.08)
    fit_costs(axis, limit, "x")
    if not np.isnan(limit) and limit < (end := axis.get_xlim()[1]):
        axis.axvspan(limit, end, color=INK, alpha=0.1, linewidth=0, label="above the limit")


def finish(figure: Figure) -> None:
    """Add one legend for all panels, above them, where it covers nothing."""
    entries: dict[str, Any] = {}
    for axis in figure.axes:
        for handle, name in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(name, handle)
    if entries:
        rows = -(-len(entries) // max(round(figure.get_figwidth() / 2), 1))
        figure.legend(
            [*entries.values()], [*entries], loc="outside upper center",
            ncols=-(-len(entries) // rows), handlelength=2.6,
        )  # fmt: skip


def title_of(data: Data, suite: str) -> str:
    """An environment, with the number of seeds and the longest training of its runs."""
    means = data.means[data.means["suite"] == suite]
    few, many = int(means["seeds"].min()), int(means["seeds"].max())
    seeds = f"{many} seed{'s' * (many > 1)}" if few == many else f"{few} to {many} seeds"
    return f"{suite}: {seeds}, {EngFormatter(sep='')(means['steps'].max())} steps"


def curves_of(data: Data, suites: Sequence[str]) -> Figure | None:
    """One row of panels per environment that has runs: return, episode costs, cost rate."""
    drawn = [suite for suite in suites if suite in data.suites]
    if not drawn:
        return None
    columns = max(len(data.panels(suite)) for suite in drawn)
    size = WIDTH * columns / 3, 0.8 + 2.2 * len(drawn)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(drawn), columns, squeeze=False)
    for row, suite in zip(grid, drawn, strict=True):
        for axis, metric in zip_longest(row, data.panels(suite)):
            if metric is None:
                axis.set_axis_off()
            else:
                draw_curves(axis, data, suite, metric)
        row[1].set_title(title_of(data, suite), fontweight="bold")
    return figure


def curves(data: Data, suite: str) -> Figure | None:
    """Return, episode cost and cost rate against steps, a figure per environment."""
    return curves_of(data, [suite])


def pareto(data: Data, suite: str) -> Figure:
    """Return against each cost and the limit, a figure per environment."""
    costs = data.costs(suite)
    width = WIDTH * (0.7 if len(costs) == 1 else 0.5 * len(costs))
    figure = Figure(figsize=(width, 0.6 * WIDTH), layout="constrained")
    for axis, cost in zip(figure.subplots(1, len(costs), squeeze=False)[0], costs, strict=True):
        draw_pareto(axis, data, suite, cost)
    return figure


# Files


def save(figure: Figure, path: Path) -> None:
    """
    Write a figure in the format of the file's name, PNG, SVG or PDF, with a transparent background.

    :raises UsageError: the file can't be written
    """
    # No dates: the same figure is the same file.
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(path.suffix[1:])
    with mpl.rc_context(STYLE), written(path) as file:
        figure.savefig(
            file, format=path.suffix[1:], dpi=180, transparent=True, metadata=metadata
        )  # fmt: skip


def inline_svg(figure: Figure, title: str) -> str:
    """A figure as part of an HTML page: its ink is the page's text colour."""
    buffer = io.StringIO()
    nothing: Any = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format="svg", transparent=True, metadata=nothing)
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    return text.replace("<svg ", f'<svg role="img" aria-label="{html.escape(title)}" ', 1)

"""Learning curves, return against cost, and the questions Q1–Q8 of GUARD (arXiv 2305.13681)."""

import html
import io
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import chain, product, zip_longest
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_guard.zoo.grids.presets import GHOSTS, HAZARDS, MAIN8, OPTIONS, RADAR4, ROBOTS
from sb3_guard.zoo.results.figure_data import COLORS, INK, Data
from sb3_guard.zoo.results.runs import REFERENCE
from sb3_guard.zoo.results.statistics import SCORES, mean_curve
from sb3_guard.zoo.results.tables import HEADINGS, SCORE_HEADINGS, number, written

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


def mark_beyond(axis: Axes, value: float, other: float, color: str, way: str = "y") -> None:
    """Draw an arrow at the end of a cost axis, with the number of a mean that lies beyond it."""
    end, before = getattr(axis, f"get_{way}lim")()[1], len(axis.texts)
    if value <= end:
        return
    # Neighbours stand above and below, or side by side.
    place, text = ((end, other), (-22, 0)) if way == "x" else ((other, end), (-26 * before, -22))
    axis.annotate(
        number(value, int(value < 10)), place, text, textcoords="offset points", color=color,
        fontsize=8, ha="right", va="bottom" if way == "x" and before % 2 else "top",
        arrowprops={"arrowstyle": "->", "color": color, "shrinkA": 0, "shrinkB": 0},
    )  # fmt: skip


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
    ends = []
    for algo in data.algos(suite):
        curves = [curve for curve in data.curves(suite, algo) if metric in curve]
        if not curves:
            continue
        table, look = mean_curve(curves, metric), data.looks[algo]
        steps = table.index.to_numpy()
        axis.plot(steps, table["mean"], linewidth=1.5, **look.line)
        ends.append((steps[-1], table["mean"].iloc[-1], look.color))
        if len(curves) > 1:
            low, high = table["mean"] - table["std"], table["mean"] + table["std"]
            axis.fill_between(steps, low, high, color=look.color, alpha=0.15, linewidth=0)
    axis.set(xlabel="steps", ylabel=name_of(metric).replace(", ", ",\n"))
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.set_xlim(left=0)
    if metric.startswith("M_c"):
        fit_costs(axis, draw_limit(axis.axhline, data, suite, metric))
        for steps, value, color in ends:
            mark_beyond(axis, value, steps, color)


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
    for row in means.to_dict("records"):
        mark_beyond(axis, row[cost], row["J_r"], data.looks[row["algo"]].color, "x")
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


def curves(data: Data, *suites: str) -> Figure | None:
    """Return, episode cost and cost rate against steps, a figure per environment."""
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


def pareto(data: Data, suite: str) -> Figure:
    """Return against each cost and the limit, a figure per environment."""
    costs = data.costs(suite)
    width = WIDTH * (0.7 if len(costs) == 1 else 0.5 * len(costs))
    figure = Figure(figsize=(width, 0.6 * WIDTH), layout="constrained")
    for axis, cost in zip(figure.subplots(1, len(costs), squeeze=False)[0], costs, strict=True):
        draw_pareto(axis, data, suite, cost)
    return figure


# The paper's

# Environments whose scores are averaged, by what an axis calls them
Places = Mapping[str, Sequence[str]]
BY_ROBOT: Places = {f"{r}\n{ROBOTS[r]}": [suite] for r, suite in zip(ROBOTS, HAZARDS, strict=True)}


def draw_scores(axis: Axes, data: Data, places: Places, lines: Sequence[str], score: str) -> None:
    """Draw a score of some algorithms or families, and TRPO's, which is 1; gaps stay gaps."""
    for line in lines:
        look = data.looks[line]
        rows = [[data.score(suite, line, score) for suite in suites] for suites in places.values()]
        means = [pd.Series(row).mean() for row in rows]
        axis.plot([*places], means, marker=look.marker, linewidth=1.4, **look.line)
    axis.axhline(1, color=INK, linewidth=1, label="TRPO")
    axis.set(ylabel=SCORE_HEADINGS[score], ylim=(min(0, axis.get_ylim()[0]), None))
    axis.tick_params(axis="x", labelsize=6)
    axis.margins(x=0.06)


def panels(
    data: Data, places: Places, lines: Sequence[str], scores: Sequence[str] = ("reward", "cost")
) -> Figure | None:
    """A panel for each score; None if no place has one."""
    lines = [line for line in lines if line in data.looks]
    have = data.scores[[*scores]].dropna(how="all").index
    if have.intersection([*product(chain(*places.values()), lines)]).empty:
        return None
    figure = Figure(figsize=(WIDTH, 3.4), layout="constrained")
    for axis, score in zip(figure.subplots(1, len(scores)), scores, strict=True):
        draw_scores(axis, data, places, lines, score)
    return figure


def q1(data: Data) -> Figure | None:
    """Overall results: learning curves of the paper's eight main environments."""
    return curves(data, *MAIN8)


def q2(data: Data) -> Figure | None:
    """Difficulty of constraints: TRPO's cost per robot, and every algorithm, Hazards to Ghosts."""
    costs = pd.DataFrame(
        {
            f"8 {kind}": [data.score(f"Goal_{r}_8{kind}", REFERENCE, "M_c") for r in ROBOTS]
            for kind in ("Hazards", "Ghosts")
        },
        index=[*ROBOTS],
    )
    if costs.isna().all(axis=None):
        return None
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    costs.plot.bar(ax=left, color=[*COLORS[:2]], legend=False, ylabel="episode cost of TRPO")
    places = {"Goal_Point,\nHazards": HAZARDS[:1], "Ghosts": GHOSTS[:1]}
    draw_scores(right, data, places, algorithms(data), "cost")
    return figure


def algorithms(data: Data) -> list[str]:
    """All algorithms but TRPO."""
    return [algo for algo in data.looks if algo not in {REFERENCE, *data.families}]


def q3(data: Data) -> Figure | None:
    """Families of algorithms: their scores on four environments."""
    places = {suite.replace("_", "\n"): [suite] for suite in RADAR4}
    return panels(data, places, data.families, [*SCORES.values()])


def q4(data: Data) -> Figure | None:
    """Task complexity: each family on robots of more and more degrees of freedom."""
    return panels(data, BY_ROBOT, data.families)


def q5(data: Data) -> Figure | None:
    """Adaptive multiplier: TRPO-Lagrangian against TRPO-FAC."""
    return panels(data, BY_ROBOT, ("trpo_lag", "trpo_fac"))


def q6(data: Data) -> Figure | None:
    """Feasibility projection: CPO against PCPO."""
    return panels(data, BY_ROBOT, ("cpo", "pcpo"))


def q7(data: Data) -> Figure | None:
    """Linearised cost dynamics: TRPO-USL against TRPO-SL."""
    return panels(data, BY_ROBOT, ("trpo_usl", "trpo_sl"))


def q8(data: Data) -> Figure | None:
    """Every algorithm, every task: five task options, each a mean over the robots there are."""
    places = {option: [name.format(robot) for robot in ROBOTS] for option, name in OPTIONS.items()}
    return panels(data, places, algorithms(data), [*SCORES.values()])


PER_SUITE = (curves, pareto)
FIGURES: dict[str, Callable[..., Figure | None]] = {
    function.__name__: function for function in (*PER_SUITE, q1, q2, q3, q4, q5, q6, q7, q8)
}


def draw(kind: str, data: Data) -> dict[str, Figure]:
    """
    The figures of one kind that have runs, by name, in the house's style.

    :param kind: a key of :data:`FIGURES`
    """
    function, drawn = FIGURES[kind], {}
    with mpl.rc_context(STYLE):
        for suite in data.suites if function in PER_SUITE else [""]:
            figure = function(data, *([suite] if suite else []))
            if figure is not None:
                finish(figure)
                drawn[re.sub("[/:]", "-", f"{kind}_{suite}" if suite else kind)] = figure
    return drawn


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

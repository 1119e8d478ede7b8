"""The figures of the GUARD paper's questions, Q1–Q8 (arXiv 2305.13681)."""

import re
from collections.abc import Callable, Iterable

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sb3_guard.zoo.grids.presets import GHOSTS, HAZARDS, MAIN8, OPTIONS, PRESETS, RADAR4, ROBOTS
from sb3_guard.zoo.results.figure_data import COLORS, DASHES, INK, Data, Look
from sb3_guard.zoo.results.figures import (
    STYLE,
    WIDTH,
    Drawing,
    cdf,
    curves,
    curves_of,
    finish,
    fit_costs,
    iqm,
    pareto,
    tiers,
)
from sb3_guard.zoo.results.runs import REFERENCE
from sb3_guard.zoo.results.statistics import SCORES
from sb3_guard.zoo.results.tables import SCORE_HEADINGS

SPOKES = {"reward": "reward", "cost": "cost", "cost_rate": "cost\nrate"}
POLYGONS = {
    score: Look(score.replace("_", " "), color, dashes, "o")
    for score, color, dashes in zip(SCORES.values(), COLORS, DASHES, strict=False)
}


def q1(data: Data) -> Figure | None:
    """Overall results: learning curves of the paper's eight main environments."""
    return curves_of(data, MAIN8)


def q2(data: Data) -> Figure | None:
    """Difficulty of constraints: TRPO's cost per robot, and every algorithm, Hazards to Ghosts."""
    pair, have = ("Hazards", "Ghosts"), data.scores.index
    robots = [r for r in ROBOTS if any((f"Goal_{r}_8{k}", REFERENCE) in have for k in pair)]
    if not robots:
        return None
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    left, *others = figure.subplots(1, 3, width_ratios=(1.7, 1, 1))
    for offset, kind, color, hatch in zip((-0.2, 0.2), pair, COLORS, ("", "//"), strict=False):
        rows = data.scores.reindex([(f"Goal_{robot}_8{kind}", REFERENCE) for robot in robots])
        left.bar(
            np.arange(len(robots)) + offset, rows["M_c"], 0.38, yerr=rows["M_c_std"], color=color,
            hatch=hatch, edgecolor=INK, ecolor=INK, capsize=2, label=f"8 {kind}",
        )  # fmt: skip
    fit_costs(left, [bar.get_height() for bar in left.patches])
    left.set_xticks(range(len(robots)), robots, rotation=60)
    left.set(ylabel="episode cost of TRPO", title="Goal, every robot")
    left.grid(axis="x", visible=False)
    for axis, score in zip(others, ("reward", "cost"), strict=True):
        for algo, look in data.looks.items():
            values = [data.score(suite, algo, score) for suite in (HAZARDS[0], GHOSTS[0])]
            if algo not in data.families and not np.isnan(values).all():
                axis.plot(pair, values, marker=look.marker, **look.line)
        axis.set(ylabel=SCORE_HEADINGS[score], title="Goal, Point", xlim=(-0.3, 1.3))
        mark_trpo(axis)
    return figure


def mark_trpo(axis: Axes) -> None:
    """TRPO's own score is 1."""
    axis.axhline(1, color=INK, linewidth=1, label="TRPO")
    low, high = axis.get_ylim()
    axis.set_ylim(min(0, low), max(1.06, high))


def q3(data: Data) -> Figure | None:
    """Families of algorithms: scores on four environments, a polygon per family."""
    spiders = {
        suite: {
            family: [data.score(suite, family, score) for score in SCORES.values()]
            for family in data.families
            if (suite, family) in data.scores.index
        }
        for suite in RADAR4
        if not np.isnan(data.score(suite, REFERENCE, "cost"))
    }
    spiders = {suite: polygons for suite, polygons in spiders.items() if polygons}
    spokes = {suite: [*SPOKES.values()] for suite in spiders}
    return draw_spiders(spiders, spokes, data.looks) if spiders else None


def draw_spiders(
    spiders: dict[str, dict[str, list[float]]],
    spokes: dict[str, list[str]],
    looks: dict[str, Look],
) -> Figure:
    """
    Spider plots, TRPO's boundary at 1; a missing value leaves a gap.

    :param spiders: values by title and name of a polygon
    :param spokes: what they are of, by title
    :param looks: by name of a polygon
    """
    columns = min(4, len(spiders))
    rows = -(-len(spiders) // columns)
    size = (WIDTH * max(columns, 2) / 4, 2.7 * rows + 0.6)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, subplot_kw={"projection": "polar"})
    for axis, (title, polygons) in zip(grid.flat, spiders.items(), strict=False):
        angles = 2 * np.pi * np.arange(len(spokes[title]) + 1) / len(spokes[title])
        axis.set_theta_offset(np.pi / 2)
        axis.plot(angles, np.ones(len(angles)), color=INK, linewidth=1.2, label="TRPO")
        for polygon, values in polygons.items():
            look, closed = looks[polygon], [*values, values[0]]
            axis.plot(angles, closed, linewidth=1.5, marker=look.marker, markersize=4, **look.line)
            if not np.isnan(values).any():
                axis.fill(angles, closed, color=look.color, alpha=0.1)
        highest = np.nanmax([1.1, *(value for values in polygons.values() for value in values)])
        axis.set_ylim(0, 1.05 * highest)
        axis.set_xticks(angles[:-1], spokes[title])
        axis.tick_params(axis="x", pad=6, labelsize=7)
        axis.tick_params(axis="y", labelsize=7)
        axis.yaxis.set_major_locator(MaxNLocator(4))
        axis.spines["polar"].set_visible(False)
        axis.set_title(title, fontweight="bold", fontsize=8)
    for axis in grid.flat[len(spiders) :]:
        axis.remove()
    return figure


def by_robot(data: Data, lines: Iterable[str]) -> Figure | None:
    """Scores on Goal with 8 hazards, robots by degrees of freedom."""
    suites = dict(zip(ROBOTS, HAZARDS, strict=True))
    lines = [line for line in lines if line in data.looks]
    shown = [
        robot
        for robot, suite in suites.items()
        if any(not np.isnan(data.score(suite, line, s)) for line in lines for s in SCORES.values())
    ]
    if not shown:
        return None
    figure = Figure(figsize=(WIDTH, 3.4), layout="constrained")
    ticks = [f"{robot}\n{ROBOTS[robot]}" for robot in shown]
    for axis, score in zip(figure.subplots(1, 2), ("reward", "cost"), strict=True):
        for line in lines:
            look, values = data.looks[line], [data.score(suites[r], line, score) for r in shown]
            axis.plot(ticks, values, marker=look.marker, linewidth=1.4, **look.line)
        axis.set(xlabel="robot, degrees of freedom", ylabel=SCORE_HEADINGS[score])
        axis.tick_params(axis="x", labelsize=7)
        axis.margins(x=0.06)
        mark_trpo(axis)
    return figure


def q4(data: Data) -> Figure | None:
    """Task complexity: each family on robots of more and more degrees of freedom."""
    return by_robot(data, data.families)


def q5(data: Data) -> Figure | None:
    """Adaptive multiplier: TRPO-Lagrangian against TRPO-FAC."""
    return by_robot(data, ("trpo_lag", "trpo_fac"))


def q6(data: Data) -> Figure | None:
    """Feasibility projection: CPO against PCPO."""
    return by_robot(data, ("cpo", "pcpo"))


def q7(data: Data) -> Figure | None:
    """Linearised cost dynamics: TRPO-USL against TRPO-SL."""
    return by_robot(data, ("trpo_usl", "trpo_sl"))


def q8(data: Data) -> Figure | None:
    """Every algorithm, every task: five task options, each a mean over the robots there are."""
    options = {name.format(robot): o for o, name in OPTIONS.items() for robot in ROBOTS}
    scores = [*SCORES.values()]
    table = data.scores[scores].dropna().reset_index()  # of robots that have them all
    table["option"] = table.pop("suite").map(options)
    spiders: dict[str, dict[str, list[float]]] = {}
    spokes: dict[str, list[str]] = {}
    for algo, look in data.looks.items():
        tasks = table[table["algo"] == algo].groupby("option")[scores].agg(["mean", "size"])
        if algo == REFERENCE or algo in data.families or not len(tasks):
            continue
        tasks = tasks.reindex([*OPTIONS])
        spiders[look.label] = {score: tasks[score, "mean"].tolist() for score in scores}
        spokes[look.label] = [
            str(option) if number == len(ROBOTS) else f"{option}\n({number:.0f}/{len(ROBOTS)})"
            for option, number in tasks["cost", "size"].fillna(0).items()
        ]
    return draw_spiders(spiders, spokes, POLYGONS) if spiders else None


PER_SUITE = (curves, pareto, cdf, tiers)
FIGURES: dict[str, Callable[..., Figure | None]] = {
    function.__name__: function for function in (*PER_SUITE, iqm, q1, q2, q3, q4, q5, q6, q7, q8)
}


def draw(kind: str, data: Data) -> list[Drawing]:
    """
    The figures of one kind, in the house's style.

    :param kind: a key of :data:`FIGURES`
    """
    function, drawings = FIGURES[kind], []
    # In figures of one environment the user chooses the algorithms: no others are missing.
    blocks = () if function in PER_SUITE else PRESETS.get(kind, ((data.suites, [REFERENCE]),))
    with mpl.rc_context(STYLE):
        for suite in data.suites if function in PER_SUITE else [""]:
            figure = function(data, *([suite] if suite else []))
            missing = "; ".join(filter(None, (data.missing(*block) for block in blocks)))
            if suite and figure is None:
                missing = f"episodes of {suite}"
            if figure is not None:
                finish(figure, missing)
            name = re.sub("[/:]", "-", f"{kind}_{suite}" if suite else kind)
            drawings.append(Drawing(name, figure, missing))
    return drawings

"""The figures: learning curves, the GUARD paper's Q1–Q8, and what to read safety off at a glance.

A figure is drawn from the runs there are and says which are missing. Colours are Okabe and Ito's,
told apart by colour-blind readers; line styles and markers tell algorithms apart without them.
"""

import io
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from sb3_guard.common.files import replacing
from sb3_guard.zoo.results import (
    CATEGORIES,
    LABELS,
    MAIN8,
    METRICS,
    RADAR4,
    SCORES,
    aggregate,
    by_category,
    interval,
    label,
    mean_curve,
    normalize,
    overall,
    read_curve,
)
from sb3_guard.zoo.usage import UsageError, one_line

FORMATS = ("png", "svg", "pdf")
# Text, axes and TRPO; no other colour is the same, so a dark page can replace it.
INK = "#010203"
BLUE, RED, GREEN, PINK = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, YELLOW = "#E69F00", "#56B4E9", "#F0E442"
# RL-Zoo's algorithms, unconstrained baselines, are grey.
BASELINES = ("ppo", "sac", "td3", "tqc", "ddpg", "a2c", "crossq", "ppo_lstm", "dqn", "qrdqn")
GREYS = ("#777777", "#A5A5A5", "#555555")
GREY_DASHES: tuple[Any, ...] = ("-", (0, (4, 2)), (0, (1, 1)), (0, (4, 1, 1, 1)))
COLORS = {
    "trpo": INK,
    "cpo": BLUE,
    "pcpo": SKY,
    "trpo_lag": RED,
    "trpo_fac": ORANGE,
    "trpo_ipo": YELLOW,
    "trpo_sl": GREEN,
    "trpo_usl": PINK,
    "Lagrangian": RED,
    "CPO-based": BLUE,
    "hierarchical": GREEN,
}
MARKERS = dict(zip(LABELS, "oDdsv^P*", strict=True)) | {
    "Lagrangian": "s", "CPO-based": "D", "hierarchical": "P",
}  # fmt: skip
DASHES = {"Lagrangian": "-", "CPO-based": (0, (5, 1.5)), "hierarchical": (0, (1.5, 1))}
AXES = {"J_r": "return", "M_c": "episode cost", "rho_c": "cost rate, per step"}
SCORE_AXES = {
    "reward": "reward / TRPO's",
    "cost": "episode cost / TRPO's",
    "cost_rate": "cost rate / TRPO's",
}
SPOKES = {"reward": "reward", "cost": "cost", "cost_rate": "cost\nrate"}
STYLE: dict[Any, Any] = {
    "font.size": 11,
    "axes.labelsize": 11,
    "axes.titlesize": 11,
    "legend.fontsize": 10,
    "xtick.labelsize": 10,
    "ytick.labelsize": 10,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.2,
    "axes.axisbelow": True,
    "figure.constrained_layout.wspace": 0.03,
    "svg.hashsalt": "sb3_guard",  # the same figure is the same file
    **{
        key: INK
        for key in ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color",
                    "grid.color")
    },
}  # fmt: skip

# The paper's robots by degrees of freedom, the number of actions
ROBOTS = {
    "Point": 2, "Swimmer": 2, "Arm3": 3, "Drone": 4, "Hopper": 5, "Arm6": 6, "Humanoid": 6,
    "Ant": 8, "Walker": 10,
}  # fmt: skip
OPTIONS = {
    "Goal\nHazards": "Goal_{}_8Hazards",
    "Goal\nGhosts": "Goal_{}_8Ghosts",
    "Push": "Push_{}_8Hazards",
    "Chase": "Chase_{}_8Hazards",
    "Defense": "Defense_{}_8Hazards",
}
SAFE = tuple(algo for algo in LABELS if algo != "trpo")


class Drawing(NamedTuple):
    """A figure and what it lacks."""

    name: str
    figure: Figure | None  # None: there is nothing to draw
    missing: str = ""  # the runs it lacks, for people


class Data:
    """
    What figures are drawn from, worked out when a figure asks.

    :param runs: see :func:`~sb3_guard.zoo.results.select`
    """

    def __init__(self, runs: pd.DataFrame):
        self.runs = runs
        #: why the curve of a run can't be drawn, by its path
        self.unread: dict[str, str] = {}
        self._curves: dict[str, pd.DataFrame | None] = {}

    @cached_property
    def means(self) -> pd.DataFrame:
        """Means over seeds, see :func:`~sb3_guard.zoo.results.aggregate`."""
        return aggregate(self.runs)

    @cached_property
    def scores(self) -> pd.DataFrame:
        """Means with scores, index suite and algorithm."""
        return normalize(self.means, self.means).set_index(["suite", "algo"])

    @cached_property
    def categories(self) -> pd.DataFrame:
        """Scores of the categories, index suite and category."""
        return by_category(self.scores.reset_index()).set_index(["suite", "category"])

    @property
    def suites(self) -> list[str]:
        """The suites that there are runs of."""
        return list(dict.fromkeys(self.runs["suite"]))

    def algos(self, suite: str) -> list[str]:
        """The algorithms that there are runs of."""
        return list(dict.fromkeys(self.runs.loc[self.runs["suite"] == suite, "algo"]))

    def curves(self, suite: str, algo: str) -> list[pd.DataFrame]:
        """The seeds' learning curves; one that can't be read is left out, see ``unread``."""
        own = self.runs[(self.runs["suite"] == suite) & (self.runs["algo"] == algo)]
        for path, epoch in zip(own["path"], own["epoch"], strict=True):
            if path not in self._curves:
                try:
                    self._curves[path] = read_curve(path, epoch)
                except UsageError as error:
                    self._curves[path] = None
                    self.unread[path] = one_line(error)
        found = (self._curves[path] for path in own["path"])
        return [curve for curve in found if curve is not None]

    def score(self, suite: str, algo: str, name: str) -> float:
        """A score of an algorithm or a category, NaN if there is none."""
        table = self.categories if algo in CATEGORIES else self.scores
        return float(table[name].get((suite, algo), np.nan))

    def missing(self, suites: Iterable[str], algos: Iterable[str] = tuple(LABELS)) -> str:
        """Which algorithms lack runs on which suites, in words."""
        algos = list(algos)
        have = {*zip(self.runs["suite"], self.runs["algo"], strict=True)}
        groups: dict[tuple[str, ...], list[str]] = {}
        for suite in suites:
            absent = tuple(algo for algo in algos if (suite, algo) not in have)
            if absent:
                groups.setdefault(absent, []).append(suite)
        return "; ".join(
            ("all algorithms" if absent == tuple(LABELS) else ", ".join(map(label, absent)))
            + f" on {', '.join(names)}"
            for absent, names in groups.items()
        )


# Curves


def line_style(algo: str) -> dict[str, Any]:
    """How an algorithm, or a category, is drawn wherever it is drawn."""
    if algo not in COLORS:
        rank = BASELINES.index(algo) if algo in BASELINES else len(BASELINES)
        dashes = GREY_DASHES[rank // len(GREYS) % len(GREY_DASHES)]
        return {"color": GREYS[rank % len(GREYS)], "linestyle": dashes}
    category = next((name for name, algos in CATEGORIES.items() if algo in algos), algo)
    style: dict[str, Any] = {"color": COLORS[algo], "linestyle": DASHES.get(category, "-")}
    if algo == "trpo_ipo":  # too pale to stand alone on white
        style["path_effects"] = [
            patheffects.Stroke(linewidth=2.8, foreground="#8a8000"),
            patheffects.Normal(),
        ]
    return style


def draw_curves(axis: Axes, data: Data, suite: str, metric: str) -> None:
    """Draw one figure of merit against steps: means of the seeds, shaded ± their deviation."""
    for algo in data.algos(suite):
        curves = data.curves(suite, algo)
        if not curves:
            continue
        table = mean_curve(curves, metric)
        steps = table.index.to_numpy()
        style = line_style(algo)
        axis.plot(steps, table["mean"], linewidth=1.6, label=label(algo), **style)
        if len(curves) > 1:
            low, high = table["mean"] - table["std"], table["mean"] + table["std"]
            axis.fill_between(steps, low, high, color=style["color"], alpha=0.15, linewidth=0)
    if metric == "M_c":
        draw_limit(axis.axhline, data, suite)
    axis.set(xlabel="steps", ylabel=AXES[metric])
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    axis.set_xlim(left=0)
    if metric != "J_r":
        axis.set_ylim(bottom=0)


def draw_limit(line: Callable[..., Any], data: Data, suite: str) -> None:
    """Mark the cost limit of a suite's constrained runs with an axis's axhline or axvline."""
    limits = data.runs.loc[data.runs["suite"] == suite, "cost_limit"].dropna()
    if len(limits):
        name = f"cost limit, {limits.iloc[0]:g}"
        line(limits.iloc[0], color=INK, linewidth=1, linestyle=(0, (1, 2)), label=name)


def curves_of(data: Data, suites: Sequence[str], name: str, missing: str) -> Drawing:
    """One row of three panels per suite."""
    drawn = [suite for suite in suites if any(data.curves(suite, a) for a in data.algos(suite))]
    if not drawn:
        return Drawing(name, None, missing)
    figure = Figure(figsize=(12, 0.9 + 2.9 * len(drawn)), layout="constrained")
    grid = figure.subplots(len(drawn), 3, squeeze=False)
    for row, suite in zip(grid, drawn, strict=True):
        for axis, metric in zip(row, METRICS, strict=True):
            draw_curves(axis, data, suite, metric)
        row[1].set_title(suite, fontweight="bold")
    add_legend(figure)
    return finish(Drawing(name, figure, missing))


def add_legend(figure: Figure, columns: int = 6) -> None:
    """One legend for all panels, above them, where it covers nothing."""
    entries: dict[str, Any] = {}
    for axis in figure.axes:
        for handle, name in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(name, handle)
    order = {name: rank for rank, name in enumerate((*LABELS.values(), *CATEGORIES))}
    names = sorted(entries, key=lambda name: order.get(name, len(order)))
    rows = -(-len(names) // columns)
    figure.legend(
        [entries[name] for name in names],
        names,
        loc="outside upper center",
        ncols=-(-len(names) // rows),
        handlelength=2.6,
    )


def finish(drawing: Drawing) -> Drawing:
    """Write below a figure what it lacks."""
    if drawing.missing and drawing.figure is not None:
        width = int(drawing.figure.get_figwidth() * 13)
        text = textwrap.shorten(f"Missing: {drawing.missing}", 4 * width, placeholder=" …")
        text = "\n".join(textwrap.wrap(text, width))
        drawing.figure.supxlabel(text, x=0.01, ha="left", fontsize=8, alpha=0.8)
    return drawing


def curves(data: Data) -> Iterator[Drawing]:
    """Return, episode cost and cost rate against steps, a figure per suite."""
    for suite in data.suites:
        # Which algorithms to run is the user's choice here: others are not missing.
        drawing = curves_of(data, [suite], f"curves_{file_name(suite)}", "")
        yield drawing if drawing.figure else drawing._replace(missing=f"0.monitor.csv of {suite}")


def file_name(suite: str) -> str:
    """A suite as part of a file's name."""
    return suite.replace("/", "-").replace(":", "-")


# The paper's questions


def q1(data: Data) -> Iterator[Drawing]:
    """Overall results: learning curves of the paper's eight main suites."""
    yield curves_of(data, MAIN8, "q1", data.missing(MAIN8))


def q2(data: Data) -> Iterator[Drawing]:
    """Difficulty of constraints: TRPO's cost per robot, and every algorithm, Hazards to Ghosts."""
    pair = ("Hazards", "Ghosts")
    bars = [f"Goal_{robot}_8{kind}" for robot in ROBOTS for kind in pair]
    slopes = [f"Goal_Point_8{kind}" for kind in pair]
    missing = "; ".join(filter(None, (data.missing(bars, ["trpo"]), data.missing(slopes, SAFE))))
    robots = [r for r in ROBOTS if any((f"Goal_{r}_8{k}", "trpo") in data.scores.index
                                       for k in pair)]  # fmt: skip
    if not robots:
        yield Drawing("q2", None, missing)
        return
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    left, *others = figure.subplots(1, 3, width_ratios=(1.7, 1, 1))
    for offset, kind, color, hatch in zip((-0.2, 0.2), pair, (BLUE, ORANGE), ("", "//"),
                                          strict=True):  # fmt: skip
        rows = data.scores.reindex([(f"Goal_{robot}_8{kind}", "trpo") for robot in robots])
        left.bar(
            np.arange(len(robots)) + offset, rows["M_c"], 0.38, yerr=rows["M_c_std"], color=color,
            hatch=hatch, edgecolor="white", ecolor=INK, capsize=2, label=f"8 {kind}",
        )  # fmt: skip
    left.set_xticks(range(len(robots)), robots, rotation=35)
    left.set(ylabel="episode cost of TRPO", title="Goal, every robot")
    left.set_xlim(-0.6, max(len(robots), 4) - 0.4)
    left.grid(axis="x", visible=False)
    for axis, score in zip(others, ("reward", "cost"), strict=True):
        for algo in LABELS:
            values = [data.score(suite, algo, score) for suite in slopes]
            if not np.isnan(values).all():
                axis.plot(pair, values, marker=MARKERS[algo], label=label(algo), **line_style(algo))
        axis.set(ylabel=SCORE_AXES[score], title="Goal, Point", xlim=(-0.3, 1.3))
        mark_trpo(axis)
    add_legend(figure)
    yield finish(Drawing("q2", figure, missing))


def mark_trpo(axis: Axes) -> None:
    """TRPO's own score is 1."""
    axis.axhline(1, color=INK, linewidth=1, label="TRPO")
    low, high = axis.get_ylim()
    axis.set_ylim(min(0, low), max(1.06, high))


def q3(data: Data) -> Iterator[Drawing]:
    """Categories: reward, cost and cost rate on four suites, a polygon per category."""
    missing = data.missing(RADAR4)
    shown = [suite for suite in RADAR4 if (data.categories.index.isin([suite], level=0)).any()]
    shown = [s for s in shown if not np.isnan(data.score(s, "trpo", "cost"))]
    if not shown:
        yield Drawing("q3", None, missing)
        return
    figure = Figure(figsize=(3.4 * len(shown) + 0.6, 4.9), layout="constrained")
    grid = figure.subplots(1, len(shown), squeeze=False, subplot_kw={"projection": "polar"})
    for axis, suite in zip(grid[0], shown, strict=True):
        polygons = {
            category: [data.score(suite, category, score) for score in SCORES.values()]
            for category in CATEGORIES
        }
        draw_spider(axis, list(SPOKES.values()), polygons)
        axis.set_title(suite, fontweight="bold", pad=16)
    add_legend(figure)
    yield finish(Drawing("q3", figure, missing))


def draw_spider(axis: Any, spokes: Sequence[str], polygons: dict[str, list[float]]) -> None:
    """A spider plot on polar axes; TRPO's boundary is at 1; a missing value leaves a gap."""
    angles = 2 * np.pi * np.arange(len(spokes) + 1) / len(spokes)
    axis.set_theta_offset(np.pi / 2)
    axis.plot(angles, np.ones(len(angles)), color=INK, linewidth=1.2, label="TRPO")
    for name, values in polygons.items():
        closed = [*values, values[0]]
        style = line_style(name) if name in COLORS else SCORE_STYLES[name]
        marker = MARKERS.get(name, "o")
        axis.plot(angles, closed, linewidth=1.8, marker=marker, markersize=5, label=name, **style)
        if not np.isnan(values).any():
            axis.fill(angles, closed, color=style["color"], alpha=0.1)
    highest = np.nanmax([1.1, *(value for values in polygons.values() for value in values)])
    axis.set_ylim(0, 1.05 * highest)
    axis.set_xticks(angles[:-1], spokes)
    axis.tick_params(axis="x", pad=10)
    axis.yaxis.set_major_locator(MaxNLocator(4))
    axis.tick_params(axis="y", labelsize=8)
    axis.spines["polar"].set_visible(False)


SCORE_STYLES: dict[str, dict[str, Any]] = {
    "reward": {"color": BLUE, "linestyle": "-"},
    "cost": {"color": RED, "linestyle": (0, (5, 1.5))},
    "cost rate": {"color": GREEN, "linestyle": (0, (1.5, 1))},
}


def by_robot(data: Data, name: str, lines: Sequence[str], algos: Sequence[str]) -> Drawing:
    """Scores on Goal with 8 hazards, robots by degrees of freedom."""
    suites = {robot: f"Goal_{robot}_8Hazards" for robot in ROBOTS}
    missing = data.missing(suites.values(), ("trpo", *algos))
    shown = [
        robot
        for robot, suite in suites.items()
        if any(not np.isnan(data.score(suite, line, s)) for line in lines for s in SCORES.values())
    ]
    if not shown:
        return Drawing(name, None, missing)
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    ticks = [f"{robot}\n{ROBOTS[robot]}" for robot in shown]
    for axis, score in zip(figure.subplots(1, 2), ("reward", "cost"), strict=True):
        for line in lines:
            values = [data.score(suites[robot], line, score) for robot in shown]
            axis.plot(
                ticks, values, marker=MARKERS[line], markersize=7, linewidth=1.4,
                label=label(line) if line in LABELS else line, **line_style(line),
            )  # fmt: skip
        axis.set(xlabel="robot, degrees of freedom", ylabel=SCORE_AXES[score])
        axis.margins(x=0.06)
        mark_trpo(axis)
    add_legend(figure)
    return finish(Drawing(name, figure, missing))


def q4(data: Data) -> Iterator[Drawing]:
    """Task complexity: each category on robots of more and more degrees of freedom."""
    yield by_robot(data, "q4", tuple(CATEGORIES), SAFE)


def q5(data: Data) -> Iterator[Drawing]:
    """Adaptive multiplier: TRPO-Lagrangian against TRPO-FAC."""
    yield by_robot(data, "q5", ("trpo_lag", "trpo_fac"), ("trpo_lag", "trpo_fac"))


def q6(data: Data) -> Iterator[Drawing]:
    """Feasibility projection: CPO against PCPO."""
    yield by_robot(data, "q6", ("cpo", "pcpo"), ("cpo", "pcpo"))


def q7(data: Data) -> Iterator[Drawing]:
    """Linearised cost dynamics: TRPO-USL against TRPO-SL."""
    yield by_robot(data, "q7", ("trpo_usl", "trpo_sl"), ("trpo_usl", "trpo_sl"))


def q8(data: Data) -> Iterator[Drawing]:
    """Every algorithm, every task: five task options, each a mean over the robots there are."""
    suites = {o: [name.format(robot) for robot in ROBOTS] for o, name in OPTIONS.items()}
    missing = data.missing(suite for names in suites.values() for suite in names)
    # score, algorithm, option and robot; a mean is over the robots that have one
    values = np.array(
        [
            [[[data.score(suite, algo, score) for suite in row] for row in suites.values()]
             for algo in SAFE]
            for score in SCORES.values()
        ]
    )  # fmt: skip
    number = np.isfinite(values).all(axis=0).sum(axis=-1)  # [algorithm, option]
    polygons = {}
    for a, algo in enumerate(SAFE):
        if np.isfinite(values[:, a]).any():
            means = pd.DataFrame(values[:, a].reshape(-1, len(ROBOTS))).mean(axis=1).to_numpy()
            names = [name.replace("_", " ") for name in SCORES.values()]
            polygons[algo] = dict(zip(names, means.reshape(len(names), -1).tolist(), strict=True))
    if not polygons:
        yield Drawing("q8", None, missing)
        return
    columns = min(4, len(polygons))
    rows = -(-len(polygons) // columns)
    figure = Figure(figsize=(3.4 * columns + 0.4, 3.8 * rows + 0.9), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, subplot_kw={"projection": "polar"})
    for axis, (algo, own) in zip(grid.flat, polygons.items(), strict=False):
        counts = number[SAFE.index(algo)]
        spokes = [
            option if n == len(ROBOTS) else f"{option}\n({n}/{len(ROBOTS)})"
            for option, n in zip(suites, counts, strict=True)
        ]
        draw_spider(axis, spokes, own)
        axis.set_title(label(algo), fontweight="bold", pad=16)
    for axis in grid.flat[len(polygons) :]:
        axis.remove()
    add_legend(figure)
    yield finish(Drawing("q8", figure, missing))


# At a glance


def pareto_front(costs: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """The points that no other beats in both cost and return: their indices, by cost."""
    order = np.lexsort((-returns, costs))
    front, best = [], -np.inf
    for i in order:
        if returns[i] > best:
            front.append(i)
            best = returns[i]
    return np.array(front, dtype=int)


def draw_pareto(axis: Axes, data: Data, suite: str) -> None:
    """Return against episode cost: means large, seeds small, and the front of the means."""
    means = data.means[(data.means["suite"] == suite)].dropna(subset=["M_c", "J_r"])
    runs = data.runs[data.runs["suite"] == suite]
    front = means.iloc[pareto_front(means["M_c"].to_numpy(), means["J_r"].to_numpy())]
    axis.plot(
        front["M_c"], front["J_r"], color=INK, alpha=0.35, linewidth=5, solid_capstyle="round",
        drawstyle="steps-post", label="Pareto front", zorder=1,
    )  # fmt: skip
    draw_limit(axis.axvline, data, suite)
    for row in means.to_dict("records"):
        color = line_style(row["algo"])["color"]
        marker = MARKERS.get(row["algo"], "X")
        own = runs[runs["algo"] == row["algo"]]
        axis.scatter(own["M_c"], own["J_r"], s=18, color=color, marker=marker, alpha=0.6)
        axis.scatter(
            row["M_c"], row["J_r"], s=110, color=color, marker=marker, edgecolor=INK, linewidth=0.7,
            label=label(row["algo"]), zorder=3,
        )  # fmt: skip
    axis.set(xlabel="episode cost $M_c$", ylabel="return $J_r$", title=suite)
    axis.margins(0.08)


def pareto(data: Data) -> Iterator[Drawing]:
    """Return against cost with the Pareto front and the cost limit, a figure per suite."""
    for suite in data.suites:
        name = f"pareto_{file_name(suite)}"
        if not len(data.means[data.means["suite"] == suite].dropna(subset=["M_c", "J_r"])):
            yield Drawing(name, None, suite)
            continue
        figure = Figure(figsize=(6.4, 5.6), layout="constrained")
        draw_pareto(figure.subplots(), data, suite)
        add_legend(figure, 3)
        yield Drawing(name, figure)


def profiles(data: Data) -> Iterator[Drawing]:
    """Performance profiles: the part of all runs that reach a score, with 95 % bands."""
    single = normalize(data.runs, data.means)
    missing = data.missing(data.suites, ["trpo"])
    if single[list(SCORES.values())].isna().all(axis=None):
        yield Drawing("profiles", None, missing)
        return
    figure = Figure(figsize=(13, 4.8), layout="constrained")
    for axis, score in zip(figure.subplots(1, 3), SCORES.values(), strict=True):
        finite = single[score].dropna()
        # Costs have no upper bound: one run must not squeeze all others to the left.
        highest = 1.0 if score == "reward" else max(1.2, float(finite.quantile(0.98)))
        tau = np.linspace(min(0.0, float(finite.quantile(0.02))), highest, 201)

        def reached(values: np.ndarray, axis: int, tau: Any = tau, s: str = score) -> np.ndarray:
            ordered = np.sort(values, axis=axis)
            side: Any = "left" if s == "reward" else "right"
            below = np.stack([np.searchsorted(one, tau, side=side) for one in ordered])
            part = below / values.shape[axis]
            return 1 - part if s == "reward" else part

        for algo, own in single.groupby("algo", sort=False):
            groups = [group.dropna().to_numpy() for _, group in own.groupby("suite")[score]]
            values = np.concatenate(groups)
            if not len(values):
                continue
            style = line_style(str(algo))
            line = reached(values[None], 1)[0]
            axis.plot(tau, line, linewidth=1.7, label=label(str(algo)), **style)
            low, high = interval(groups, reached)
            if not np.isscalar(low):
                axis.fill_between(tau, low, high, color=style["color"], alpha=0.12, linewidth=0)
        sign = "≥" if score == "reward" else "≤"
        axis.set(xlabel=f"{SCORE_AXES[score]}, τ", ylabel=f"part of runs {sign} τ")
        axis.set_ylim(-0.02, 1.02)
    add_legend(figure, 8)
    yield finish(Drawing("profiles", figure, missing))


def iqm(data: Data) -> Iterator[Drawing]:
    """Interquartile means of the scores over runs and suites, with 95 % intervals."""
    missing = data.missing(data.suites, ["trpo"])
    table = overall(data.runs, data.means).set_index("algo")
    table = table.dropna(subset=[f"{score}_iqm" for score in SCORES.values()], how="all")
    if not len(table):
        yield Drawing("iqm", None, missing)
        return
    figure = Figure(figsize=(12, 1.3 + 0.42 * len(table)), layout="constrained")
    rows = np.arange(len(table))[::-1]
    for axis, score in zip(figure.subplots(1, 3, sharey=True), SCORES.values(), strict=True):
        for y, (algo, row) in zip(rows, table.iterrows(), strict=True):
            color = line_style(str(algo))["color"]
            low, high, middle = (row[f"{score}_{end}"] for end in ("low", "high", "iqm"))
            if not np.isnan(low):
                pale = to_rgba(color, 0.5)
                axis.barh(y, high - low, 0.6, left=low, color=pale, edgecolor=INK, linewidth=0.5)
            axis.plot(middle, y, marker="|", markersize=17, markeredgewidth=2, color=INK)
        axis.set_yticks(rows, [label(str(algo)) for algo in table.index])
        axis.set(xlabel=SCORE_AXES[score])
        axis.use_sticky_edges = False
        axis.margins(0.06)
        axis.axvline(1, color=INK, linewidth=1, linestyle=(0, (1, 2)))
        axis.grid(axis="y", visible=False)
    yield finish(Drawing("iqm", figure, missing))


FIGURES: dict[str, Callable[[Data], Iterator[Drawing]]] = {
    "curves": curves, "pareto": pareto, "profiles": profiles, "iqm": iqm,
    "q1": q1, "q2": q2, "q3": q3, "q4": q4, "q5": q5, "q6": q6, "q7": q7, "q8": q8,
}  # fmt: skip


def draw(kind: str, data: Data) -> list[Drawing]:
    """
    The figures of one kind, in the house's style.

    :param kind: a key of :data:`FIGURES`
    """
    with mpl.rc_context(STYLE):
        return list(FIGURES[kind](data))


def panel(draw_on: Callable[[Axes], None], size: tuple[float, float] = (4.4, 3.2)) -> Figure:
    """One panel by itself, without legend or title."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        axis = figure.subplots()
        draw_on(axis)
        axis.set_title("")
    return figure


def save(figure: Figure, path: Path) -> None:
    """
    Write a figure in the format of the file's name: PNG, SVG or PDF.

    :raises UsageError: the file can't be written
    """
    # No dates: the same figure is the same file.
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(path.suffix[1:])
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with mpl.rc_context(STYLE), replacing(path) as file:
            figure.savefig(file, format=path.suffix[1:], dpi=130, metadata=metadata)
    except OSError as error:
        raise UsageError(
            f"can't write to {str(path)!r}: {error.strerror}; choose another folder"
        ) from error


def inline_svg(figure: Figure, title: str) -> str:
    """A figure as part of an HTML page: transparent, its ink the page's text colour."""
    buffer = io.StringIO()
    nothing: Any = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format="svg", transparent=True, metadata=nothing)
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    return text.replace("<svg ", f'<svg role="img" aria-label="{title}" ', 1)

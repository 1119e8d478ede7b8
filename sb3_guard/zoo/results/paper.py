"""The figures of the GUARD paper's questions, Q1–Q8 (arXiv 2305.13681)."""

import re
from collections.abc import Callable, Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_guard.zoo.grids.presets import GHOSTS, HAZARDS, MAIN8, OPTIONS, PRESETS, RADAR4, ROBOTS
from sb3_guard.zoo.results import figures
from sb3_guard.zoo.results.figure_data import COLORS, DASHES, INK, Data, Look
from sb3_guard.zoo.results.figures import STYLE, WIDTH, Drawing, finish
from sb3_guard.zoo.results.runs import REFERENCE
from sb3_guard.zoo.results.statistics import SCORES
from sb3_guard.zoo.results.tables import SCORE_HEADINGS

NAMES = [*SCORES.values()]
POLYGONS = {
    name: Look(name.replace("_", " "), color, dashes, "o")
    for name, color, dashes in zip(NAMES, COLORS, DASHES, strict=False)
}
KINDS = ("Hazards", "Ghosts")


def q1(data: Data) -> Figure | None:
    """Overall results: learning curves of the paper's eight main environments."""
    return figures.curves_of(data, MAIN8)


def q2(data: Data) -> Figure | None:
    """Difficulty of constraints: TRPO's cost per robot, and every algorithm, Hazards to Ghosts."""
    rows = data.scores.reindex(
        [(f"Goal_{robot}_8{kind}", REFERENCE) for kind in KINDS for robot in ROBOTS]
    )
    if rows["M_c"].isna().all():
        return None
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    for number, kind in enumerate(KINDS):
        part = rows.iloc[number * len(ROBOTS) :][: len(ROBOTS)]
        left.bar(
            np.arange(len(ROBOTS)) + 0.4 * number - 0.2, part["M_c"], 0.38, yerr=part["M_c_std"],
            color=COLORS[number], hatch="/" * 2 * number, edgecolor=INK, ecolor=INK,
            label=f"8 {kind}",
        )  # fmt: skip
    left.set_xticks(range(len(ROBOTS)), [*ROBOTS], rotation=60)
    left.set(ylabel="episode cost of TRPO", title="Goal, every robot")
    lines = [algo for algo in data.looks if algo not in data.families]
    draw_scores(right, data, dict(zip(KINDS, (HAZARDS[0], GHOSTS[0]), strict=True)), lines, "cost")
    right.set(title="Goal, Point", xlim=(-0.3, 1.3))
    return figure


def draw_scores(
    axis: Axes, data: Data, suites: Mapping[str, str], lines: Sequence[str], score: str
) -> None:
    """
    Draw a score of some algorithms or families, and TRPO's, which is 1.

    :param suites: environments by what the axis calls them
    """
    for line in lines:
        values, look = (
            [data.score(suite, line, score) for suite in suites.values()],
            data.looks[line],
        )
        if not np.isnan(values).all():
            axis.plot([*suites], values, marker=look.marker, linewidth=1.4, **look.line)
    axis.axhline(1, color=INK, linewidth=1, label="TRPO")
    axis.set(ylabel=SCORE_HEADINGS[score], ylim=(min(0, axis.get_ylim()[0]), None))
    axis.tick_params(axis="x", labelsize=6)


def q3(data: Data) -> Figure | None:
    """Families of algorithms: scores on four environments, a polygon per family."""
    spiders = {
        suite: {
            family: [data.score(suite, family, name) for name in NAMES]
            for family in data.families
            if (suite, family) in data.scores.index
        }
        for suite in RADAR4
        if not np.isnan(data.score(suite, REFERENCE, "cost"))
    }
    spokes = [name.replace("_", "\n") for name in NAMES]
    return draw_spiders({s: (p, spokes) for s, p in spiders.items() if p}, data.looks)


def draw_spiders(
    spiders: Mapping[str, tuple[Mapping[str, list[float]], list[str]]], looks: Mapping[str, Look]
) -> Figure | None:
    """
    Spider plots, TRPO's boundary at 1; a missing value leaves a gap.

    :param spiders: by title, values by name of a polygon, and what the values are of
    :param looks: by name of a polygon
    """
    if not spiders:
        return None
    rows = -(-len(spiders) // 4)
    figure = Figure(figsize=(WIDTH, 2.2 * rows + 0.7), layout="constrained")
    for place, (title, (polygons, spokes)) in enumerate(spiders.items(), 1):
        axis = figure.add_subplot(rows, min(4, len(spiders)), place, projection="polar")
        angles = np.linspace(0, 2 * np.pi, len(spokes) + 1)
        axis.plot(angles, np.ones(len(angles)), color=INK, linewidth=1.2, label="TRPO")
        for name, values in polygons.items():
            look, closed = looks[name], [*values, values[0]]
            axis.plot(angles, closed, marker=look.marker, markersize=4, **look.line)
        axis.set(ylim=(0, None), theta_offset=np.pi / 2)
        axis.set_xticks(angles[:-1], spokes)
        axis.tick_params(labelsize=7)
        axis.set_title(title, fontweight="bold", fontsize=8)
    return figure


def by_robot(data: Data, lines: Sequence[str]) -> Figure | None:
    """Scores on Goal with 8 hazards, robots by degrees of freedom."""
    lines = [line for line in lines if line in data.looks]
    suites = {
        f"{robot}\n{ROBOTS[robot]}": suite
        for robot, suite in zip(ROBOTS, HAZARDS, strict=True)
        if any(not np.isnan(data.score(suite, line, name)) for line in lines for name in NAMES)
    }
    if not suites:
        return None
    figure = Figure(figsize=(WIDTH, 3.4), layout="constrained")
    for axis, score in zip(figure.subplots(1, 2), ("reward", "cost"), strict=True):
        draw_scores(axis, data, suites, lines, score)
        axis.set(xlabel="robot, degrees of freedom")
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
    table = data.scores[NAMES].dropna().reset_index()  # of robots that have them all
    table["option"] = table.pop("suite").map(options)
    spiders = {}
    for algo, group in table.dropna().groupby("algo", sort=False):
        if algo != REFERENCE and algo not in data.families:
            tasks = group.groupby("option")[NAMES].agg(["mean", "size"]).reindex([*OPTIONS])
            counts = tasks["cost", "size"].fillna(0)
            spokes = [
                f"{option}" + f"\n({n:.0f}/{len(ROBOTS)})" * (n < len(ROBOTS))
                for option, n in counts.items()
            ]
            values = {name: tasks[name, "mean"].tolist() for name in NAMES}
            spiders[data.looks[str(algo)].label] = values, spokes
    return draw_spiders(spiders, POLYGONS)


PER_SUITE = (figures.curves, figures.pareto, figures.cdf, figures.tiers)
FIGURES: dict[str, Callable[..., Figure | None]] = {
    function.__name__: function
    for function in (*PER_SUITE, figures.iqm, q1, q2, q3, q4, q5, q6, q7, q8)
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

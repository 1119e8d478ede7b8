"""The figures of the GUARD paper's questions, Q1–Q8 (arXiv 2305.13681)."""

import re
from collections.abc import Callable, Mapping, Sequence

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_guard.zoo.grids.presets import GHOSTS, HAZARDS, MAIN8, OPTIONS, RADAR4, ROBOTS
from sb3_guard.zoo.results import figures
from sb3_guard.zoo.results.figure_data import COLORS, INK, Data
from sb3_guard.zoo.results.figures import STYLE, WIDTH, finish
from sb3_guard.zoo.results.runs import REFERENCE
from sb3_guard.zoo.results.statistics import SCORES
from sb3_guard.zoo.results.tables import SCORE_HEADINGS

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
    """A panel for each score, with the places that have one."""
    lines = [line for line in lines if line in data.looks]
    have = data.scores[list(scores)].dropna(how="all").index
    shown = {
        name: suites
        for name, suites in places.items()
        if any((suite, line) in have for suite in suites for line in lines)
    }
    if not shown:
        return None
    figure = Figure(figsize=(WIDTH, 3.4), layout="constrained")
    for axis, score in zip(figure.subplots(1, len(scores)), scores, strict=True):
        draw_scores(axis, data, shown, lines, score)
    return figure


def q1(data: Data) -> Figure | None:
    """Overall results: learning curves of the paper's eight main environments."""
    return figures.curves_of(data, MAIN8)


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


PER_SUITE = (figures.curves, figures.pareto)
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

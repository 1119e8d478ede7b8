"""Draw the diagrams of the pages into docs/images: ``python scripts/draw_diagrams.py``.

``limits`` shows return and cost at each limit of a training, and ``costs`` the costs of single
episodes, from the logs in docs/data; ``speed`` steps per second, from the tables of docs/speed.md;
``reward_and_cost`` is an annotated picture; ``poster`` has robots, tasks and constraints.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent))

from archives import DATA, unpacked
from results import runs

from sb3_guard.envs import GuardVectorEnv
from sb3_guard.zoo.results.figure_data import COLORS, INK, Data
from sb3_guard.zoo.results.figures import STYLE, WIDTH, save
from sb3_guard.zoo.results.statistics import aggregate

DOCS = Path(__file__).parents[1] / "docs"
IMAGES = DOCS / "images"
SUITE = "Goal_Point_8Hazards"
# Parts of the annotated picture: text, and where text and object are, as shares of the picture.
NOTES: tuple[tuple[str, tuple[float, float], tuple[float, float]], ...] = (
    (
        "goal: reward for each metre closer,\nand a bonus when it is reached",
        (0.46, 0.9),
        (0.19, 0.8),
    ),
    ("hazard: cost for each step inside,\nthe depth in metres", (0.68, 0.36), (0.64, 0.46)),
    ("robot: the beads are its lidar,\nthe dart shows where it faces", (0.22, 0.14), (0.2, 0.29)),
)


def limits() -> Figure:
    """Return and cost against the limit, with TRPO, which has none."""
    means = {}
    for path in DATA.glob("guard_limit*.tar.xz"):
        name = path.name.removesuffix(".tar.xz")
        table = aggregate(runs(name))
        means[int(name.rpartition("limit")[2])] = table[table["suite"] == SUITE].set_index("algo")
    order = sorted(means)
    looks = Data(runs("guard_limit2")).looks
    figure = Figure(figsize=(WIDTH, 3.3), layout="constrained")
    left, right = figure.subplots(1, 2)
    for algo in ("cpo", "trpo_lag", "ppo_lag"):
        for axis, name in ((left, "return_last"), (right, "cost_last")):
            rows = [means[limit].loc[algo] for limit in order]
            spread = np.nan_to_num([row[f"{name}_std"] for row in rows])
            axis.errorbar(
                order, [row[name] for row in rows], spread, capsize=2, marker=looks[algo].marker,
                **looks[algo].line,
            )  # fmt: skip
    trpo = means[2].loc["trpo"]
    left.axhline(trpo["return_last"], color=INK, label="TRPO, no limit")
    right.axhline(trpo["cost_last"], color=INK, label="TRPO, no limit")
    right.plot([0, 10], [0, 10], color=INK, linestyle=(0, (1, 2)), label="cost = limit")
    right.fill_between([0, 10], [0, 10], 10.5, color=INK, alpha=0.1, linewidth=0)
    right.text(0.3, 9.6, "above the limit", fontsize=8)
    left.set(xlabel="cost limit of the training", ylabel="return", ylim=(0, None))
    right.set(xlabel="cost limit of the training", ylabel="episode cost", ylim=(0, 10.5))
    handles, labels = right.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=5)
    left.set_title(f"{SUITE}, 1M steps")
    right.set_title("bars: three seeds; points without: one seed")
    return figure


def speed() -> Figure:
    """Steps per second of Safety-Gymnasium's tasks, here and in the original package."""
    text = (DOCS / "speed.md").read_text()
    row = r"^\| (Safety\w+), (Safety-Gymnasium 1\.0\.0|sb3_guard) \| [\d,]+ \| ([\d,]+) \|"
    steps: dict[str, dict[str, float]] = {}
    for task, package, number in re.findall(row, text, flags=re.MULTILINE):
        steps.setdefault(task, {})[package] = float(number.replace(",", ""))
    figure = Figure(figsize=(WIDTH, 2.6), layout="constrained")
    axis = figure.subplots()
    rows = np.arange(len(steps))[::-1]
    for offset, package, color in (
        (0.2, "sb3_guard", COLORS[0]), (-0.2, "Safety-Gymnasium 1.0.0", INK),
    ):  # fmt: skip
        values = np.array([steps[task][package] for task in steps])
        axis.barh(rows + offset, values, 0.38, color=color, label=package)
        for y, value in zip(rows + offset, values, strict=True):
            axis.text(value * 1.06, y, f"{float(f'{value:.2g}'):,.0f}", va="center", fontsize=8)
    axis.set_yticks(rows, [*steps])
    axis.set(
        xscale="log", xlabel="steps per second on one core (log), resets included", xlim=(100, 2e5)
    )
    axis.grid(axis="y", visible=False)
    figure.legend(loc="outside upper center", ncols=2)
    return figure


def costs() -> Figure:
    """Histograms of the costs of single episodes, with their mean and the limit."""
    suite, limit, width = "SafetyPointGoal1-v0", 25.0, 5.0
    figure = Figure(figsize=(WIDTH, 2.8), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    with unpacked("grand_table") as found:
        data = Data(found.runs)
        of = {algo: data.costs_of(suite, algo, "training") for algo in ("ppo", "cpo")}
    last = width * np.ceil(max(np.percentile(values, 98) for values in of.values()) / width)
    bins = np.arange(0, last + 1, width)
    for axis, (algo, values) in zip(panels, of.items(), strict=True):
        look, share = data.looks[algo], (values > limit).mean()
        weights = np.full(len(values), 100 / len(values))
        axis.hist(values.clip(max=last), bins, weights=weights, color=look.color, alpha=0.8)
        axis.axvline(limit, color=INK, linestyle=(0, (1, 2)), label=f"cost limit, {limit:g}")
        axis.axvline(values.mean(), color=INK, label="mean")
        title = f"{look.label}: mean {values.mean():.0f}, {share:.0%} above the limit"
        axis.set(title=title, xlabel=f"episode cost (last bar: {last - width:g} and more)")
    panels[0].set_ylabel("% of the episodes")
    handles, labels = panels[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2)
    return figure


def reward_and_cost() -> Figure:
    """A robot among hazards from above, with what gives reward and what gives cost."""
    size = 900
    env = GuardVectorEnv(1, SUITE, render_mode="rgb_array", width=size, height=size, camera="top")
    env.reset(seed=3)
    (frame,) = env.render() or ()
    env.close()
    figure = Figure(figsize=(6, 6), layout="constrained")
    axis = figure.subplots()
    axis.imshow(frame, extent=(0, 1, 0, 1))
    axis.set_axis_off()
    for text, at, where in NOTES:
        axis.annotate(
            text, where, at, ha="center", va="center", color="#202020", fontsize=9,
            bbox={"boxstyle": "round", "facecolor": "white", "edgecolor": INK},
            arrowprops={"arrowstyle": "-|>", "color": "#202020"},
        )  # fmt: skip
    return figure


def poster() -> Figure:
    """Robots, tasks and constraints, a block of pictures each."""
    blocks = [
        (kind, [path for path in sorted(IMAGES.glob(f"{kind}_*.png")) if path.stem.count("_") == 1])
        for kind in ("robot", "task", "constraint")
    ]
    columns = 6
    heights = [-(-len(paths) // columns) for _, paths in blocks]
    figure = Figure(figsize=(10, 1.75 * sum(heights) + 0.2), layout="constrained")
    grid = figure.subplots(sum(heights), columns)
    for axis in grid.flat:
        axis.set_axis_off()
    first = 0
    for (kind, paths), rows in zip(blocks, heights, strict=True):
        for number, path in enumerate(paths):
            axis = grid[first + number // columns, number % columns]
            axis.imshow(np.asarray(Image.open(path).convert("RGB")))
            axis.set_title(path.stem.partition("_")[2].capitalize(), fontsize=10)
        grid[first, 0].text(
            -0.04, 0.5, f"{kind}s", rotation=90, fontsize=11, ha="right", va="center",
            transform=grid[first, 0].transAxes,
        )  # fmt: skip
        first += rows
    return figure


DIAGRAMS: dict[str, Callable[[], Figure]] = {
    function.__name__: function for function in (limits, speed, costs, reward_and_cost, poster)
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=[*DIAGRAMS], help="draw only this diagram")
    only = parser.parse_args().only
    for name in [only] if only else DIAGRAMS:
        with mpl.rc_context(STYLE):
            save(DIAGRAMS[name](), IMAGES / f"{name}.png")
        print(name)


if __name__ == "__main__":
    main()

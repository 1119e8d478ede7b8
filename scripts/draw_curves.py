"""Draw the curve of each algorithm's page, from the logs: ``python scripts/draw_curves.py``.

Return, episode cost and cost rate against steps, beside an unconstrained algorithm, from the first
of ``GRIDS`` in ``docs/data`` that has the algorithm, as ``docs/images/curve_<algo>.png``; those of
all algorithms of ``PAPER``, as ``docs/images/curves_<suite>.png``; and a good run of
docs/healthy.md beside a bad one, as ``docs/images/healthy_<algo>.png``.
"""

import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import matplotlib as mpl
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_guard.zoo.figures import COLORS, INK, STYLE, WIDTH, Data, finish, save
from sb3_guard.zoo.paper import draw
from sb3_guard.zoo.runs import read_results

DOCS = Path(__file__).parents[1] / "docs"
# Archives, the suite, and whom an algorithm is beside.
GRIDS = (
    (("safety_gymnasium", "safety_gymnasium_others"), "SafetyPointGoal1-v0", "ppo"),
    (("guard_limit2",), "Goal_Point_8Hazards", "trpo"),
    (("off_policy",), "SafetyPointGoal1-v0", None),
)

# Of docs/benchmark.md, with the paper's settings: archive and suites.
PAPER = {
    "guard_paper": [f"Goal_{robot}_8Hazards" for robot in ("Point", "Drone", "Arm3", "Walker")],
    "goal_point_1m_limit0": ["Goal_Point_8Ghosts"],
}
HAZARDS = "Goal_Point_8Hazards-v0"
# Of docs/healthy.md, a good run and a bad one: label, limit, archive and folder.
HEALTHY = {
    "pcpo": (
        ("seed 23", 2.0, "guard_limit2", f"guard_limit2/pcpo/{HAZARDS}_24"),
        ("seed 22", 2.0, "guard_limit2", f"guard_limit2/pcpo/{HAZARDS}_23"),
    ),
    "trpo_lag": (
        ("default", 2.0, "guard_limit2", f"guard_limit2/trpo_lag/{HAZARDS}_23"),
        ("-conf paper", 0.0, "guard_paper", f"guard_paper/trpo_lag/{HAZARDS}_1"),
    ),
}


def draw_healthy(algo: str) -> Figure:
    """A good and a bad run: return, J_C beside its limit, and what is to keep the limit."""
    rows, columns = (2, 2) if algo == "pcpo" else (1, 3)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.7 + 2.1 * rows), layout="constrained")
        axes = figure.subplots(rows, columns).ravel()
        for (name, limit, archive, folder), color in zip(HEALTHY[algo], COLORS, strict=False):
            with tarfile.open(DOCS / "data" / f"{archive}.tar.xz") as packed:
                file = packed.extractfile(f"{folder}/progress.csv")
                assert file is not None
                log = pd.read_csv(file, index_col="time/total_timesteps")
            log.columns = log.columns.str.rpartition("/").get_level_values(-1)
            means = log.rolling(10, min_periods=3).mean()
            lines = {"return": log["ep_rew_mean"]}
            lines["episode cost"] = means["constraint_violation"] + limit
            if algo == "pcpo":
                lines["cost_margin"] = log["cost_margin"]
                lines["cost_change"] = means["cost_change"]
                axes[3].plot(
                    means["cost_change_promised"], color=color, linestyle=(0, (5, 1.5)),
                    label=f"{name}, promised",
                )  # fmt: skip
            else:
                # In units of cost, as the paper has them, λ is the price.
                lines["price"] = log["price" if "price" in log else "multiplier"]
            for axis, (label, line) in zip(axes, lines.items(), strict=True):
                axis.plot(line, color=color, linewidth=1.5, label=name)
                axis.set(xlabel="steps", ylabel=label, xlim=(0, line.index[-1]))
                axis.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes[1].axhline(limit, color=INK, linestyle=(0, (1, 2)), label=f"limit, {limit:g}")
        for axis in axes[1:3]:
            axis.set_ylim(bottom=0)
        finish(figure, "")
    return figure


@contextmanager
def unpacked(*names: str) -> Iterator[pd.DataFrame]:
    """The runs of packed grids, whose logs are there within the block."""
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            with tarfile.open(DOCS / "data" / f"{name}.tar.xz") as archive:
                archive.extractall(folder, filter="data")
        yield read_results([folder]).runs


def draw_curves(runs: pd.DataFrame, name: str) -> None:
    """Save the curves of runs of a suite as an image."""
    (drawing,) = draw("curves", Data(runs))
    assert drawing.figure is not None, drawing.missing
    save(drawing.figure, DOCS / "images" / f"{name}.png")
    print(name)


def main() -> None:
    left = {page.stem for page in DOCS.glob("algorithms/*.md")}
    for names, suite, reference in GRIDS:
        with unpacked(*names) as runs:
            runs = runs[runs["suite"] == suite]
            for algo in sorted(left & {*runs["algo"]}):
                draw_curves(runs[runs["algo"].isin([algo, reference])], f"curve_{algo}")
                left.remove(algo)
    print("without logs:", *sorted(left))
    for name, suites in PAPER.items():
        with unpacked(name) as runs:
            for suite in suites:
                draw_curves(runs[runs["suite"] == suite], f"curves_{suite}")
    for algo in HEALTHY:
        save(draw_healthy(algo), DOCS / "images" / f"healthy_{algo}.png")


if __name__ == "__main__":
    main()

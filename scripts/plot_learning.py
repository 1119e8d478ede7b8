"""Plot return, episode cost and cost rate of training runs, and print what they reached.

``python scripts/plot_learning.py logs -o docs/images/learning.png`` draws every run below a folder:
one colour per algorithm, a thin line per seed, their mean in bold.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# Okabe and Ito's palette, told apart by colour-blind readers
COLORS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#F0E442"]
EPOCH = 30_000  # steps
LABELS = {"r": "return", "c": "episode cost", "rate": "cost rate, per step"}


def read_run(monitor: Path) -> pd.DataFrame:
    """Means per epoch of one run: columns step, r, c, rate, and the standard error of r."""
    episodes = pd.read_csv(monitor, skiprows=1)
    steps = episodes["l"].cumsum()
    episodes["step"] = np.ceil(steps / EPOCH).astype(int) * EPOCH
    episodes["rate"] = episodes["c"].cumsum() / steps
    groups = episodes.groupby("step")
    out = groups[["r", "c"]].mean()
    out["rate"] = groups["rate"].last()
    out["n"] = groups.size()
    out["var"] = groups["r"].var()
    return out.reset_index()


def report(name: str, run: pd.DataFrame, epochs: int = 5) -> str:
    """One row of the table: first and last epochs of a run, and how far apart their returns are."""
    first, last = run.head(epochs), run.tail(epochs)
    error = np.sqrt(
        (first["var"] / first["n"]).sum() / epochs**2 + (last["var"] / last["n"]).sum() / epochs**2
    )
    gain = (last["r"].mean() - first["r"].mean()) / error
    return (
        f"| {name} | {run['step'].iloc[-1]:,} | {first['r'].mean():.2f} | {last['r'].mean():.2f} "
        f"| {gain:.1f} | {first['c'].mean():.2f} | {last['c'].mean():.2f} "
        f"| {run['rate'].iloc[-1]:.5f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="log folder, <folder>/<algo>/<env>_<k>/")
    parser.add_argument("-o", "--output", type=Path, default=Path("learning.png"))
    parser.add_argument("--env", default="Goal_Point_8Hazards", help="environment to draw")
    args = parser.parse_args()
    runs: dict[str, list[pd.DataFrame]] = {}
    print(f"epochs of {EPOCH:,} steps; first and last mean the first and last five")
    print("| run | steps | return, first | last | gain, s.e. | cost, first | last | cost rate |")
    print("|---|---|---|---|---|---|---|---|")
    for monitor in sorted(args.folder.glob(f"*/{args.env}*_*/0.monitor.csv")):
        algo = monitor.parent.parent.name
        run = read_run(monitor)
        runs.setdefault(algo, []).append(run)
        print(report(f"{algo} {monitor.parent.name}", run))
    if not runs:
        raise SystemExit(f"error: no run of {args.env} below {args.folder}")
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    for (algo, group), color in zip(runs.items(), COLORS, strict=False):
        length = min(len(run) for run in group)
        for axis, key in zip(axes, LABELS, strict=True):
            for run in group:
                axis.plot(run["step"] / 1e6, run[key], color=color, alpha=0.35, linewidth=0.8)
            mean = np.mean([run[key][:length] for run in group], axis=0)
            axis.plot(group[0]["step"][:length] / 1e6, mean, color=color, linewidth=2, label=algo)
    for axis, label in zip(axes, LABELS.values(), strict=True):
        axis.set(xlabel="steps, millions", ylabel=label)
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False, title=args.env)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.output, dpi=110)
    print(f"wrote {args.output}")


if __name__ == "__main__":
    main()

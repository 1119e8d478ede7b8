"""How far our tasks are from Safety-Gymnasium 1.0.0's, over all that was recorded of it.

``python scripts/safety_gymnasium/compare.py`` prints two tables, of all 65 navigation ids
(``tests/data/safety_gymnasium``), with a column or two rows for each robot. What is observed and
rewarded in a recorded state: the largest differences, relative to the value or to 0.01 if that is
more; observations in the files have 21 bits, 4.8e-7. And one control step from a recorded state, by
the physics of another MuJoCo, while the robot and everything else touch nothing but the floor, and
while something touches an object; places in the files have 20 bits after the point, so that half of
that, 4.8e-7 m, is not a difference. The causes are in docs/fidelity.md.

``--velocity`` prints the second for the robots of the velocity tasks, whose files have 24 bits.

``--distributions`` compares 400 recorded layouts, of Button1 and Button2 1,000, with 1,000 of ours,
and 200 random episodes with as many: by chance, 5 % of single comparisons are beyond 0.080 and
0.136.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
from safety_distributions import episode_gaps, layout_gaps
from safety_traces import Trace, load, velocity_steps

from sb3_guard.envs.suites import velocity
from sb3_guard.envs.suites.safety_gymnasium import LEVELS, NAMES
from sb3_guard.zoo.results.tables import table

# what the components of an observation begin with, in the order of the table's rows
QUANTITIES = {
    "lidars": (
        "goal_",
        "box_",
        "button_",
        "circle_",
        "hazards_",
        "vases_",
        "pillars_",
        "gremlins_",
    ),
    "velocimeter, gyro, magnetometer": ("velocimeter", "gyro", "magnetometer"),
    "joints, height, turning": ("joint", "height", "angular_velocity", "ball"),
    "accelerometer": ("accelerometer",),
    "touch": ("touch",),
}
FORCES = ("accelerometer", "touch")


def observed(t: Trace) -> dict[str, float]:
    """The largest difference of each quantity."""
    error, out = t.observation_error(), {}
    for component, where in t.engine.observation_layout.items():
        (quantity,) = (q for q, names in QUANTITIES.items() if component.startswith(names))
        worst = error[:, where].max(axis=1)
        kinds = {quantity: np.ones_like(t.rough)}
        if quantity in FORCES:
            kinds = {quantity: ~t.rough, f"{quantity}, where contacts differ": t.rough}
        for kind, rows in kinds.items():
            out[kind] = max(out.get(kind, 0.0), worst[rows].max(initial=0.0))
    ours, _ = t.rewards()
    out["reward"] = float((np.abs(ours - t["reward"]) / np.maximum(np.abs(ours), 0.01)).max())
    return out


def moved(t: Trace) -> tuple[np.ndarray, np.ndarray]:
    """How far the robot is off after each step, [n], and whether it met something, [n] bool."""
    n, engine = len(t.before), t.engine
    t.set(t.after, t.before)
    met = t.find_rough()[:n]
    met |= np.any([t[key] for key in t.arrays if key.startswith("touched_")] or [met], axis=0)
    t.set(t.before, t.before)
    met |= t.find_rough()[:n]
    actions = np.zeros((t.states, engine.robot.action_size))
    actions[:n] = t.actions
    engine.step(actions)
    others = 7 * sum(len(group.movable) for p in engine.parts for group in p.groups)
    robot = engine.model.nq - others
    ours = engine.batch.bind("qpos")[:n, :robot]
    return np.abs(ours - t["qpos"][t.after, :robot]).max(axis=1), met


def print_velocity() -> None:
    """One control step of the velocity tasks' robots, in contact and in the air."""
    steps = []
    for robot in velocity.TABLE:
        recorded, qpos, _ = velocity_steps(robot)
        off = np.abs(qpos - recorded["next_qpos"]).max(axis=1)
        touching = recorded["contacts"] > 0
        for state, rows in (("touching", touching), ("free", ~touching)):
            if rows.any():
                values = [f"{np.quantile(off[rows], q):.1e}" for q in (0.5, 0.95, 1.0)]
                steps.append([robot, state, f"{int(rows.sum()):,}", *values])
    print(table(["robot", "", "steps", "median, m or rad", "95 %", "largest"], steps))


def print_distributions() -> None:
    """The largest Kolmogorov-Smirnov distances of layouts, and those of random episodes."""
    recorded = load("distributions")
    names = [key.removeprefix("layout_") for key in recorded if key.startswith("layout_")]
    gaps = {name: layout_gaps(name) for name in names if name != "PointRun0"}
    for key in recorded:
        if key.startswith("episodes_"):
            name = key.removeprefix("episodes_")
            gaps[name] = {**gaps.get(name, {}), **episode_gaps(name)}
    columns = ["x, |y|", "distances", "return", "cost", "length"]
    rows = [
        [name, *(f"{found[c]:.3f}" if c in found else "-" for c in columns)]
        for name, found in sorted(gaps.items())
    ]
    print(table(["task", *columns], rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--match", default="", help="only names that contain this")
    parser.add_argument("--distributions", action="store_true", help="layouts and returns instead")
    parser.add_argument("--velocity", action="store_true", help="steps of the velocity tasks")
    args = parser.parse_args()
    if args.velocity:
        return print_velocity()
    if args.distributions:
        return print_distributions()
    worst: dict[str, dict[str, float]] = {}
    steps = []
    for robot in NAMES:
        names = [robot + level for level in LEVELS if args.match in robot + level]
        found = []
        for name in names:
            t = Trace(name)
            for quantity, value in observed(t).items():
                row = worst.setdefault(quantity, {})
                row[robot] = max(row.get(robot, 0.0), value)
            found.append(moved(t))
        if not found:
            continue
        off, met = (np.concatenate(parts) for parts in zip(*found, strict=True))
        for what, which in (("free", ~met), ("touching an object", met)):
            values = [f"{np.quantile(off[which], q):.1e}" for q in (0.5, 0.95, 1.0)]
            steps.append([robot, what, f"{int(which.sum()):,}", *values])
    order = [q for first in (*QUANTITIES, "reward") for q in worst if q.startswith(first)]
    rows = [[q, *(f"{worst[q][r]:.1e}" if r in worst[q] else "-" for r in NAMES)] for q in order]
    print(table(["largest difference", *NAMES], rows))
    print(table(["robot", "", "steps", "median, m or rad", "95 %", "largest"], steps))
    return None


if __name__ == "__main__":
    main()

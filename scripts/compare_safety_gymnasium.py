"""How far one control step of ours is from Safety-Gymnasium 1.0.0's, from the same states.

``python scripts/compare_safety_gymnasium.py`` prints, per robot, the largest deviations over all
recorded steps (``tests/data/safety_gymnasium``): while it touches nothing but the floor, and while
it, or something else, touches an object. Numbers in the files are rounded to 1e-6 m and, of
velocities, to 11 bits: they can't be told apart more closely. The causes are in docs/fidelity.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from safety_traces import Trace

from sb3_guard.envs.suites.safety_gymnasium import LEVELS, NAMES
from sb3_guard.zoo.tables import table


def deviations(name: str) -> tuple[np.ndarray, np.ndarray]:
    """How far the robot is off after each step, [n], and whether it met something, [n] bool."""
    t = Trace(name)
    n, engine = len(t.before), t.engine
    t.set(t.after, t.before)
    met = t.rough[:n].copy()
    met |= np.any([t[key] for key in t.arrays if key.startswith("touched_")] or [met], axis=0)
    t.set(t.before, t.before)
    met |= t.find_rough()[:n]
    actions = np.zeros((t.states, engine.robot.action_size))
    actions[:n] = t.actions
    engine.step(actions)
    robot = len(engine.robot._start)
    others = 7 * sum(
        group.bodies.num for p in engine.parts for group in p.groups if group.bodies.free
    )
    robot -= others
    ours = engine.batch.bind("qpos")[:n, :robot]
    return np.abs(ours - t["qpos"][t.after, :robot]).max(axis=1), met


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--match", default="", help="only names that contain this")
    args = parser.parse_args()
    rows = []
    for robot in NAMES:
        found = [deviations(f"{robot}{level}") for level in LEVELS if args.match in robot + level]
        if not found:
            continue
        off, met = (np.concatenate(parts) for parts in zip(*found, strict=True))
        for what, which in (("free", ~met), ("touching", met)):
            values = [f"{np.quantile(off[which], q):.1e}" for q in (0.5, 0.95, 1.0)]
            rows.append([robot, what, str(int(which.sum())), *values])
    print(table(["robot", "", "steps", "median, m or rad", "95 %", "largest"], rows))


if __name__ == "__main__":
    main()

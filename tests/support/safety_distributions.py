"""Layouts and random episodes of ours beside those recorded of Safety-Gymnasium 1.0.0.

Recorded are the layouts of 400 new episodes, of Button1 and Button2 of 1,000, and return, cost and
length of 200 random episodes of at most 100 steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from safety_traces import load

from sb3_guard.envs import Scenario

# what things are called there, and here
GROUPS = {
    "agent": "robot",
    "goal": "goal",
    "hazard": "hazards",
    "vase": "vases",
    "pillar": "pillars",
    "push_box": "box",
    "button": "button",
    "gremlin": "gremlins",
}
ROWS = 50  # simulations at a time


def gap(ours: Any, theirs: Any) -> float:
    """The Kolmogorov-Smirnov distance of two samples."""
    points = np.sort(np.concatenate([ours, theirs]))
    shares = [np.searchsorted(np.sort(s), points, side="right") / len(s) for s in (ours, theirs)]
    return float(np.abs(shares[0] - shares[1]).max())


def layouts(name: str, count: int) -> tuple[Any, Any, list[str]]:
    """``count`` of our layouts and all of theirs, [n, things, 2] m, and what each thing is."""
    recorded = load("distributions")
    kinds = [str(thing).rstrip("0123456789") for thing in recorded[f"things_{name}"]]
    # circles and walls are always where they are, and Button's marker jumps to a button
    known = {k for k in GROUPS if k in kinds and not (k == "goal" and "Button" in name)}
    keep = sorted((i for i, kind in enumerate(kinds) if kind in known), key=lambda i: kinds[i])
    engine = Scenario.parse(f"Safety{name}-v0").build(ROWS, num_threads=1)
    ours = []
    for begin in range(0, count, ROWS):
        for row in range(ROWS):
            engine.seed(row, np.random.default_rng(begin + row))
        engine.reset(np.arange(ROWS))
        places = [engine.places(GROUPS[kind])[:, :, :2] for kind in sorted(known)]
        ours.append(np.concatenate(places, axis=1))
    theirs = recorded[f"layout_{name}"][:, keep]
    return np.concatenate(ours), theirs, [kinds[i] for i in keep]


def layout_gaps(name: str, count: int = 1000) -> dict[str, float]:
    """The largest distances of the marginals of any kind, and of distances of any two kinds."""
    ours, theirs, kinds = layouts(name, count)
    out = {"x, |y|": 0.0, "distances": 0.0}
    for kind in set(kinds):
        which = [i for i, other in enumerate(kinds) if other == kind]
        for measure in (lambda p: p[..., 0], lambda p: np.abs(p[..., 1])):
            a, b = (measure(p[:, which]).ravel() for p in (ours, theirs))
            out["x, |y|"] = max(out["x, |y|"], gap(a, b))
    pairs: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for i, first in enumerate(kinds):
        for j in range(i):
            pairs.setdefault((kinds[j], first), []).append((i, j))
    for which in pairs.values():
        i, j = np.transpose(which)
        a, b = (np.linalg.norm(p[:, i] - p[:, j], axis=-1).ravel() for p in (ours, theirs))
        out["distances"] = max(out["distances"], gap(a, b))
    return out


def episode_gaps(name: str) -> dict[str, float]:
    """Of returns, costs and lengths of random episodes of at most 100 steps."""
    theirs = load("distributions")[f"episodes_{name}"]  # [count, 3]
    engine = Scenario.parse(f"Safety{name}-v0").build(ROWS, num_threads=1)
    rng, ours = np.random.default_rng(0), []
    for begin in range(0, len(theirs), ROWS):
        for row in range(ROWS):
            engine.seed(row, np.random.default_rng(begin + row))
        engine.reset(np.arange(ROWS))
        sums, alive = np.zeros((ROWS, 3)), np.ones(ROWS, dtype=bool)
        for _ in range(100):
            out = engine.step(rng.uniform(-1, 1, (ROWS, engine.robot.action_size)))
            sums += np.stack([out.reward, out.cost, np.ones(ROWS)], axis=1) * alive[:, None]
            alive &= ~out.terminated
        ours.append(sums)
    total = np.concatenate(ours)
    return {k: gap(total[:, i], theirs[:, i]) for i, k in enumerate(("return", "cost", "length"))}

"""Record what episodes of Safety-Gymnasium 1.0.0 begin with, and what random ones come to.

``scripts/safety_gymnasium/check.py`` sets up the environment that this runs in::

    .venv-mujoco-2.3.3/bin/python scripts/safety_gymnasium/record_distributions.py

``tests/data/safety_gymnasium/distributions.npz`` holds layouts of new episodes and returns, costs
and lengths of random ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import safety_gymnasium
from record import OUT, TASKS, save, shorten, without_textures

EPISODES = "PointGoal1 CarGoal2 PointButton1 CarPush1 PointCircle1 PointRun0 AntGoal1".split()


def layouts(name: str, count: int) -> dict[str, Any]:
    """Where things are when episodes begin, [count, things, 2] m, and what they are."""
    env = safety_gymnasium.make(f"Safety{name}-v0").unwrapped
    drawn = []
    for seed in range(count):
        env.reset(seed=seed)
        drawn.append(dict(env.task.world_info.layout))
    return named(name, drawn)


def button_layouts(name: str, count: int) -> dict[str, Any]:
    """The same for Button, whose resets draw nothing more: without building each world."""
    env = safety_gymnasium.make(f"Safety{name}-v0").unwrapped
    env.reset(seed=0)
    generator = env.task.random_generator
    generator.set_random_seed(12345)
    return named(name, [generator.build_layout() for _ in range(count)])


def named(name: str, drawn: list[dict[str, Any]]) -> dict[str, Any]:
    """Layouts as arrays."""
    things = sorted(drawn[0])
    places = np.array([[layout[thing] for thing in things] for layout in drawn])
    return {
        f"layout_{name}": shorten(places, 10).astype(np.float32),
        f"things_{name}": np.array(things),
    }


def episodes(name: str, count: int, steps: int) -> dict[str, Any]:
    """Returns, costs and lengths of random episodes of at most ``steps`` steps, [count, 3]."""
    env = safety_gymnasium.make(f"Safety{name}-v0").unwrapped
    rng = np.random.default_rng(0)
    out = np.zeros((count, 3))
    for episode in out:
        env.reset(seed=int(rng.integers(2**31)))
        for _ in range(steps):
            action = rng.uniform(-1, 1, env.action_space.shape)
            _, reward, cost, terminated, _, _ = env.step(action)
            episode += np.ravel(reward)[0], cost, 1
            if terminated:
                break
    return {f"episodes_{name}": out}


def main() -> None:
    without_textures()
    OUT.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {}
    for name in ("CarPush1", *(f"Point{task}" for task in TASKS)):
        arrays.update(layouts(name, 400))
    for name in ("PointButton1", "PointButton2"):  # 52 and more attempts each
        arrays.update(button_layouts(name, 1000))
    for name in EPISODES:
        arrays.update(episodes(name, 200, 100))
        print(name, arrays[f"episodes_{name}"].mean(axis=0), flush=True)
    save(OUT / "distributions.npz", arrays)


if __name__ == "__main__":
    main()

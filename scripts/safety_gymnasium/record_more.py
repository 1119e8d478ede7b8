"""Record more of Safety-Gymnasium 1.0.0: its velocity tasks, and what episodes begin with.

``scripts/safety_gymnasium/check.py`` sets up the environment that this runs in::

    .venv-mujoco-2.3.3/bin/python scripts/safety_gymnasium/record_more.py

``tests/data/safety_gymnasium/velocity.npz`` holds, for each robot, the states in which episodes of
seeds 0 to 9 begin, and 200 states with the next state, reward, cost and end that one random action
makes of each. Every 20 steps a new episode begins, so
that the robot stands, falls and lies; what terminates goes on. Before each step the state is
rounded to a grid, and the start of the solver, ``qacc_warmstart``, is 0. What follows has 24 bits.

``distributions.npz`` holds layouts of new episodes and returns, costs and lengths of random ones.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import safety_gymnasium
from record import GRID, OUT, TASKS, save, shorten, without_textures

ROBOTS = ("Ant", "HalfCheetah", "Hopper", "Humanoid", "Swimmer", "Walker2d")
STEPS, EPISODE, SEEDS = 200, 20, 10
EPISODES = "PointGoal1 CarGoal2 PointButton1 CarPush1 PointCircle1 PointRun0 AntGoal1".split()


def record(name: str) -> dict[str, Any]:
    """A velocity task: the arrays of a robot, [STEPS, ...] each, and its starts, [SEEDS, ...]."""
    env = safety_gymnasium.make(f"Safety{name}Velocity-v1").unwrapped
    starts = []
    for seed in range(SEEDS):
        env.reset(seed=seed)
        starts.append(np.append(env.data.qpos, env.data.qvel))
    rng = np.random.default_rng(0)
    rows: list[dict[str, Any]] = []
    for step in range(STEPS):
        if step % EPISODE == 0:
            env.reset(seed=step)
            scale = rng.uniform(0.2, 1.0)  # gentle actions let it stand for longer
        before = {f: np.round(getattr(env.data, f) / grid) * grid for f, grid in GRID.items()}
        env.data.qacc_warmstart[:] = 0.0
        env.set_state(before["qpos"], before["qvel"])
        env.data.qacc_warmstart[:] = 0.0
        action = np.round(scale * rng.uniform(env.action_space.low, env.action_space.high), 2)
        contacts = env.data.ncon
        _, reward, cost, terminated, _, _ = env.step(action)
        rows.append(
            {
                **before,
                "action": action,
                "next_qpos": shorten(env.data.qpos, 24).astype(np.float32),
                "next_qvel": shorten(env.data.qvel, 24).astype(np.float32),
                "reward": reward,
                "cost": cost,
                "terminated": terminated,
                "contacts": contacts + env.data.ncon,  # when the step begins and when it ends
            }
        )
    out = {f"{name}_{key}": np.array([row[key] for row in rows]) for key in rows[0]}
    return {**out, f"{name}_starts": np.array(starts)}


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
    velocities: dict[str, Any] = {}
    for name in ROBOTS:
        velocities.update(record(name))
        touching = velocities[f"{name}_contacts"] > 0
        print(f"{name}: {touching.mean():.0%} in contact", flush=True)
    save(OUT / "velocity.npz", velocities)
    without_textures()
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

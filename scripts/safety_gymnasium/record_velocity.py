"""Record single steps of Safety-Gymnasium 1.0.0's velocity tasks, most of them in contact.

``scripts/safety_gymnasium/check.py`` sets up the environment that this runs in::

    .venv-mujoco-2.3.3/bin/python scripts/safety_gymnasium/record_velocity.py

``tests/data/safety_gymnasium/velocity.npz`` holds, for each robot, the states in which episodes of
seeds 0 to 9 begin, and 200 states with the next state, reward, cost and end that one random action
makes of each. Every 20 steps a new episode begins, so
that the robot stands, falls and lies; what terminates goes on. Before each step the state is
rounded to a grid, and the start of the solver, ``qacc_warmstart``, is 0. What follows has 24 bits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import safety_gymnasium
from record import GRID, OUT, save, shorten

ROBOTS = ("Ant", "HalfCheetah", "Hopper", "Humanoid", "Swimmer", "Walker2d")
STEPS, EPISODE, SEEDS = 200, 20, 10


def record(name: str) -> dict[str, Any]:
    """The arrays of a robot, [STEPS, ...] each, and its starts, [SEEDS, ...]."""
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


def main() -> None:
    arrays: dict[str, Any] = {}
    for name in ROBOTS:
        arrays.update(record(name))
        touching = arrays[f"{name}_contacts"] > 0
        print(f"{name}: {touching.mean():.0%} in contact", flush=True)
    save(OUT / "velocity.npz", arrays)


if __name__ == "__main__":
    main()

"""Print how robots fare under MuJoCo's integrators, which decides what each robot states.

A hundred episodes of random actions for each robot and integrator: how many diverged, how fast the
joints moved at most and typically, how far the robots got, and the time of a control step. Typical
values are medians over episodes. A robot's own integrator is marked with a star.
"""

import argparse
import time

import numpy as np

from sb3_guard.envs.arena import INTEGRATORS
from sb3_guard.envs.registry import ROBOTS
from sb3_guard.envs.scenario import Scenario


def measure(robot: str, integrator: str, episodes: int, steps: int) -> str:
    """A row of the table."""
    scenario = Scenario(robot=robot, arena={"integrator": integrator})
    engine = scenario.build(episodes, num_threads=1)
    for row in range(episodes):
        engine.seed(row, np.random.default_rng(row))
    engine.reset(np.arange(episodes))
    rng = np.random.default_rng(0)
    start, qvel = engine.robot.position.copy(), engine.batch.bind("qvel")
    diverged, fastest = np.zeros(episodes, dtype=bool), np.zeros(episodes)
    begin = time.perf_counter()
    for _ in range(steps):
        outcome = engine.step(rng.uniform(-1, 1, (episodes, engine.robot.action_size)))
        diverged |= outcome.physics_error
        fastest = np.maximum(fastest, np.abs(qvel).max(axis=1))
    taken = (time.perf_counter() - begin) / steps / episodes
    far = np.linalg.norm(engine.robot.position - start, axis=1)
    own = "*" if ROBOTS[robot].integrator == integrator else ""
    return (
        f"| {robot} | {integrator}{own} | {diverged.sum()} | {fastest.max():.3g} | "
        f"{np.median(fastest):.3g} | {np.median(far):.2f} | {1e6 * taken:.0f} |"
    )


def difference(robot: str, one: str, other: str, rows: int = 20, steps: int = 300) -> str:
    """How far apart two integrators are after one control step from the same state."""
    engines = [Scenario(robot=robot, arena={"integrator": i}).build(rows, 1) for i in (one, other)]
    for engine in engines:
        for row in range(rows):
            engine.seed(row, np.random.default_rng(row))
        engine.reset(np.arange(rows))
    rng, largest = np.random.default_rng(0), dict.fromkeys(("gyro", "accelerometer"), 0.0)
    for _ in range(steps):
        engines[1].restore(engines[0].state())
        actions = rng.uniform(-1, 1, (rows, engines[0].robot.action_size))
        seen = [engine.step(actions).obs for engine in engines]
        for name in largest:
            where = engines[0].observation_layout[name]
            gap = float(np.abs(seen[0][:, where] - seen[1][:, where]).max())
            largest[name] = max(largest[name], gap)
    return (
        f"{robot}: one control step of {one} and {other} differs by up to {largest['gyro']:.2g} "
        f"rad/s and {largest['accelerometer']:.3g} m/s²"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=list(ROBOTS))
    parser.add_argument("--integrators", nargs="+", default=["Euler", "implicitfast"],
                        choices=list(INTEGRATORS))  # fmt: skip
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--steps", type=int, default=1000)
    args = parser.parse_args()
    print("| robot | integrator | diverged | fastest | typically fastest | m from start | µs |")
    print("|---|---|---|---|---|---|---|")
    for robot in args.robots:
        for integrator in args.integrators:
            print(measure(robot, integrator, args.episodes, args.steps), flush=True)
    if "Point" in args.robots:
        print(difference("Point", "Euler", "implicitfast"))


if __name__ == "__main__":
    main()

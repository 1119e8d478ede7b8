"""Print how much of bare physics the environments keep, and what a reset costs.

Every ratio is measured in one run: short slices of the full step and of a bare loop on the same
model alternate, and the best slice of each counts; of a reset, the best of five repetitions.
``--envs`` names environments or patterns, ``'*'`` for all. On a machine with neighbours
``--rounds 5`` goes through the table five times and takes the best of each figure, which may be of
different rounds: noise comes and goes in minutes; with ``--threads 1``, by the time that one core
had, it hardly counts.
``--beside PYTHON`` runs the real Safety-Gymnasium, in the environment that
``scripts/safety_gymnasium/check.py`` sets up, in turn with our task of the same id: on one core by
its time, or with ``--threads 2`` ours on two, both by the clock on the wall. The best slices of 40
steps count. ``--vector N`` compares N rows of the vector environment with the same in the adapter
that makes a VecEnv of Gymnasium's, in each autoreset mode.
"""

from __future__ import annotations

import argparse
import fnmatch
import itertools
import math
import subprocess
import sys
import time
from collections.abc import Callable

import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode
from mujoco.batch import Batch

from sb3_guard.common.native import GuardVecEnv
from sb3_guard.envs import env_ids, env_spec
from sb3_guard.envs.engine import Engine
from sb3_guard.envs.mujoco_gaps import profiling_clock
from sb3_guard.envs.physics import ACC, FRAME_SKIP
from sb3_guard.envs.vector_env import GuardVectorEnv
from sb3_guard.vector import GymnasiumVecEnv
from sb3_guard.zoo.cli.markdown import table

CLOCK = profiling_clock()
SHIPPED = CLOCK.value if CLOCK is not None else None


def as_shipped(on: bool) -> None:
    """Put MuJoCo's profiling clock back for the bare loops, or take it away."""
    if CLOCK is not None:
        CLOCK.value = SHIPPED if on else None


def best(
    functions: dict[str, Callable[[], int]],
    seconds: float,
    slices: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Env-steps/s of each function: the best of alternating slices."""
    rates = dict.fromkeys(functions, 0.0)
    for _ in range(slices):
        for name, function in functions.items():
            as_shipped(name == "bare")
            start, steps = clock(), 0
            while clock() - start < seconds / slices:
                steps += function()
            rates[name] = max(rates[name], steps / (clock() - start))
    return rates


def stepper(env: GuardVecEnv) -> Callable[[], int]:
    """Four steps of an environment whose episodes are staggered, as in a long training."""
    env.seed(0)
    env.reset()
    env.envs.engine.steps[:] = np.arange(env.num_envs) * (
        env.envs.max_episode_steps // env.num_envs
    )
    shape = (64, env.num_envs, *env.action_space.shape)
    low, high = env.action_space.low, env.action_space.high
    actions = itertools.cycle(np.random.default_rng(0).uniform(low, high, shape).astype("f4"))

    def step() -> int:
        for _ in range(4):
            env.step(next(actions))
        return 4 * env.num_envs

    return step


def bare_stepper(engine: Engine) -> Callable[[], int]:
    """Four steps of nothing but the physics of an engine."""
    batch = Batch(engine.model, nsim=engine.num_envs, nthread=engine.num_threads, persistent=True)
    batch.state[:] = engine.batch.state
    low, high = engine.model.actuator_ctrlrange.T
    shape = (64, engine.num_envs, engine.model.nu)
    controls = itertools.cycle(np.random.default_rng(0).uniform(low, high, shape))
    control = batch.bind("ctrl")

    def step() -> int:
        for _ in range(4):
            control[:] = next(controls)
            batch.step(nstep=engine.batch.frame_skip)
        return 4 * engine.num_envs

    return step


def rates(
    env_id: str, n: int, seconds: float, slices: int, threads: int | None = None
) -> dict[str, float]:
    """Full vector step against a bare loop on the same model, N = n."""
    env = GuardVecEnv(env_spec(env_id).kwargs["scenario"], n, num_threads=threads)
    functions = {"full": stepper(env), "bare": bare_stepper(env.envs.engine)}
    clock = time.process_time if threads == 1 else time.perf_counter
    return best(functions, seconds, slices, clock)


def reset_seconds(env_id: str, n: int = 100) -> float:
    """Mean seconds of a reset: layout, state and first observation.

    The same resets are done several times over and the fastest of each counts: layouts differ in
    what they take, repetitions only in what else the machine does.
    """
    vec = GuardVectorEnv(1, env_spec(env_id).kwargs["scenario"])
    seconds = np.empty((5, n))
    for row in seconds:
        vec.begin([0])
        for i in range(n):
            start = time.perf_counter()
            vec.begin([None])
            row[i] = time.perf_counter() - start
    return float(seconds.min(axis=0).mean())


# Steps per second, and seconds of a reset, by the clock named, for each line that comes in
REAL = """
import os, sys, time
answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # what the package prints itself
import numpy, safety_gymnasium
env = safety_gymnasium.make(sys.argv[1])
clock = getattr(time, sys.argv[2])
rng = numpy.random.default_rng(0)
for _ in sys.stdin:
    start = clock()
    env.reset(seed=0)
    begun = clock()
    best, now = 0.0, begun
    for _ in range(8):
        for _ in range(40):
            env.step(rng.uniform(-1, 1, env.action_space.shape))
        now, before = clock(), now
        best = max(best, 40 / (now - before))
    print(best, begun - start, file=answers, flush=True)
"""


def beside(python: str, env_id: str, threads: int = 1) -> None:
    """Print our steps per second, and those of the real package, which has one thread."""
    clock = time.process_time if threads == 1 else time.perf_counter
    command = [python, "-W", "ignore", "-c", REAL, env_id, clock.__name__]
    real = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert real.stdin is not None and real.stdout is not None
    ours, theirs, longest = 0.0, 0.0, math.inf
    scenario = env_spec(env_id).kwargs["scenario"]
    rng = np.random.default_rng(0)
    for _ in range(5):
        env = GuardVectorEnv(30, scenario, num_threads=threads)
        env.reset(seed=0)
        actions = rng.uniform(-1, 1, (64, *env.action_space.shape))
        for _ in range(25):
            start = clock()
            for step in range(40):
                env.step(actions[step])
            ours = max(ours, 40 * 30 / (clock() - start))
        env.close()
        print(file=real.stdin, flush=True)
        rate, seconds = map(float, real.stdout.readline().split())
        theirs, longest = max(theirs, rate), min(longest, seconds)
    real.stdin.close()
    real.wait()
    reset = reset_seconds(env_id, n=20)
    unit = "second of one core" if threads == 1 else f"second, ours on {threads} threads"
    print(f"{env_id}, per {unit}: steps, of whole episodes of 1,000 with their reset")
    whole, own = 1000 / (1000 / theirs + longest), 1000 / (1000 / ours + reset)
    print(f"the package  {theirs:>7,.0f} {whole:>7,.0f}, a reset {longest:.2f} s")
    print(f"ours, N = 30 {ours:>7,.0f} {own:>7,.0f}, a reset {1e3 * reset:.2f} ms")
    print(f"times as many {ours / theirs:>6.1f} {own / whole:>7.1f}")


def adapted(env_id: str, n: int, seconds: float, slices: int, threads: int | None) -> None:
    """Print what Stable-Baselines3's interface adds to a step of Gymnasium's vector environment."""
    rows = []
    for mode in AutoresetMode:
        envs = [
            GuardVectorEnv(n, env_spec(env_id).kwargs["scenario"], num_threads=threads,
                           autoreset_mode=mode)
            for _ in range(2)
        ]  # fmt: skip
        bare, adapter = envs[0], GymnasiumVecEnv(envs[1])
        bare.reset(seed=0)
        adapter.seed(0)
        adapter.reset()
        action = np.zeros(bare.action_space.shape, np.float32)

        def step(bare: GuardVectorEnv = bare, action: np.ndarray = action) -> int:
            *_, died, cut, _ = bare.step(action)
            if bare.metadata["autoreset_mode"] is AutoresetMode.DISABLED and (died | cut).any():
                bare.reset(options={"reset_mask": died | cut})
            return n

        def step_adapted(adapter: GymnasiumVecEnv = adapter, action: np.ndarray = action) -> int:
            adapter.step(action)
            return n

        clock = time.process_time if threads == 1 else time.perf_counter
        rates = best({"alone": step, "adapted": step_adapted}, seconds, slices, clock)
        values = [1e3 * n / rates[name] for name in ("alone", "adapted")]
        share = f"{values[1] / values[0] - 1:+.1%}"
        rows.append([mode.value, *(f"{value:.3f}" for value in values), share])
    print(f"{env_id}, N = {n}")
    print(table(["mode", "step, ms", "with the adapter, ms", "more"], rows))


def print_table(env_ids: list[str], args: argparse.Namespace) -> None:
    """Print the marks of environments, the best of each over the rounds."""
    full, bare = dict.fromkeys(env_ids, 0.0), dict.fromkeys(env_ids, 0.0)
    reset = dict.fromkeys(env_ids, math.inf)
    for turn in range(args.rounds):
        for i, env_id in enumerate(env_ids, 1):
            print(f"\rround {turn + 1}, {i} of {len(env_ids)} ", end="", file=sys.stderr)
            measured = rates(env_id, args.rows, args.seconds, args.slices, args.threads)
            full[env_id] = max(full[env_id], measured["full"])
            bare[env_id] = max(bare[env_id], measured["bare"])
            reset[env_id] = min(reset[env_id], 1e3 * reset_seconds(env_id))
    print(file=sys.stderr)
    rows = [[i, f"{full[i]:,.0f}", f"{full[i] / bare[i]:.2f}", f"{reset[i]:.2f}"] for i in env_ids]
    print(table(["environment", "env-steps/s", "of bare physics", "reset, ms"], rows))


def main() -> None:
    global SHIPPED
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--envs", nargs="+", metavar="PATTERN", default=["Goal_Point_8Hazards-v0"],
        help="environments whose ids match, such as '*_Arm?_*' (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--beside", metavar="PYTHON", help="that Python's Safety-Gymnasium instead")
    parser.add_argument("--vector", type=int, metavar="N", help="the adapter's share of a step")
    parser.add_argument("--seconds", type=float, default=1.0, help="time for each environment")
    parser.add_argument("--slices", type=int, default=20, help="slices that alternate")
    parser.add_argument("--rounds", type=int, default=1, help="times through the table")
    parser.add_argument("--rows", type=int, default=30, help="environments of a batch")
    parser.add_argument("--clock-off", action="store_true", help="MuJoCo's, in the bare loop, too")
    parser.add_argument("--threads", type=int, help="1: by the time that one core had for it")
    args = parser.parse_args()
    if args.clock_off:
        SHIPPED = None
    matching = [i for i in env_ids() if any(fnmatch.fnmatch(i, p) for p in args.envs)]
    if not matching:
        parser.error(f"no id matches {' '.join(args.envs)}; ids look like Goal_Point_8Hazards-v0")
    if args.beside:
        for env_id in matching:
            beside(args.beside, env_id, args.threads or 1)
        return
    if args.vector:
        for env_id in matching:
            adapted(env_id, args.vector, args.seconds, args.slices, args.threads)
        return
    print(f"mujoco {mujoco.__version__}, stage {ACC}, {FRAME_SKIP} physics steps per control step")
    print_table(matching, args)


if __name__ == "__main__":
    main()

"""Print what an update costs, where its time goes, and what that makes of the paper's runs.

``python scripts/bench_training.py`` measures on-policy algorithms with the settings of their files
(30,000 steps an update) beside a bare physics loop timed in the same run; the best of several
updates counts. The safety layers are measured switched on. ``--beside-sb3`` compares first-order
and off-policy algorithms with SB3's PPO, SAC and TD3 and SB3-contrib's TQC instead: updates of the
two by turns, the median of the ratios. Settings are the same, but that off-policy ones of ours have
the fused Adam of their files.
"""

from __future__ import annotations

import argparse
import inspect
import os
import resource
import subprocess
import sys
import time
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the commands do; read by torch's import

import bench_engine
import numpy as np
import torch
from sb3_contrib import TQC
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_guard import ALGORITHMS, make_vec_env
from sb3_guard.zoo.run.hyperparams import check, model_arguments, read_hyperparams

N_ENVS, N_STEPS = 30, 1000
# What one of SB3's algorithms becomes, and how much longer its update may then take.
BESIDE: dict[type[BaseAlgorithm], dict[str, float | None]] = {
    PPO: {"ppo_lag": 1.4, "cppo_pid": 1.4, "focops": 1.6, "cup": 1.6, "p3o": 1.6},
    SAC: {"sac_lag": 1.4},
    TD3: {"td3_lag": None},
    TQC: {"tqc_lag": None},
}
ON_POLICY = [key for key, cls in ALGORITHMS.items() if issubclass(cls, OnPolicyAlgorithm)]
# Seconds an update may take on two free cores.
MARKS = {"trpo": 2.5, "cpo": 3.5}


def start_seconds(*arguments: str) -> float:
    """Wall time of a fresh interpreter with these arguments, the better of two."""
    times = []
    for _ in range(2):
        start = time.perf_counter()
        subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
        times.append(time.perf_counter() - start)
    return min(times)


def beside_sb3(env_id: str, rounds: int) -> None:
    """A line per pair: seconds of an update of 1,280 steps or of 50 gradient steps, and ratio."""
    print("| algorithm | SB3's, s | ours, s | ratio | mark |\n|---|---|---|---|---|")
    for theirs, keys in BESIDE.items():
        for key, mark in keys.items():
            pair = [trained(cls, env_id) for cls in (theirs, ALGORITHMS[key])]
            times = np.array([[seconds_of_update(model) for model in pair] for _ in range(rounds)])
            ratio = np.median(times[:, 1] / times[:, 0])
            usual = np.median(times, axis=0)
            price = getattr(pair[1], "multiplier", None)
            assert price is None or price.value.any(), f"{key}: no cost has a price"
            row = f"| {key} | {usual[0]:.2f} | {usual[1]:.2f} | {ratio:.2f} | {mark or ''} |"
            print(row, flush=True)


def trained(algorithm: type[BaseAlgorithm], env_id: str) -> BaseAlgorithm:
    """A model that has begun to learn, with as many passes as PPO; costs have a price."""
    env = make_vec_env(env_id, 10, seed=0)
    settings: dict[str, Any] = {"learning_starts": 100, "buffer_size": 20_000, "gradient_steps": 1}
    settings["policy_kwargs"] = {"net_arch": [128, 128]}
    if issubclass(algorithm, OnPolicyAlgorithm):
        settings = {"n_steps": 128, "batch_size": 64, "n_epochs": 10}
    if algorithm in ALGORITHMS.values():
        settings |= {"cost_limit": 0.0, "lambda_init": 1.0}  # so that no multiplier falls
        if not issubclass(algorithm, OnPolicyAlgorithm):
            settings["policy_kwargs"]["optimizer_kwargs"] = {"fused": True}
        taken = inspect.signature(algorithm).parameters
        settings = {name: value for name, value in settings.items() if name in taken}
    return algorithm("MlpPolicy", env, seed=0, **settings).learn(1280)  # type: ignore[call-arg]


def seconds_of_update(model: BaseAlgorithm) -> float:
    """The processor's time of the next update alone, which other processes do not lengthen."""
    spent = 0.0
    update = type(model).train

    def timed(*args: Any, **kwargs: Any) -> None:
        nonlocal spent
        started = time.process_time()
        update(model, *args, **kwargs)
        spent += time.process_time() - started

    model.train = timed  # type: ignore[method-assign, attr-defined]
    steps = 1280 if isinstance(model, OnPolicyAlgorithm) else 500
    model.learn(steps, reset_num_timesteps=False)
    del model.train  # type: ignore[attr-defined]
    return spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--algos", nargs="+", default=ON_POLICY, choices=ON_POLICY)
    parser.add_argument("--env", default="Goal_Point_8Hazards-v0")
    parser.add_argument("--updates", type=int, default=6, help="updates per algorithm")
    parser.add_argument("--threads", type=int, default=None, help="torch and physics threads")
    parser.add_argument("--beside-sb3", action="store_true", help="ratios to PPO, SAC, TD3 and TQC")
    args = parser.parse_args()
    if args.threads:
        torch.set_num_threads(args.threads)
    if args.beside_sb3:
        beside_sb3(args.env, args.updates)
        return
    print(f"{args.env}, {N_ENVS} envs x {N_STEPS} steps, torch threads {torch.get_num_threads()}")
    header = "| algorithm | collect, s | actor, s | critics, s | update, s | collected steps/s | "
    header += "of bare physics | minutes for 6e6 steps | mark for an update, s |"
    print(header + "\n|---|---|---|---|---|---|---|---|---|")
    for algo in args.algos:
        env = make_vec_env(args.env, N_ENVS, seed=0, num_threads=args.threads)
        algorithm = ALGORITHMS[algo]
        arguments = model_arguments(check(algo, algorithm, read_hyperparams(algo, args.env)))
        if "warmup" in arguments:
            arguments["warmup"] = 0
        model = algorithm(env=env, seed=0, **arguments)
        best: dict[str, float] = {}
        for _ in range(args.updates):
            started = time.perf_counter()
            model.learn(N_ENVS * N_STEPS, reset_num_timesteps=False)
            times = {"actor": 0.0, "critics": 0.0, **model.timing}
            if "actor" not in model.timing:  # first order: one loop trains both
                times["actor"] = time.perf_counter() - started - times["collect"]
            best = {k: min(best.get(k, 1e9), v) for k, v in times.items()}
        step = bench_engine.bare_stepper(env.unwrapped.envs.engine)
        bare = bench_engine.best({"bare": step}, seconds=2.0, slices=10)["bare"]
        bench_engine.as_shipped(False)
        rate = N_ENVS * N_STEPS / best["collect"]
        total = sum(best.values())
        minutes = 6e6 / (N_ENVS * N_STEPS) * total / 60
        print(
            f"| {algo} | {best['collect']:.2f} | {best['actor']:.2f} | {best['critics']:.2f} "
            f"| {total:.2f} | {rate:,.0f} | {rate / bare:.2f} | {minutes:.1f} "
            f"| {MARKS.get(algo, '')} |",
            flush=True,
        )
        env.close()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory of this process {peak:,.0f} MB")
    print(f"import sb3_guard {start_seconds('-c', 'import sb3_guard'):.2f} s")
    seconds = start_seconds("-m", "sb3_guard.train", "--help")
    print(f"python -m sb3_guard.train --help {seconds:.2f} s")


if __name__ == "__main__":
    main()

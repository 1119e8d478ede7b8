"""Train CPO on Safety-Gymnasium's own SafetyPointGoal1-v0, beside the old packages it needs.

``python3.11 scripts/safety_gymnasium/check.py`` sets up ``.venv-mujoco-2.3.3`` from PyPI, about a
gigabyte, and trains a few thousand steps there, from Python and by ``python -m sb3_guard.train
--algo cpo --env SafetyPointGoal1-v0``. It must be Python 3.11: MuJoCo 2.3 has no wheels
for a newer one, and sb3_guard needs at least that. ``--mujoco 3.3.7`` takes another MuJoCo, and
``--mujoco none`` none at all, each in its own folder; they train on a CartPole with a cost, since
Safety-Gymnasium is not for them.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
MUJOCO = "2.3.3"


def set_up(folder: Path, mujoco: str) -> Path:
    """Make the environment, or bring it up to date.

    :return: its Python
    """
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)

    def install(*packages: str) -> None:
        pip = [str(python), "-m", "pip", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, "install", *packages], check=True)

    # torch goes first and alone: a requirement that another package leaves open would fetch CUDA
    install("torch==2.13.0")
    # MuJoCo 2.3 was compiled for NumPy 1
    install("numpy<2", "gymnasium==0.29.1", "stable_baselines3==2.9.2", "scipy")
    # for the commands; RL-Zoo's own pins ask for a newer Gymnasium
    install("huggingface_hub", "imageio-ffmpeg", "pillow", "pyyaml", "rich", "tqdm", "wasabi")
    zoo = ("rl_zoo3==2.9.2", "sb3_contrib==2.9.2", "sb3-team-hf-integration==3.2")
    install("--no-deps", *zoo)
    if mujoco != "none":
        install(f"mujoco=={mujoco}")
    if mujoco == MUJOCO:
        # its own pins, such as Gymnasium 0.28.1, can't be kept: only what it really imports
        install("xmltodict", "imageio", "pygame")
        install("--no-deps", "gymnasium-robotics==1.2.2", "pettingzoo==1.24.3")
        install("--no-deps", "safety-gymnasium==1.0.0")
        mend(next(folder.glob("lib/python*/site-packages/safety_gymnasium")))
    return python


def mend(package: Path) -> None:
    """Let Safety-Gymnasium be imported by Python 3.11, whose dataclasses refuse array defaults."""
    for path in sorted((package / "assets").rglob("*.py")):
        source = path.read_text()
        mended = re.sub(
            r": np\.array = ((?:COLOR|GROUP)\[.*\])$",
            r": np.array = field(default_factory=lambda: \1)",
            re.sub(r"import dataclass$", "import dataclass, field", source, flags=re.MULTILINE),
            flags=re.MULTILINE,
        )
        if mended != source:
            path.write_text(mended)


def versions() -> str:
    """What the training runs on, for the printed line."""
    found = []
    for name in ("mujoco", "gymnasium", "stable_baselines3", "numpy"):
        there = importlib.util.find_spec(name) is not None
        found.append(f"{name} {importlib.import_module(name).__version__ if there else '-'}")
    return ", ".join(found)


def leans(obs: Any, action: Any, next_obs: Any, info: dict[str, Any]) -> bool:
    """A cost for CartPole: its pole is more than 0.02 rad off the vertical."""
    return abs(next_obs[2]) > 0.02


def with_cost(env: Any) -> Any:
    from sb3_guard.common.adapters import CostFromFunction

    return CostFromFunction(env, leans)


def train(steps: int, plain: bool) -> None:
    """Train, save, load and evaluate, in one process and in several."""
    import numpy as np

    from sb3_guard import CPO, evaluate_policy, make_vec_env
    from sb3_guard.common.vec_budgets import VecRemainingBudget

    print(versions())
    env_id = "CartPole-v1" if plain else "SafetyPointGoal1-v0"
    for kind in ("dummy", "subproc"):
        env = make_vec_env(
            env_id,
            2,
            seed=0,
            vec_env=kind,
            wrapper_class=with_cost if plain else None,
            monitor_kwargs={"cost_keys": ("cost",) if plain else ("cost", "cost_sum")},
        )
        if kind == "subproc" and not plain:
            env = VecRemainingBudget(env, budget=25.0)
        model = CPO("MlpPolicy", env, n_steps=1000, cost_limit=25.0, seed=0)
        start = time.perf_counter()
        model.learn(steps)
        rate = model.num_timesteps / (time.perf_counter() - start)
        with tempfile.TemporaryDirectory() as folder:
            model.save(f"{folder}/cpo")
            model = CPO.load(f"{folder}/cpo", env=env)
        ended = [(one["r"], one["c"], one["l"]) for one in model.ep_info_buffer]
        returns, costs, lengths = np.mean(ended, axis=0)
        assert np.isfinite(ended).all()
        if not plain:
            assert lengths == 1000
            assert all(one["c"] == one["c_cost_sum"] for one in model.ep_info_buffer)
        played = evaluate_policy(model, env, n_eval_episodes=2, seed=0)
        print(
            f"{env_id}, {kind}: {model.num_timesteps} steps at {rate:.0f}/s; "
            f"{len(ended)} episodes, return {returns:.2f}, cost {costs:.1f}; "
            f"evaluated: return {played.returns.mean():.2f}, cost {played.costs.mean():.1f}"
        )
        env.close()
    by_command(env_id, steps, plain)


def by_command(env_id: str, steps: int, plain: bool) -> None:
    """Train by one command and play by another."""
    with tempfile.TemporaryDirectory() as folder:
        what = ["--algo", "cpo", "--env", env_id, "-f", folder]
        params = ["n_envs:2", "n_steps:1000", "cost_limit:25.0", "n_critic_updates:20"]
        params += ["missing_cost:zero"] if plain else []
        flags = ["-n", str(steps), "--seed", "0", "--eval-freq", str(steps), "--eval-episodes", "1"]
        train = [sys.executable, "-m", "sb3_guard.train", *what, *flags, "-params", *params]
        subprocess.run(train, check=True)
        result = json.loads((Path(folder) / "cpo" / f"{env_id}_1" / "result.json").read_text())
        assert result["n_timesteps"] == steps and math.isfinite(result["return"])
        play = ["--no-render", "--n-episodes", "1"]
        subprocess.run([sys.executable, "-m", "sb3_guard.enjoy", *what, *play], check=True)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-f", "--folder", type=Path, help="default: .venv-mujoco-<version>")
    parser.add_argument("-n", "--steps", type=int, default=4000)
    parser.add_argument("--mujoco", default=MUJOCO, help="a version, or none")
    parser.add_argument("--train-only", action="store_true", help="the packages are here already")
    args = parser.parse_args(argv)
    if args.train_only:
        train(args.steps, plain=args.mujoco != MUJOCO)
        return 0
    if sys.version_info[:2] != (3, 11):
        print("error: this needs Python 3.11: run it by python3.11", file=sys.stderr)
        return 2
    python = set_up(args.folder or ROOT / f".venv-mujoco-{args.mujoco}", args.mujoco)
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    command = [python, __file__, "--train-only", "-n", args.steps, "--mujoco", args.mujoco]
    done = subprocess.run([str(word) for word in command], env={**os.environ, "PYTHONPATH": path})
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())

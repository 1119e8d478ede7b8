"""Run folders as train leaves them, without training."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml

# As classes state them
LABELS = {
    "trpo": ("TRPO", "unconstrained"), "cpo": ("CPO", "CPO-based"), "pcpo": ("PCPO", "CPO-based"),
    "trpo_lag": ("TRPO-Lagrangian", "Lagrangian"), "trpo_fac": ("TRPO-FAC", "Lagrangian"),
    "trpo_ipo": ("TRPO-IPO", "Lagrangian"), "trpo_sl": ("TRPO-SL", "hierarchical"),
    "trpo_usl": ("TRPO-USL", "hierarchical"), "ppo": ("PPO", ""), "mine": ("My own", "Lagrangian"),
}  # fmt: skip


def fake_run(
    folder: Path,
    algo: str = "cpo",
    env: str = "Goal_Point_8Hazards-v0",
    seed: int = 0,
    number: int | None = None,
    returns: float = 20.0,
    cost: float = 5.0,
    epochs: int = 6,
    config: dict[str, Any] | None = None,
    args: dict[str, Any] | None = None,
    **result: Any,
) -> Path:
    """
    Write a run of ``epochs`` epochs of 2 × 50 steps, in episodes of 10 steps.

    :param returns: mean return of the final epoch; it grows from 0 in equal steps
    :param cost: mean cost of its episodes, the same throughout
    :param result: other entries of result.json; ``...`` leaves one out
    :return: the run's folder
    """
    parent = folder / algo
    number = number or len(list(parent.glob(f"{env}_*"))) + 1
    path = parent / f"{env}_{number}"
    params = path / env
    params.mkdir(parents=True)
    flags = {"algo": algo, "env": env, "seed": seed} | (args or {})
    (params / "args.yml").write_text(yaml.safe_dump(flags))
    settings = {"n_envs": 2, "n_steps": 50, "n_timesteps": 100 * epochs}
    if algo != "trpo":
        settings["cost_limit"] = 0.0
    settings |= config or {}
    (params / "config.yml").write_text(yaml.safe_dump(settings))
    noise = np.random.default_rng(seed).normal(size=10)
    noise -= noise.mean()
    rows = ["#{}", "r,l,t,c"]
    for epoch in range(1, epochs + 1):
        mean = returns * epoch / epochs
        rows += [f"{mean + n},10,{epoch},{cost + 0.1 * n}" for n in noise]
    (path / "0.monitor.csv").write_text("\n".join(rows) + "\n")
    limit = settings.get("cost_limit")
    label, family = LABELS.get(algo, (None, None))
    content = {
        "label": label, "family": family, "algo": algo, "env": env,
        "return": returns, "cost": cost, "length": 10.0,
        "cost_rate": cost / 10, "episodes": 10, "n_timesteps": 100 * epochs, "physics_errors": 0,
        "cost_limit": limit, "costs": {"cost": {"mean": cost, "limit": limit}},
        "final": {},
    } | result  # fmt: skip
    content = {key: value for key, value in content.items() if value is not ...}
    (path / "result.json").write_text(json.dumps(content))
    return path

"""What a robot earns that learns nothing: ``python scripts/untrained.py``.

Writes ``docs/data/untrained.csv``: for each suite with hazards the mean return and episode cost of
20 episodes of uniformly random actions and of actions of zero, with standard errors. With the runs
of ``docs/data/learnable.yml`` it makes a table of docs/notes/learnable.md (``scripts/results.py``).
"""

from pathlib import Path

import numpy as np
import pandas as pd

from sb3_guard import make_vec_env
from sb3_guard.envs.suites import env_ids

FILE = Path(__file__).parents[1] / "docs" / "data" / "untrained.csv"
EPISODES = 20
SEED = 10_000


def episodes(env_id: str, actions: str) -> dict[str, float]:
    """The means of 20 episodes, one per environment, and their standard errors."""
    env = make_vec_env(env_id, EPISODES, seed=SEED)
    env.action_space.seed(SEED)
    env.reset()
    zero = np.zeros((EPISODES, *env.action_space.shape), dtype=np.float32)
    found: dict[int, dict[str, float]] = {}
    while len(found) < EPISODES:
        random = np.stack([env.action_space.sample() for _ in range(EPISODES)])
        *_, infos = env.step(random if actions == "random" else zero)
        for i, info in enumerate(infos):
            if "episode" in info:
                found.setdefault(i, info["episode"])
    env.close()
    returns, costs = (np.array([each[key] for each in found.values()]) for key in "rc")
    return {
        actions: returns.mean(),
        f"{actions}_se": returns.std(ddof=1) / np.sqrt(EPISODES),
        f"{actions}_cost": costs.mean(),
    }


def main() -> None:
    suites = [env_id for env_id in env_ids("guard") if env_id.endswith("_8Hazards-v0")]
    rows = []
    for suite in suites:
        rows.append({"suite": suite, **episodes(suite, "random"), **episodes(suite, "zero")})
        print(rows[-1], flush=True)
    (pd.DataFrame(rows).round(4) + 0.0).to_csv(FILE, index=False, float_format="%.4f")


if __name__ == "__main__":
    main()

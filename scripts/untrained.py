"""What a robot earns and costs that learns nothing: ``python scripts/untrained.py``.

Writes ``docs/data/untrained.csv``: for each environment the mean return and cost of 20 episodes of
uniformly random actions and of actions of zero, with standard errors of the returns; and where
goals can be reached, the goals of an episode, and the cost of all episodes ÷ all goals. The tables
of what was learnt in lab/learnable.md and docs/leaderboard.md have them
(``scripts/results.py``, ``scripts/leaderboard.py``).
"""

from pathlib import Path

import numpy as np
import pandas as pd

from sb3_guard import make_vec_env
from sb3_guard.envs.part import Task
from sb3_guard.envs.suites import SUITES

FILE = Path(__file__).parents[1] / "docs" / "data" / "untrained.csv"
EPISODES = 20
SEED = 10_000


def episodes(env_id: str, actions: str) -> dict[str, float]:
    """The means of 20 episodes, one per environment, and the standard error of the returns."""
    env = make_vec_env(env_id, EPISODES, seed=SEED)
    env.action_space.seed(SEED)
    env.reset()
    zero = np.zeros((EPISODES, *env.action_space.shape), dtype=np.float32)
    found: dict[int, dict[str, float]] = {}
    goals = np.zeros(EPISODES)
    while len(found) < EPISODES:
        random = np.stack([env.action_space.sample() for _ in range(EPISODES)])
        *_, infos = env.step(random if actions == "random" else zero)
        for i, info in enumerate(infos):
            goals[i] += i not in found and info.get("goal_met", False)
            if "episode" in info:
                found.setdefault(i, info["episode"])
    has_goals = type(env.unwrapped.envs.engine.task).succeeded is not Task.succeeded
    env.close()
    returns, costs = (np.array([episode[key] for episode in found.values()]) for key in "rc")
    means = {
        actions: returns.mean(),
        f"{actions}_se": returns.std(ddof=1) / np.sqrt(EPISODES),
        f"{actions}_cost": costs.mean(),
    }
    if has_goals:
        per_goal = costs.sum() / goals.sum() if goals.any() else np.nan
        means |= {f"{actions}_goals": goals.mean(), f"{actions}_cost_per_goal": per_goal}
    return means


def main() -> None:
    rows = []
    for env_id in (env_id for suite in SUITES.values() for env_id in suite.scenarios):
        rows.append({"suite": env_id, **episodes(env_id, "random"), **episodes(env_id, "zero")})
        print(rows[-1], flush=True)
    table = pd.DataFrame(rows).set_index("suite").round(4) + 0.0  # no -0.0
    table.to_csv(FILE, float_format="%.4f")


if __name__ == "__main__":
    main()

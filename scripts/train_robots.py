"""Train TRPO briefly on every robot and compare it with random actions.

``python scripts/train_robots.py`` trains on ``Goal_<Robot>_8Hazards`` and prints a row per robot:
the mean return of 20 episodes of random actions and of the trained agent as it trained (the paper's
metrics are of the stochastic policy), each with its standard error, and how many standard errors of
the difference lie between them; and the trained agent's return without noise.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from untrained import EPISODES, episodes

from sb3_guard import TRPO, evaluate_policy, make_vec_env
from sb3_guard.envs.registry import ROBOTS, guard
from sb3_guard.zoo.hyperparams import build, check, read_hyperparams

SLOW = {"Doggo", "Ant", "Walker", "Humanoid"}  # twice the steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="+", default=list(guard(ROBOTS)), choices=list(ROBOTS))
    parser.add_argument("-n", "--n-timesteps", type=float, default=5e5, help="steps per robot")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=None, help="torch and physics threads")
    parser.add_argument(
        "-f", "--folder", type=Path, default=Path("logs/robots"),
        help="where the agents are saved; those that are there are not trained again",
    )  # fmt: skip
    args = parser.parse_args()
    if args.threads:
        torch.set_num_threads(args.threads)
    print(f"TRPO, seed {args.seed}, {EPISODES} episodes each, mean ± standard error")
    print("| robot | steps | random | trained | apart, s.e. | episode cost | without noise |")
    print("|---|---|---|---|---|---|---|")
    for robot in args.robots:
        env_id = f"Goal_{robot}_8Hazards-v0"
        steps = int(args.n_timesteps) * (2 if robot in SLOW else 1)
        setup = build(check("trpo", TRPO, read_hyperparams("trpo", env_id)))
        agent = args.folder / f"trpo_{robot}.zip"
        if agent.exists():
            model = TRPO.load(agent)
        else:
            env = make_vec_env(env_id, setup.n_envs, seed=args.seed, num_threads=args.threads)
            model = TRPO(env=env, seed=args.seed, **setup.model).learn(steps)
            env.close()
            model.save(agent)
        before = episodes(env_id, "random")
        test = make_vec_env(env_id, EPISODES, seed=args.seed + 20_000, num_threads=args.threads)
        result = evaluate_policy(model, test, n_eval_episodes=EPISODES, deterministic=False)
        fixed = evaluate_policy(model, test, n_eval_episodes=EPISODES)
        error = result.returns.std(ddof=1) / np.sqrt(EPISODES)
        apart = (result.returns.mean() - before["random"]) / np.hypot(error, before["random_se"])
        print(
            f"| {robot} | {model.num_timesteps:,} | {before['random']:.2f} "
            f"± {before['random_se']:.2f} | {result.returns.mean():.2f} ± {error:.2f} "
            f"| {apart:.1f} | {result.costs.mean():.2f} | {fixed.returns.mean():.2f} |",
            flush=True,
        )
        test.close()


if __name__ == "__main__":
    main()

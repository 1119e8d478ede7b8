"""How soon an action changes the cost: ``python scripts/reach_of_an_action.py``.

A trained agent drives Goal_Point_8Hazards with its noise. Now and then every row takes one of nine
actions for one step and is then driven by the agent without noise, each time from the same state.
Printed is by how much the cost of the k-th step depends on which of the nine it was (highest less
lowest), the mean over the rows that meet a cost within the steps looked ahead. A safety layer that
predicts the cost of the k-th step has to tell that from its model's error.
"""

import argparse
import itertools

import numpy as np

from sb3_guard.algorithms import CPO
from sb3_guard.common.vec_env import GuardVecEnv
from sb3_guard.zoo.playback import PRETRAINED

ENV = "Goal_Point_8Hazards"
ACTIONS = [np.array(pair, np.float32) for pair in itertools.product((-1.0, 0.0, 1.0), repeat=2)]


def spread(env: GuardVecEnv, model: CPO, ahead: int) -> tuple[np.ndarray, float]:
    """The spread from where the rows are, (ahead, rows that meet a cost), and their mean cost."""
    state, costs = env.state(), np.zeros((len(ACTIONS), ahead, env.num_envs))
    for i, first in enumerate(ACTIONS):
        env.restore(state)
        action = np.tile(first, (env.num_envs, 1))
        for step in range(ahead):
            observation, _, _, infos = env.step(action)
            costs[i, step] = [info["cost"] for info in infos]
            action, _ = model.predict(observation, deterministic=True)
    env.restore(state)
    costs = costs[:, :, costs.any(axis=(0, 1))]
    return np.ptp(costs, axis=0), float(costs.mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rows", type=int, default=300, help="environments side by side")
    parser.add_argument("--ahead", type=int, default=30, help="steps to look ahead")
    parser.add_argument("--every", type=int, default=50, help="steps from one look to the next")
    parser.add_argument("--looks", type=int, default=10)
    flags = parser.parse_args()
    model = CPO.load(PRETRAINED / "cpo" / f"{ENV}-v0_1" / f"{ENV}-v0.zip", device="cpu")
    env = GuardVecEnv(ENV, flags.rows)
    env.seed(0)
    observation, found = env.reset(), []
    for step in range(1, flags.looks * flags.every + 1):
        observation, *_ = env.step(model.predict(observation)[0])
        if step % flags.every == 0:
            found.append(spread(env, model, flags.ahead))
    spreads = np.concatenate([each for each, _ in found], axis=1)
    print(f"{spreads.shape[1]} rows, mean cost {np.mean([cost for _, cost in found]):.3f} a step")
    for k in (1, 2, 5, 10, 20, 30):
        if k <= flags.ahead:
            error = spreads[k - 1].std(ddof=1) / np.sqrt(spreads.shape[1])
            print(f"step {k:2}: {spreads[k - 1].mean():.4f} ± {error:.4f}")


if __name__ == "__main__":
    main()

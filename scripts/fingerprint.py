"""Print a hash of what environments and algorithms compute, to compare two states of the code.

A refactoring must leave every line as it was::

    make -s fingerprint > before.txt        # then change the code
    make -s fingerprint | diff before.txt -

Each suite is stepped 200 times in three rows with random actions: observations, rewards, costs and
ends of episodes are hashed. Each algorithm learns for a few seconds: its weights are hashed. The
hashes hold on one machine with one set of packages; one thread each.
"""

import argparse
import hashlib
import importlib
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

import sb3_guard


def suite(env_id: str) -> str:
    """The hash of 200 random steps of three rows, cut every 80."""
    env = sb3_guard.make_vec_env(env_id, 3, seed=7, num_threads=1, max_episode_steps=80)
    rng = np.random.default_rng(1)
    digest = hashlib.sha256(env.reset().tobytes())  # type: ignore[union-attr]
    for _ in range(200):
        actions = rng.uniform(-1, 1, (3, *env.action_space.shape)).astype(np.float32)  # type: ignore[misc]
        obs, rewards, dones, infos = env.step(actions)
        costs = np.array(
            [[info[k] for k in sorted(info) if k.startswith("cost")] for info in infos]
        )
        for array in (obs, rewards, dones, costs):
            digest.update(np.ascontiguousarray(array).tobytes())  # type: ignore[arg-type]
    env.close()
    return digest.hexdigest()[:16]


def algorithm(cls: Any) -> str:
    """The hash of all weights after ten updates of 1,000 steps, or off-policy after 800 steps."""
    env = sb3_guard.make_vec_env("Goal_Point_8Hazards", 4, seed=3, num_threads=1)
    arguments: dict[str, Any] = {"seed": 3, "device": "cpu", "cost_limit": 1.0}
    if issubclass(cls, OnPolicyAlgorithm):
        model = cls("MlpPolicy", env, n_steps=250, **arguments).learn(10_000)
    else:
        model = cls("MlpPolicy", env, **arguments).learn(800)
    digest = hashlib.sha256()
    for name, state in sorted(model.get_parameters().items()):
        if "optimizer" not in name:
            for key, value in state.items():
                digest.update(key.encode() + value.cpu().numpy().tobytes())
    env.close()
    return digest.hexdigest()[:16]


def main() -> None:
    """Print a line for each environment and algorithm."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", help="environments and algorithms; none: all")
    parser.add_argument("--only", choices=["suites", "algorithms"])
    args = parser.parse_args()
    th.set_num_threads(1)
    hashes = {}
    if args.only != "algorithms":
        hashes |= {env_id: partial(suite, env_id) for env_id in sb3_guard.env_ids("guard")}
    if args.only != "suites":
        algorithms = importlib.import_module("sb3_guard.algorithms").ALGORITHMS
        hashes |= {key: partial(algorithm, algorithms[key]) for key in sorted(algorithms)}
    for name in args.names or hashes:
        print(name, hashes[name](), flush=True)


if __name__ == "__main__":
    main()

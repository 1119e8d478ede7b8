"""Step many environments at once, with Gymnasium and NumPy alone."""

import time

import gymnasium
import numpy as np

import sb3_guard  # noqa: F401 (registers the environments)

n = 32

# One batch of simulations, stepped by C++ threads. Row i equals, bit for bit, a single environment
# with seed 7 + i. Episodes restart in the step that ends them.
envs = gymnasium.make_vec("Goal_Ant_8Hazards-v0", num_envs=n)
rng = np.random.default_rng(0)
obs, _ = envs.reset(seed=7)
returns, costs, finished = np.zeros(n), np.zeros(n), []
began = time.perf_counter()
for _ in range(3000):
    obs, rewards, terminated, truncated, infos = envs.step(
        rng.uniform(-1, 1, envs.action_space.shape)
    )
    returns += rewards
    costs += infos["cost"]
    for row in np.flatnonzero(terminated | truncated):
        finished.append((returns[row], costs[row]))
        returns[row] = costs[row] = 0.0
seconds = time.perf_counter() - began
envs.close()

print(f"{3000 * n / seconds:,.0f} steps per second, observations {obs.shape}")
print("return and cost of random actions:", np.mean(finished, axis=0).round(2))

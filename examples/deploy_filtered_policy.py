"""Train a policy with a safety layer, and run it without the algorithm."""

import gymnasium
import numpy as np

from sb3_guard import make_model
from sb3_guard.algorithms.common.policies import FilteredPolicy

# After a third of the training, the layer corrects actions whose predicted cost is above 0.
model = make_model("trpo_sl", "Goal_Point_8Hazards", cost_limit=0.0, n_envs=10, seed=0)
model.learn(300_000)
model.policy.save("filtered_policy.pt")

# The file holds the network and its layer: no algorithm, critic or environment is needed.
policy = FilteredPolicy.load("filtered_policy.pt", device="cpu")
plant = gymnasium.make("Goal_Point_8Hazards-v0")
for filtered in (True, False):
    policy.action_filter.active.fill_(filtered)
    paid = 0.0
    for seed in range(5):
        obs, _ = plant.reset(seed=seed)
        cost, over = 0.0, False
        while not over:
            # The layer predicts from the cost of the last step; without it, it estimates that too.
            action, _ = policy.predict(obs, state=(np.array([[cost]]),), deterministic=True)
            obs, _, terminated, truncated, info = plant.step(action)
            cost, over = info["cost"], terminated or truncated
            paid += cost
    print(f"cost of an episode {'with' if filtered else 'without'} the layer: {paid / 5:.2f}")

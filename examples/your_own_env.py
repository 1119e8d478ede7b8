"""How do I train in an environment of my own, or add a cost to one that has none?"""

import gymnasium
import numpy as np

from sb3_guard import CPO, SACLag, TRPOLag, evaluate_policy, make_vec_env
from sb3_guard.common.adapters import CostFromFunction


class Shore(gymnasium.Env):
    """The reward grows to the right; beyond 0 there is a cost. All it takes is info["cost"]."""

    observation_space = gymnasium.spaces.Box(-2.0, 2.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1.0, -0.5, 1).astype(np.float32)
        return self.x.copy(), {}

    def step(self, action):
        self.x = np.clip(self.x + 0.1 * action, -2, 2).astype(np.float32)
        return self.x.copy(), float(self.x[0]), False, False, {"cost": max(0.0, float(self.x[0]))}


gymnasium.register("Shore-v0", entry_point=Shore, max_episode_steps=50)
model = CPO("MlpPolicy", make_vec_env("Shore-v0", 4), n_steps=500, cost_limit=2.0, seed=0)
print("costs of episodes:", evaluate_policy(model.learn(100_000), model.env).costs)

replaying = SACLag("MlpPolicy", model.env, buffer_size=100_000, cost_limit=2.0, seed=0)
print("off-policy:", evaluate_policy(replaying.learn(100_000), model.env).costs)

pole = make_vec_env("CartPole-v1", 4, wrapper_class=lambda env: CostFromFunction(
    env, lambda obs, action, next_obs, info: abs(next_obs[0]) > 0.5))  # fmt: skip
model = TRPOLag("MlpPolicy", pole, n_steps=500, cost_limit=5.0, seed=0).learn(100_000)
print("steps off the middle:", evaluate_policy(model, pole).costs)

"""How do I write a constraint of my own? (A task is written alike.)"""

from dataclasses import dataclass

import numpy as np

from sb3_guard import evaluate_policy, make_model, register_constraint
from sb3_guard.envs.observation import Values
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Constraint


@dataclass
class Fence(Constraint):
    """The robot has to stay near the origin: every step outside costs 1."""

    name = "fence"
    trespassable, movable = True, "no"

    radius: float = param(1.5, "distance from the origin without cost, m", above=0)

    def _room(self):  # [N] m, for all simulations at once; negative outside
        return self.radius - np.linalg.norm(self.sim.robot.position[:, :2], axis=1)

    def cost(self):
        return (self._room() < 0).astype(float)

    def observations(self):  # the agent must observe what gives it cost
        return {"fence": Values(self._room()[:, None], unit="m")}


register_constraint("Fence", Fence)
limit = {"cost_keys": ["cost_fence"], "cost_limit": 25.0}
fence = {"fence": {"radius": 1.2}}
model = make_model("trpo_lag", "Goal_Point_4Hazards", env_kwargs=fence, n_envs=10, seed=0, **limit)
env = model.learn(300_000).get_env()
print("steps outside:", evaluate_policy(model, env, n_eval_episodes=10, seed=1).key_costs[:, 0])

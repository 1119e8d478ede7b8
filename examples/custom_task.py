"""A task of your own, for every robot and constraint."""

from dataclasses import dataclass

import numpy as np

from sb3_guard import evaluate_policy, make_model, register_task
from sb3_guard.envs.observation import Compass, Values
from sb3_guard.envs.part import Task


@dataclass
class Lap(Task):
    """Run around the origin counterclockwise: the reward is the arc covered, best 1 m away."""

    name = "lap"
    interactive, contact, targets = False, False, "one"

    def measure(self):  # [N, 2] m: what the reward is computed from, before and after a step
        return self.sim.robot.position[:, :2].copy()

    def reward(self, before, now):
        radius = np.linalg.norm(now, axis=1)
        swept = before[:, 0] * now[:, 1] - before[:, 1] * now[:, 0]  # r² dφ
        return swept / np.maximum(radius, 0.1) / (1 + np.abs(radius - 1))

    def observations(self):  # what the robot observes: by lidar (Scan), by Compass, or as Values
        distance = np.linalg.norm(self.measure(), axis=1, keepdims=True)
        return {
            "center_compass": Compass(np.zeros((self.sim.num_envs, 3))),
            "center_distance": Values(distance, low=0.0, unit="m"),
        }


register_task("Lap", Lap)
model = make_model("cpo", "Lap_Point_4Hazards", cost_limit=5.0, n_envs=10, seed=0)
env = model.learn(300_000).get_env()
print("metres:", evaluate_policy(model, env, n_eval_episodes=10, seed=1).returns.round(1))

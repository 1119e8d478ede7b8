"""A task of your own, for every robot and constraint."""

from dataclasses import dataclass

import numpy as np

from sb3_guard import CPO, evaluate_policy, make_vec_env, register_task
from sb3_guard.envs.part import Task
from sb3_guard.envs.sensors import Channel, Compass


@dataclass
class Circle(Task):
    """Run around the origin counterclockwise: the reward is the arc covered, best 1 m away."""

    name = "circle"
    interactive, contact, targets = False, False, "one"

    def measure(self):  # [N, 2] m: what the reward is made of, before and after a step
        return self.sim.robot.position[:, :2].copy()

    def reward(self, before, now):
        radius = np.linalg.norm(now, axis=1)
        swept = before[:, 0] * now[:, 1] - before[:, 1] * now[:, 0]  # r² dφ
        return swept / np.maximum(radius, 0.1) / (1 + np.abs(radius - 1))

    def sights(self):  # what the robot sees, by lidar (Scan) or compass
        return {"center_compass": Compass(np.zeros((self.sim.num_envs, 3)))}

    def observe(self):  # what else it knows
        return {"center_distance": np.linalg.norm(self.measure(), axis=1, keepdims=True)}

    def channels(self):
        return {"center_distance": Channel(1, low=0.0, unit="m")}


register_task("Circle", Circle)
env = make_vec_env("Circle_Point_4Hazards", n_envs=10, seed=0)
model = CPO("MlpPolicy", env, n_steps=1000, cost_limit=5.0, seed=0).learn(300_000)
print("metres:", evaluate_policy(model, env, n_eval_episodes=10, seed=1).returns.round(1))

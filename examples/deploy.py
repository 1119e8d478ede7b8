"""Run an exported agent at 50 Hz, with onnxruntime alone."""

import json
import time

import gymnasium
import numpy as np
import onnxruntime

import sb3_guard.envs  # noqa: F401  # the simulation that stands in for the robot

with open("contract.json") as file:  # sb3-guard export --pretrained writes both files
    contract = json.load(file)
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1
policy = onnxruntime.InferenceSession("policy.onnx", options)
period, limits = contract["control_step"], contract["outputs"][0]
robot, rng = gymnasium.make(contract["trained"]["env"]), np.random.default_rng(0)

latest, _ = robot.reset(seed=0)
observation, missing, stops, late, costs = latest, 0, 0, 0, []
for _ in range(500):
    began = time.perf_counter()
    lost = rng.random() < 0.05  # a sensor that loses one message in twenty
    missing = missing + 1 if lost else 0
    observation = observation if lost else latest  # the last one that has arrived
    action = policy.run(["action"], {"observation": observation[None]})[0][0]
    late += time.perf_counter() - began > period
    if missing > 2 or time.perf_counter() - began > period or not np.isfinite(action).all():
        action, stops = np.zeros_like(action), stops + 1  # the watchdog stops the robot
    action = np.clip(action, limits["low"], limits["high"])
    latest, _, terminated, truncated, info = robot.step(action)
    costs.append(info["cost"])
    if terminated or truncated:
        latest, _ = robot.reset()
    time.sleep(max(0.0, began + period - time.perf_counter()))
np.savetxt("costs.csv", costs)
limit = contract["costs"][0]
print(f"cost {sum(costs):.2f} in {len(costs)} steps, limit {limit['limit']} per {limit['per']}")
print(f"stopped {stops} times, {late} steps were late")

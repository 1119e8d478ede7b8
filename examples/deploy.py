"""How do I run what ``sb3-guard export`` writes at 50 Hz, with onnxruntime alone?"""

import json
import time

import numpy as np
import onnxruntime

import sb3_guard  # the simulation that stands in for the robot

contract, policy = json.load(open("contract.json")), onnxruntime.InferenceSession("policy.onnx")
period, output, bound = contract["control_step"], contract["outputs"][0], contract["costs"][0]
inputs = {part["name"]: part["shape"][1:] for part in contract["inputs"]}
if other := inputs.keys() - {"observation", "last_cost", "noise"} | {*contract["wrappers"]}:
    raise SystemExit(f"this loop does not compute {', '.join(other)}, which contract.json names")
assert None not in output["stop"], "say what stops the robot: sb3-guard export --stop 0:0.0"
stop = np.array([np.nan if value == "hold" else value for value in output["stop"]], np.float32)
robot = sb3_guard.make(contract["trained"]["env"], **contract["trained"].get("env_kwargs", {}))
(latest, _), rng = robot.reset(seed=0), np.random.default_rng(0)
frames = np.resize(latest, inputs["observation"])  # of a stack: the first one, repeated
observation, missing, stops, cost, costs, sent = latest, 0, 0, 0.0, [], None
for _ in range(500):
    began, lost = time.perf_counter(), sent is not None and rng.random() < 0.05  # 1 in 20 is lost
    missing, observation = (missing + 1, observation) if lost else (0, latest)
    frames = np.append(frames[len(latest) :], np.float32(observation))
    noise = np.float32(rng.standard_normal((1, *inputs.get("noise", ()))))  # where it samples
    values = {"observation": frames[None], "last_cost": np.float32([[cost]]), "noise": noise}
    action = policy.run(["action"], {name: values[name] for name in inputs})[0][0]
    late = sent is not None and time.perf_counter() - began > period
    if missing > 2 or late or not np.isfinite(np.append(frames, action)).all():
        action, stops = np.where(np.isnan(stop), sent, stop), stops + 1  # "hold" is what was sent
    sent = np.clip(action, output["low"], output["high"])
    latest, _, terminated, truncated, info = robot.step(sent)
    costs.append(cost := info["cost"])
    if terminated or truncated:
        (latest, _), cost = robot.reset(), 0.0
        frames = np.resize(latest, inputs["observation"])
    time.sleep(max(0.0, began + period - time.perf_counter()))
np.savetxt("costs.csv", costs)
print(f"cost {sum(costs):.2f}, limit {bound['limit']} per {bound['per']}; stopped {stops} times")

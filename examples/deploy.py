"""How do I run what ``sb3-guard export`` writes at 50 Hz, with onnxruntime alone?

Start it beside the files; name the module that registers a robot of your own: deploy.py MODULE.
"""

import importlib
import json
import sys
import time

import numpy as np

try:
    import onnxruntime

    import sb3_guard  # the simulation that stands in for the robot

    sys.path.append("")
    modules = [importlib.import_module(name) for name in sys.argv[1:]]
    contract, policy = json.load(open("contract.json")), onnxruntime.InferenceSession("policy.onnx")
    robot = sb3_guard.make(contract["trained"]["env"], **contract["trained"].get("env_kwargs", {}))
except Exception as error:
    here = "start it beside policy.onnx; python deploy.py MODULE names what registers your robot"
    raise SystemExit(f"{error}: {here}") from None
period, output, bounds = contract["control_step"] or 0.02, contract["outputs"][0], contract["costs"]
inputs = {part["name"]: part["shape"][1:] for part in contract["inputs"]}
if other := inputs.keys() - {"observation", "last_cost", "noise"} | {*contract["wrappers"]}:
    raise SystemExit(f"this loop does not compute {', '.join(other)}, which contract.json names")
if None in output["stop"]:
    raise SystemExit("say what stops the robot: sb3-guard export --stop 0:0.0")
stop = np.array([np.nan if value == "hold" else value for value in output["stop"]], np.float32)
(latest, _), rng = robot.reset(seed=0), np.random.default_rng(0)
frames = np.resize(latest, inputs["observation"])  # of a stack: the first one, repeated
observation, missing, stops, cost, costs, sent, episodes = latest, 0, 0, 0.0, [], None, 1
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
    costs.append([info[bound["name"]] for bound in bounds])
    cost = sum(costs[-1])
    if terminated or truncated:
        (latest, _), cost, episodes = robot.reset(), 0.0, episodes + 1
        frames = np.resize(latest, inputs["observation"])
    time.sleep(max(0.0, began + period - time.perf_counter()))
np.savetxt("costs.csv", costs)
for bound, steps in zip(bounds, np.transpose(costs), strict=True):
    total = max(steps) if bound["per"] == "step" else sum(steps)
    print(f"{bound['name']} {total:.2f}, limit {bound['limit']} per {bound['per']}")
print(f"{len(costs)} steps of {episodes} episodes, stopped {stops} times")

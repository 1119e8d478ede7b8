"""Build the page in which trained agents drive: ``python scripts/make_browser.py``.

``docs/browser/`` has its sources and agents; MuJoCo for browsers comes from npm, as its lock file
says. The result is a folder for any static web server. ``--states N`` adds recorded control steps,
with which the page's environment is compared with this package's.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sb3_guard.envs import GuardEnv, env_spec
from sb3_guard.envs.constraints.obstacles import Obstacles
from sb3_guard.envs.engine import Engine
from sb3_guard.envs.observation import Compass, Lidar, Scan
from sb3_guard.envs.robots.robot import PREFIX, MJCFRobot
from sb3_guard.envs.tasks.goal import Goal

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "docs" / "browser"
OUTPUT = ROOT / "docs" / "_build" / "html" / "browser"
MODULES = ROOT / "docs" / "_build" / "npm"  # outside of the sources
PRETRAINED = "the agent that comes with the package"
#: Algorithm of the agents at each cost limit of an episode; None: without a limit.
AGENTS: dict[str, dict[float | None, str]] = {
    "Goal_Point_8Hazards-v0": {None: "trpo", 10: "cpo", 5: "cpo"},
    "SafetyPointGoal1-v0": {None: "trpo", 50: "cpo", 25: PRETRAINED},
}
# Parameters that the page needs
GOAL = ("size", "bonus", "reward_distance", "reward_limit")
LIDAR = ("bins", "falloff", "gain", "range", "alias")
APART = 3  # control steps between two recorded ones


def stem(env: str, limit: float | None) -> str:
    """Name of the folder of a training, and of its agent's file."""
    return f"{env}_{'none' if limit is None else limit}"


def trainings() -> Iterator[str]:
    """The commands that train an agent for each environment and limit."""
    for env, agents in AGENTS.items():
        for limit, algo in agents.items():
            bound = "" if limit is None else f" -params cost_limit:{limit}"
            train = f"sb3-guard train --algo {algo} --env {env} -n 1e6 --seed 0"
            if algo != PRETRAINED:
                yield f"{train} -f logs/{stem(env, limit)}{bound}"


def measured(certificate: dict[str, Any], limit: float | None) -> dict[str, Any]:
    """Mean return and cost of an agent's fresh episodes, bounds of the cost, and the verdict."""
    (cost,) = certificate["costs"].values()
    return {
        "episodes": certificate["episodes"],
        "return": round(certificate["mean_return"], 2),
        "cost": round(cost["mean"], 2),
        "low": round(cost["lower"], 2),
        "high": round(cost["upper"], 2),
        "verdict": "" if limit is None else certificate["verdict"],
    }


def pack(logs: Path, source: Path = SOURCE) -> None:
    """Export the agents of finished trainings, and list them with what fresh episodes show.

    :param logs: the trainings' folders
    :param source: folder of the page's sources, whose agents are replaced
    """
    shutil.rmtree(source / "agents", ignore_errors=True)
    (source / "agents").mkdir(parents=True)
    entries = []
    for env, algos in AGENTS.items():
        agents = []
        for limit, algo in algos.items():
            folder, name = logs / stem(env, limit), f"agents/{stem(env, limit)}.onnx"
            own = ["--pretrained"] if algo == PRETRAINED else ["--algo", algo, "-f", str(folder)]
            agents.append({"limit": limit, "file": name, **packed(env, own, limit, source / name)})
        entries.append({"env": env, "agents": agents})
    (source / "agents.json").write_text(json.dumps(entries, indent=1) + "\n")


def packed(env: str, own: list[str], limit: float | None, file: Path) -> dict[str, Any]:
    """Export an agent, the certified one where a training delivered it, and let it play."""
    own = ["--env", env, *own]
    with tempfile.TemporaryDirectory() as folder:  # contract.json goes there too
        exported = Path(folder) / "agent.onnx"
        call(
            "export_agent", *own, "--deterministic", "--n-episodes", "1", "--output", str(exported)
        )
        shutil.copy(exported, file)
        trained = json.loads((Path(folder) / "contract.json").read_text())["trained"]
        agent = {"algorithm": trained["algorithm"], "steps": trained["timesteps"]}
        # Without a limit: more than an episode can cost
        bound = ["--cost-limit", "1e4" if limit is None else str(limit)]
        for name, mode in {"sampled": ["--stochastic"], "greedy": ["--deterministic"]}.items():
            report = Path(folder) / f"{name}.json"
            call("certify_agent", *own, *mode, *bound, "--json", str(report))
            agent[name] = measured(json.loads(report.read_text()), limit)
    return agent


def call(command: str, *flags: str) -> None:
    """Run a command of the package; 1 says that an agent is not certified."""
    done = subprocess.run([sys.executable, "-m", f"sb3_guard.{command}", *flags], check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(done.returncode)


def mjcf(engine: Engine) -> str:
    """The model of ``engine.spec.to_xml()``, as MuJoCo 3.14 reads it: a velocity
    actuator does not state its input."""
    return str(engine.spec.to_xml()).replace(' input="vel"', "")


def observation(engine: Engine, model: mujoco.MjModel) -> Iterator[dict[str, Any]]:
    """What each component of the observation is, in the order of the flat observation.

    :raises ValueError: the page cannot compute one
    """
    seen = {name: what for part in engine.parts for name, what in part.observations().items()}
    sensors = {model.sensor(i).name: i for i in range(model.nsensor)}
    for name in engine.observation_layout:
        if isinstance(seen[name], Scan):
            yield {"name": name, "kind": "lidar", "of": name.removesuffix("_lidar")}
        elif isinstance(seen[name], Compass):
            yield {"name": name, "kind": "compass", "of": name.removesuffix("_compass")}
        elif PREFIX + name in sensors:
            i = sensors[PREFIX + name]
            first, size = int(model.sensor_adr[i]), int(model.sensor_dim[i])
            yield {"name": name, "kind": "sensor", "first": first, "size": size}
        else:
            raise ValueError(f"{name!r} is no sensor, lidar or compass: the page can't compute it")


def world(env_id: str) -> dict[str, Any]:
    """An environment as the page's ``world.js`` reads it: model, parameters, observation.

    :raises ValueError: the page cannot compute the environment
    """
    spec = env_spec(env_id)
    env = GuardEnv(**spec.kwargs)
    env.reset(seed=0)
    engine = env.engine
    robot, task, lidar = engine.robot, engine.task, Lidar(**env.scenario.lidar)
    if not isinstance(robot, MJCFRobot) or not isinstance(task, Goal):
        raise ValueError(f"{env_id}: the page knows robots from MJCF files and the task Goal")
    text = mjcf(engine)
    model = mujoco.MjModel.from_xml_string(text)
    low, high = (np.broadcast_to(bound, model.nu) for bound in robot.action_range)
    least, most = robot.controls
    half = (most - least) / (high - low)
    control = {"low": low, "high": high, "center": least - half * low, "half": half}
    zones, bodies = [], []
    for part in engine.constraints:
        assert isinstance(part, Obstacles)
        if not part.solid:
            zones.append({"name": part.name, "size": part.size, "weight": part.weight})
            continue
        if part.weight or not part.group.movable:
            raise ValueError(f"{env_id}: solid {part.name} that cost or stay are not in the page")
        for index, name in enumerate(part.group.movable):
            body = model.body(name)
            first = int(model.jnt_qposadr[body.jntadr[0]])
            height = float(engine.batch.bind("qpos")[0, first + 2])
            bodies.append({"name": part.name, "index": index, "body": int(body.id), "qpos": first,
                           "height": height, "size": part.size})  # fmt: skip
    order = env.scenario.layout.get("order", [])
    placed = sorted(  # stable, as in sb3_guard.envs.placing
        engine.footprints.values(),
        key=lambda f: order.index(f.name) if f.name in order else len(order),
    )
    footprints = [
        {"name": f.name, "num": f.num, "keepout": f.keepout, "last": f.last} for f in placed
    ]
    return {
        "id": env_id,
        "model": text,
        "steps": spec.max_episode_steps,
        "control_step": engine.control_step,
        "frame_skip": engine.batch.frame_skip,
        "arena": engine.arena.size,
        "cost": env.scenario.cost,
        "robot": {
            "body": int(model.body(robot.root).id),
            "mocap": int(model.body_mocapid[model.body("spawn").id]),
        },
        "control": {name: np.asarray(value, float).tolist() for name, value in control.items()},
        "goal": {name: getattr(task, name) for name in GOAL},
        "zones": zones,
        "bodies": bodies,
        "footprints": footprints,
        "lidar": {name: getattr(lidar, name) for name in LIDAR},
        "observation": list(observation(engine, model)),
    }


def steer(engine: Engine, rng: np.random.Generator) -> np.ndarray:
    """An action towards the goal, with noise: it reaches goals and crosses what is between."""
    origin, rotation = engine.robot.frames
    x, y, _ = rotation[0, 0].T @ (engine.task.place[0] - origin[0, 0])
    return np.clip([1.0, 2.0 * np.arctan2(y, x)] + 0.5 * rng.standard_normal(2), -1.0, 1.0)


def states(env_id: str, number: int) -> list[dict[str, Any]]:
    """Recorded control steps: the state before, the action, and what the environment returned."""
    env = GuardEnv(**env_spec(env_id).kwargs)
    engine, rng = env.engine, np.random.default_rng(0)
    fields = ("qpos", "qvel", "mocap_pos", "mocap_quat", "qacc_warmstart")
    names = [name for name in engine.footprints if name != "robot"]
    steps: list[dict[str, Any]] = []
    for step in range(APART * number):
        if step % 500 == 0:
            env.reset(seed=step)
        before: dict[str, Any] = {
            name: np.ravel(engine.batch.bind(name)[0]).tolist() for name in fields
        }
        before["places"] = {name: engine.places(name)[0, :, :2].tolist() for name in names}
        action = steer(engine, rng)
        obs, reward, _, _, info = env.step(action)
        if step % APART == 0:
            after = {"obs": obs.tolist(), "reward": reward, "cost": info["cost"]}
            goal = engine.places("goal")[0, 0, :2].tolist()
            steps.append({**before, "action": action.tolist(), "goal": goal, **after})
    return steps


def build(output: Path, number: int = 0) -> None:
    """Write the page.

    :param output: folder, made anew
    :param number: recorded control steps of each environment that are added
    """
    MODULES.mkdir(parents=True, exist_ok=True)
    for name in ("package.json", "package-lock.json"):
        shutil.copy(SOURCE / name, MODULES)
    subprocess.run(["npm", "ci", "--no-audit", "--no-fund", "--silent"], cwd=MODULES, check=True)
    shutil.rmtree(output, ignore_errors=True)
    shutil.copytree(SOURCE, output, ignore=shutil.ignore_patterns("package*.json"))
    package = MODULES / "node_modules" / "@mujoco" / "mujoco"
    for name in ("mujoco.js", "mujoco.wasm"):
        shutil.copy(package / name, output)
    for env_id in AGENTS:
        (output / f"{env_id}.json").write_text(json.dumps(world(env_id)))
        if number:
            (output / f"{env_id}.states.json").write_text(json.dumps(states(env_id, number)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder of the page")
    parser.add_argument("--states", type=int, default=0, help="recorded control steps to add")
    parser.add_argument("--trainings", action="store_true", help="print commands that train agents")
    parser.add_argument(
        "--agents", type=Path, help="logs of these trainings, to pack the agents of"
    )
    args = parser.parse_args()
    if args.trainings:
        print(*trainings(), sep="\n")
    elif args.agents:
        pack(args.agents)
    else:
        build(args.output, args.states)
        print(f"wrote {args.output}: python -m http.server -d {args.output}")


if __name__ == "__main__":
    main()

"""Record what Safety-Gymnasium 1.0.0 does, as the yardstick of our own tasks of the same names.

``scripts/safety_gymnasium/check.py`` sets up the environment that this runs in::

    .venv-mujoco-2.3.3/bin/python scripts/safety_gymnasium/record.py          # all 52 ids
    .venv-mujoco-2.3.3/bin/python scripts/safety_gymnasium/record.py --match Button1

For each id, ``tests/data/safety_gymnasium/<name>.npz`` holds at least 200 states and what one step
made of each. A trace is made of segments: the robot is placed next to an object and driven at it,
so that every event that the task knows happens; others are random. After the physics of a step,
before the package computes rewards, costs and observations from it, the state is rounded to a grid
and the start of the solver, ``qacc_warmstart``, set to 0: positions and velocities in the files are
exact and small. Observations have 21 bits.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import types
import zipfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import safety_gymnasium
import safety_gymnasium.world as world_module

OUT = Path(__file__).resolve().parents[2] / "tests" / "data" / "safety_gymnasium"
ROBOTS = ("Point", "Car", "Ant", "Doggo")
TASKS = [f"{t}{n}" for t in ("Goal", "Button", "Push", "Circle") for n in range(3)] + ["Run0"]
GRID = {"qpos": 2.0**-20, "qvel": 2.0**-19}
# what begins ahead of a robot's centre, m, and which way that is in its own frame
NOSE = {"Point": 0.15, "Car": 0.175, "Ant": 0.2, "Doggo": 0.13}
AHEAD = {"Point": 0.0, "Car": -np.pi / 2, "Ant": 0.0, "Doggo": 0.0}
OBJECTS = {"hazards": 0.2, "vases": 0.1, "pillars": 0.2, "gremlins": 0.1, "buttons": 0.1}


def without_textures() -> None:
    """Building a world takes seconds, nearly all for textures; the physics does not know them."""

    def from_xml_string(text: str) -> Any:
        text = re.sub(r"<asset>.*?</asset>", "", text, flags=re.DOTALL)
        return mujoco.MjModel.from_xml_string(re.sub(r' material="[^"]*"', "", text))

    fast = types.SimpleNamespace(**vars(mujoco))
    fast.MjModel = types.SimpleNamespace(from_xml_string=from_xml_string)
    world_module.mujoco = fast


class Recorder:
    """One id of Safety-Gymnasium, and what has been recorded of it."""

    def __init__(self, name: str, seed: int) -> None:
        self.name = name
        self.robot = next(r for r in ROBOTS if name.startswith(r))
        self.speed = 1.0 if self.robot in ("Point", "Car") else 1.6  # m/s, when driving at things
        self.rng = np.random.default_rng(seed)
        self.env = safety_gymnasium.make(f"Safety{name}-v0").unwrapped
        self.task = self.env.task
        physics = self.task.simulation_forward

        def simulation_forward(action: Any) -> Any:
            failed = physics(action)
            self.settle()
            return failed

        self.task.simulation_forward = simulation_forward
        self.states: list[dict[str, Any]] = []
        self.steps: list[dict[str, Any]] = []
        self.worlds: list[dict[str, Any]] = []
        self.begin()

    @property
    def data(self) -> Any:
        return self.task.data

    def begin(self) -> None:
        """A new episode: a new layout."""
        self.env.reset(seed=int(self.rng.integers(2**31)))
        self.settle()
        self.refer()
        config = self.task.world_info.world_config_dict
        world = {"robot": np.append(config["agent_xy"], config["agent_rot"])}
        for kind in (*OBJECTS, "goal"):
            thing = getattr(self.task, kind, None)
            if thing is not None and kind not in ("goal", "vases"):
                world[kind] = np.array(thing.pos).reshape(-1, 3)
        if hasattr(self.task, "gremlins"):
            world["gremlin_quat"] = np.array(
                [self.data.body(f"gremlin{i}obj").xquat for i in range(self.task.gremlins.num)]
            )
        self.worlds.append(world)

    def settle(self) -> None:
        """Round the state to the grid."""
        for field, grid in GRID.items():
            values = getattr(self.data, field)
            values[:] = np.round(values / grid) * grid
        self.data.qvel[:] = shorten(self.data.qvel, 11)
        self.data.qacc_warmstart[:] = 0.0
        mujoco.mj_forward(self.task.model, self.data)

    def refer(self) -> None:
        """Let the task measure its distances from the state as it is now set."""
        for field in ("goal", "box"):
            if getattr(self.task, f"last_dist_{field}", None) is not None:
                setattr(self.task, f"last_dist_{field}", getattr(self.task, f"dist_{field}")())
        if hasattr(self.task, "last_box_goal"):
            self.task.last_box_goal = self.task.dist_box_goal()
        if hasattr(self.task, "old_potential"):
            self.task.specific_reset()

    def place(self, xy: Any, heading: float, speed: float = 0.0, **more: float) -> None:
        """Put the robot in its first pose somewhere else, moving ahead."""
        data, turn = self.data, heading - AHEAD[self.robot]
        forward = np.array([np.cos(heading), np.sin(heading)])
        if self.robot == "Point":
            x, y, start = self.worlds[-1]["robot"]
            c, s = np.cos(start), np.sin(start)
            into = np.array([[c, s], [-s, c]])  # of the frame in which its slides are
            data.qpos[:2], data.qpos[2] = into @ (np.asarray(xy) - (x, y)), turn - start
            data.qvel[:2], data.qvel[2] = into @ forward * speed, 0.0
            return
        joint = data.joint("root" if self.robot == "Ant" else "agent")
        joint.qpos[:3] = [*xy, more.get("z", self.task.agent.z_height)]
        pose, lean = np.zeros(4), more.get("lean", 0.0)
        upright = np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)])
        mujoco.mju_mulQuat(pose, upright, np.array([np.cos(lean / 2), np.sin(lean / 2), 0, 0]))
        joint.qpos[3:] = pose
        joint.qvel[:] = 0.0
        joint.qvel[:2] = forward * speed
        joint.qvel[2] = more.get("rise", 0.0)

    def approach(self, target: Any, radius: float, speed: float, gap: float = 0.03) -> None:
        """Place the robot ``gap`` before something round, heading for it, clear of all else."""
        target = np.asarray(target)[:2]
        others = [
            np.asarray(p)[:2]
            for kind in (*OBJECTS, "push_box")
            if kind != "hazards" and hasattr(self.task, kind)
            for p in np.array(getattr(self.task, kind).pos).reshape(-1, 3)
        ]
        others = [p for p in others if np.linalg.norm(p - target) > 1e-6]
        away = radius + NOSE[self.robot] + gap
        angles = self.rng.uniform(0, 2 * np.pi) + np.arange(24) * np.pi / 12
        places = target + away * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        room = [min((np.linalg.norm(p - o) for o in others), default=9.0) for p in places]
        best = int(np.argmax(room))
        self.place(places[best], angles[best] + np.pi, speed)

    def act(self, drive: bool) -> Any:
        """Random, now and then out of bounds; ``drive``: ahead, where the robot has wheels."""
        action = self.rng.uniform(-1.25, 1.25, self.task.action_space.shape)
        if drive and self.robot == "Point":
            action = np.array([1.0, 0.1 * action[1]])
        elif drive and self.robot == "Car":
            action = 1.0 + 0.1 * action
        return np.round(action, 2)

    def segment(self, steps: int, drive: bool = False, fresh: bool = True) -> None:
        """Go on from the state as it is set now."""
        self.data.ctrl[:] = 0.0
        self.settle()
        self.refer()
        if fresh and hasattr(self.task, "buttons"):
            self.task.buttons.timer = 0
        self.note(first=True)
        for _ in range(steps):
            self.env.terminated = self.env.truncated = False
            self.env.steps = 0
            action = self.act(drive)
            with contextlib.redirect_stdout(io.StringIO()):
                _, reward, _, terminated, truncated, info = self.env.step(action)
            assert not truncated
            step = {"action": action, "reward": reward, "terminated": terminated, "info": info}
            self.steps.append({**step, "touched": self.touched(), "state": len(self.states) - 1})
            self.settle()
            self.note(first=False)

    def touched(self) -> list[str]:
        """The kinds of objects that the robot touches."""
        out = set()
        for contact in self.data.contact[: self.data.ncon]:
            names = {self.task.model.geom(g).name for g in (contact.geom1, contact.geom2)}
            mine = names & set(self.task.agent.body_info.geom_names)
            for name in names - mine if mine else ():
                kind = re.sub(r"\d+(obj)?$", "", name)
                out.add("push_box" if kind.startswith(("push_box", "col")) else kind + "s")
        return sorted(out - {"floors"})

    def note(self, first: bool) -> None:
        data, task = self.data, self.task
        buttons, goal = getattr(task, "buttons", None), getattr(task, "goal", None)
        self.states.append(
            {
                **{field: getattr(data, field).copy() for field in GRID},
                "time": data.time,
                "mocap": data.mocap_pos[0].copy() if len(data.mocap_pos) else np.zeros(3),
                "goal": goal.pos[:2].copy() if goal is not None else np.zeros(2),
                "timer": 0 if buttons is None else buttons.timer,
                "goal_button": 0 if buttons is None else buttons.goal_button,
                "world": len(self.worlds) - 1,
                "first": first,
                "obs": self.task.obs(),
            }
        )
        data.qacc_warmstart[:] = 0.0

    def record(self) -> None:
        """All segments."""
        for _ in range(2):
            self.begin()
            self.segment(20)
        for kind, radius in OBJECTS.items():
            if hasattr(self.task, kind) and kind != "buttons":
                self.bump(kind, radius)
        if hasattr(self.task, "buttons"):
            self.press()
        elif hasattr(self.task, "push_box"):
            self.push()
        elif hasattr(self.task, "goal"):
            self.reach()
        elif hasattr(self.task, "sigwalls"):
            self.cross()
        if self.robot != "Point":
            self.tumble()
        while len(self.steps) < 200:
            free = self.task.floor_conf.size[0] > 5
            at = [0.1, 3.0] if free else self.rng.uniform(-0.9, 0.9, 2)
            self.place(at, self.rng.uniform(0, 6.28), self.rng.uniform(0, 1))
            self.segment(min(15, max(2, 200 - len(self.steps))))

    def bump(self, kind: str, radius: float) -> None:
        """Drive at objects of a kind, until two were met."""
        radius = 0.0 if kind == "hazards" else radius
        met = 0
        for i in range(6):
            things = np.array(getattr(self.task, kind).pos).reshape(-1, 3)
            self.approach(things[i % len(things)], radius, self.speed)
            self.segment(9, drive=True)
            met += kind == "hazards" or any(kind in s["touched"] for s in self.steps[-9:])
            if met == 2:
                break

    def press(self) -> None:
        """A wrong button, the right one, and a wrong one while the timer runs."""
        for turn in range(4):
            buttons = self.task.buttons
            wrong = (buttons.goal_button + 1 + turn) % buttons.num
            for which, fresh in ((wrong, True), (buttons.goal_button, True), (wrong, False)):
                self.approach(buttons.pos[which], buttons.size, speed=self.speed)
                self.segment(7, drive=True, fresh=fresh)

    def push(self) -> None:
        """Push the box, once until it is at the goal."""
        task, half = self.task, self.task.push_box.size
        for away in (half * 1.5 + 0.3, 0.36, 0.6, 0.5, 0.4, 0.6, 0.5):
            if away == 0.5 and any("push_box" in s["touched"] for s in self.steps):
                break
            goal = task.goal.pos[:2]
            inwards = np.arctan2(-goal[1], -goal[0])
            direction = np.array([np.cos(inwards), np.sin(inwards)])
            box = goal + away * direction
            joint = self.task.model.jnt("push_box")
            first, speed = int(joint.qposadr[0]), int(joint.dofadr[0])
            self.data.qpos[first : first + 2] = box
            turned = [np.cos(inwards / 2), 0, 0, np.sin(inwards / 2)]
            self.data.qpos[first + 3 : first + 7] = turned
            self.data.qvel[speed : speed + 6] = 0.0
            back = 1.25 * half + NOSE[self.robot] + 0.02
            self.place(box + back * direction, inwards + np.pi, speed=self.speed)
            self.segment(14, drive=True)

    def reach(self) -> None:
        """Reach three goals."""
        for _ in range(3):
            self.approach(self.task.goal.pos, 0.3, speed=self.speed, gap=0.0)
            self.segment(10, drive=True)

    def cross(self) -> None:
        """Cross each wall."""
        wall = self.task.sigwalls.locate_factor
        for angle in (0.0, np.pi, np.pi / 2, -np.pi / 2):
            out = np.array([np.cos(angle), np.sin(angle)])
            self.place((wall - 0.06) * out, angle, speed=self.speed)
            self.segment(10, drive=True)

    def tumble(self) -> None:
        """Lean, fall, and lie on a side."""
        high = self.task.agent.z_height
        for lean, z, rise in ((0.6, high + 0.08, 0.0), (1.7, high, 0.0), (0.0, 0.086, -0.5)):
            if rise and self.robot != "Ant":
                continue  # it would begin in the floor
            at = [0.1, 2.0] if self.task.floor_conf.size[0] > 5 else [0.3, -0.4]
            self.place(at, self.rng.uniform(0, 6.28), 0.3, lean=lean, z=z, rise=rise)
            self.segment(6)

    def arrays(self) -> dict[str, Any]:
        """What the file holds."""
        out = {k: np.array([s[k] for s in self.states]) for k in self.states[0]}
        out["obs"] = shorten(out["obs"], 21).astype(np.float32)
        for key in ("terminated", "state"):
            out[key] = np.array([s[key] for s in self.steps])
        actions = np.array([s["action"] for s in self.steps])
        out["action_percent"] = np.round(100 * actions).astype(np.int16)
        out["reward"] = np.array([s["reward"] for s in self.steps], dtype=float).reshape(-1)
        out["goal_met"] = np.array([s["info"].get("goal_met", False) for s in self.steps])
        names = sorted({k for s in self.steps for k in s["info"] if k.startswith("cost_")})
        for name in names:
            out[name] = np.array([s["info"].get(name, 0.0) > 0 for s in self.steps])
        kinds = sorted({k for s in self.steps for k in s["touched"]})
        for kind in kinds:
            out[f"touched_{kind}"] = np.array([kind in s["touched"] for s in self.steps])
        for key in self.worlds[0]:
            out[f"world_{key}"] = np.array([w[key] for w in self.worlds])
        return out


def shorten(values: Any, bits: int) -> Any:
    """Numbers with that many significant bits."""
    fraction, exponent = np.frexp(values)
    return np.ldexp(np.round(fraction * 2.0**bits) / 2.0**bits, exponent)


def planes(values: Any) -> Any:
    """Bytes of a kind side by side, which compress better; a float64 array [...] as [8, ...]."""
    raw = np.ascontiguousarray(values)
    return np.moveaxis(raw.view(np.uint8).reshape(*raw.shape, raw.itemsize), -1, 0)


def save(path: Path, arrays: dict[str, Any]) -> None:
    """A compressed archive; arrays of floats in planes of bytes, under names with their type."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        for name, values in arrays.items():
            if values.dtype.kind == "f":
                name, values = f"{name}:{values.dtype}", planes(values)
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, np.asarray(values))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--match", default="", help="only ids that contain this")
    args = parser.parse_args()
    without_textures()
    OUT.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(r + t for r in ROBOTS for t in TASKS):
        if args.match in name:
            recorder = Recorder(name, seed=i)
            recorder.record()
            arrays = recorder.arrays()
            save(OUT / f"{name}.npz", arrays)
            flags = {k: int(v.sum()) for k, v in arrays.items() if v.dtype == bool and k != "first"}
            size = (OUT / f"{name}.npz").stat().st_size
            print(name, len(arrays["reward"]), "steps", size, "bytes", flags, flush=True)


if __name__ == "__main__":
    main()

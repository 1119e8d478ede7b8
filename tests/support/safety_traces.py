"""Traces of Safety-Gymnasium 1.0.0, and our simulations in the states that they hold.

Each file of ``tests/data/safety_gymnasium`` but two holds the states of a navigation id and what
one step made of each, with MuJoCo 2.3.3. The robot was placed next to an object and driven at it,
so that every event that the task knows happens; other states are random. After the physics of a
step, before rewards, costs and observations are computed from it, the state was rounded to a grid
and the start of the solver, ``qacc_warmstart``, set to 0: positions and velocities in the files are
exact. Observations have 21 bits. ``velocity.npz`` has the same of the velocity tasks, with 24 bits,
and the states in which episodes of ten seeds begin; ``safety_distributions`` reads the other one.
docs/fidelity.md names the commit of the scripts that recorded them.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sb3_guard.envs import Scenario
from sb3_guard.envs.outcome import Outcome

FOLDER = Path(__file__).parents[1] / "data" / "safety_gymnasium"
GEOM = mujoco.mjtGeom
# Pairs whose contacts MuJoCo 4 computes otherwise than 2.3.3, at times: forces between them, and
# what accelerometers and touch sensors tell of these, differ.
ROUGH = {
    (GEOM.mjGEOM_BOX, GEOM.mjGEOM_BOX),
    (GEOM.mjGEOM_CAPSULE, GEOM.mjGEOM_BOX),
    (GEOM.mjGEOM_CYLINDER, GEOM.mjGEOM_BOX),
    (GEOM.mjGEOM_SPHERE, GEOM.mjGEOM_CYLINDER),
    *((shape, GEOM.mjGEOM_MESH) for shape in (GEOM.mjGEOM_PLANE, GEOM.mjGEOM_SPHERE)),
    *((shape, GEOM.mjGEOM_MESH) for shape in (GEOM.mjGEOM_CYLINDER, GEOM.mjGEOM_BOX)),
}


def load(name: str) -> dict[str, Any]:
    """The arrays of a file."""
    out = {}
    with np.load(FOLDER / f"{name}.npz") as archive:
        for key in archive.files:
            name, _, kind = key.partition(":")
            values = archive[key]
            if kind:  # in planes of bytes
                values = np.ascontiguousarray(np.moveaxis(values, 0, -1)).view(kind)[..., 0]
            out[name] = values
    return out


class Trace:
    """A trace, and an engine with a row for each of its states."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.arrays = load(name)
        self.states = len(self.arrays["time"])
        self.before = self.arrays["state"]  # where each step began
        self.after = self.before + 1
        self.engine = Scenario.parse(f"Safety{name}-v0").build(self.states, num_threads=1)
        self.engine.steps[:] = 1
        self.engine._begun = True

    def __getitem__(self, key: str) -> Any:
        return self.arrays[key]

    @cached_property
    def actions(self) -> Any:
        return self["action_percent"] / 100

    def set(self, rows: Any, task: Any) -> None:
        """Put row i into state ``rows[i]``, with the goal and the timer of state ``task[i]``."""
        engine, batch, n = self.engine, self.engine.batch, len(rows)
        world = self["world"][rows]
        batch.clear(np.arange(n))
        batch.bind("qpos")[:n], batch.bind("qvel")[:n] = self["qpos"][rows], self["qvel"][rows]
        batch.bind("qacc_warmstart")[:n] = 0.0
        batch.bind("time")[:n] = self["time"][rows]
        ctrl = np.zeros((self.states, engine.robot.action_size))
        ctrl[self.after] = np.clip(self.actions, *engine.robot.action_range)
        batch.bind("ctrl")[:n] = ctrl[rows]
        engine.places("robot")[:n, 0, :2] = self["world_robot"][world, :2]
        if not engine.robot._free:
            engine.robot._place[:n, :2] = self["world_robot"][world, :2]
            half = self["world_robot"][world, 2] / 2
            engine.robot._turn[:n] = 0.0
            engine.robot._turn[:n, 0], engine.robot._turn[:n, 3] = np.cos(half), np.sin(half)
        if "goal" in engine.footprints:
            engine.places("goal")[:n, 0, :2] = self["goal"][task]
        for kind, group in (("hazards", "hazards"), ("pillars", "pillars"), ("buttons", "button")):
            if f"world_{kind}" in self.arrays:
                places = self[f"world_{kind}"][world]
                engine.places(group)[:n, :, :2] = places[..., :2]
                if kind != "hazards":
                    first = int(engine.model.body(f"{group}/0").mocapid[0])
                    batch.bind("mocap_pos")[:n, first : first + places.shape[1], :2] = places[
                        ..., :2
                    ]
        if "world_buttons" in self.arrays:
            engine.array("button/right", dtype=np.int64)[:n] = self["goal_button"][task]
            timer = self["timer"][task]
            engine.array("button/wait", dtype=np.int64)[:n] = np.where(timer > 0, timer + 1, 0)
        if "world_gremlins" in self.arrays:
            self._set_gremlins(n, world, self["mocap"][rows])
        batch.forward(np.arange(n), stage=mujoco.mjtStage.mjSTAGE_ACC)

    def _set_gremlins(self, n: int, world: Any, mocap: Any) -> None:
        """Put what pulls the gremlins where it was; recorded are offsets common to all."""
        model, batch = self.engine.model, self.engine.batch
        places = self["world_gremlins"][world]
        self.engine.places("gremlins")[:n, :, :2] = places[..., :2]
        first = int(model.body("gremlins/0/mover").mocapid[0])
        movers = slice(first, first + places.shape[1])
        batch.bind("mocap_pos")[:n, movers] = mocap[:, None]
        batch.bind("mocap_pos")[:n, movers, :2] += places[..., :2]
        batch.bind("mocap_quat")[:n, movers] = self["world_gremlin_quat"][world]

    @cached_property
    def rough(self) -> Any:
        """What :meth:`find_rough` finds in the rows as they were first set."""
        return self.find_rough()

    def find_rough(self) -> Any:
        """Rows in which bodies touch whose contacts the two versions compute differently."""
        model = self.engine.model
        kinds = model.geom_type
        welds = model.eq_type == mujoco.mjtEq.mjEQ_WELD
        welded = {int(body) for body in model.eq_obj2id[welds]}  # gremlins: they differ by 1e-5
        out = np.zeros(self.states, dtype=bool)
        for row in range(self.states):
            data = self.engine.batch.get_data(row)
            for contact in data.contact[: data.ncon]:
                pair = tuple(sorted(int(kinds[g]) for g in contact.geom))
                out[row] |= pair in ROUGH
                out[row] |= any(int(model.geom_bodyid[g]) in welded for g in contact.geom)
        return out

    def observation_error(self) -> Any:
        """How far each observation of each state is off, relative to 0.01 and more, [states, d]."""
        rows = np.arange(self.states)
        self.set(rows, rows)
        theirs = self["obs"]
        return np.abs(self.engine.observe(np.float64) - theirs) / np.maximum(np.abs(theirs), 0.01)

    def rewards(self) -> Any:
        """Our rewards of the steps, their bonuses among them, and whether the goal was met."""
        engine, n = self.engine, len(self.before)
        self.set(self.before, self.before)
        before = engine.task.measure().copy()
        self.set(self.after, self.before)
        now = engine.task.measure()
        met = engine.task.succeeded(now)[:n]
        return engine.task.reward(before, now)[:n] + engine.task.bonus * met, met


def velocity_steps(name: str) -> tuple[dict[str, Any], Any, Outcome]:
    """One step of ours from each recorded state of ``Safety<name>Velocity-v1``.

    :return: what was recorded, our qpos after the
        step, [n, nq], and our outcomes
    """
    recorded = {
        key.removeprefix(f"{name}_"): values
        for key, values in load("velocity").items()
        if key.startswith(f"{name}_")
    }
    rows = np.arange(len(recorded["qpos"]))
    engine = Scenario.parse(f"Safety{name}Velocity-v1").build(len(rows), num_threads=1)
    engine.reset(rows)
    engine.batch.clear(rows)
    for field in ("qpos", "qvel"):
        engine.batch.bind(field)[:] = recorded[field]
    engine.batch.begin(rows)
    engine.batch.bind("qacc_warmstart")[:] = 0.0
    engine._before[:] = engine.task.measure()
    outcome = engine.step(recorded["action"])
    return recorded, engine.batch.bind("qpos").copy(), outcome

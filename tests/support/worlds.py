"""Small worlds for the tests of tasks and constraints."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.registration import load_env_creator

from sb3_guard.envs import Scenario, registry
from sb3_guard.envs.engine import Engine

ROW = np.zeros(1, dtype=np.int32)


@contextmanager
def own_parts() -> Iterator[None]:
    """What is registered within is forgotten afterwards."""
    tables = (registry.ROBOTS, registry.TASKS, registry.CONSTRAINTS)
    before = [dict(table) for table in tables]
    try:
        yield
    finally:
        for table, known in zip(tables, before, strict=True):
            table.clear()
            table.update(known)


def gymnasium_robot(env_id: str) -> gymnasium.Env:
    """Gymnasium's own environment, without the warnings that there is a newer one."""
    spec = gymnasium.spec(env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_env_creator(spec.entry_point)(**spec.kwargs)


def world(suite: str, n: int = 1, seed: int = 0, num_threads: int = 1, **params: object) -> Engine:
    """A suite with changed parameters, its rows seeded and reset."""
    engine = Scenario.parse(suite).override(**params).build(n, num_threads)
    for i in range(n):
        engine.seed(i, np.random.default_rng(seed + i))
    engine.reset(np.arange(n))
    return engine


def actions(engine: Engine, steps: int, seed: int = 0) -> np.ndarray:
    """Random actions, [steps, N, d]."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (steps, engine.num_envs, engine.robot.action_size))


def assert_rows_are_lone_environments(suite: str, **params: object) -> None:
    """Three rows on one thread and on two against three lone engines, with staggered resets."""
    n = 3
    batches = [world(suite, n, num_threads=k, **params) for k in (1, 2)]
    lone = [world(suite, seed=i, **params) for i in range(n)]
    for step, action in enumerate(actions(batches[0], 40)):
        if step % 13 == 7:
            for engine in batches:
                engine.reset(np.array([step % n]))
            lone[step % n].reset(ROW)
        outcomes = [engine.step(action) for engine in batches]
        for i, engine in enumerate(lone):
            own = engine.step(action[i : i + 1])
            for outcome in outcomes:
                np.testing.assert_array_equal(outcome.obs[i], own.obs[0])
                assert (outcome.reward[i], outcome.cost[i]) == (own.reward[0], own.cost[0])


def put_point(engine: Engine, x: float, y: float, heading: float = 0.0) -> None:
    """Set the Point of every row down at rest."""
    model, batch = engine.model, engine.batch
    spawn = int(model.body_mocapid[model.body("spawn").id])
    batch.bind("mocap_pos")[:, spawn] = [x, y, 0.0]
    batch.bind("mocap_quat")[:, spawn] = [np.cos(heading / 2), 0, 0, np.sin(heading / 2)]
    root = int(model.jnt_qposadr[model.joint("robot/x").id])
    batch.bind("qpos")[:, root : root + 3] = 0.0
    batch.bind("qvel")[:] = 0.0
    batch.forward()
    engine._before[:] = engine.task.measure()


def free_body(engine: Engine, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Live pose [N, 7] and velocity [N, 6] of a free body."""
    joint = int(engine.model.body(name).jntadr[0])
    q, v = int(engine.model.jnt_qposadr[joint]), int(engine.model.jnt_dofadr[joint])
    return engine.batch.bind("qpos")[:, q : q + 7], engine.batch.bind("qvel")[:, v : v + 6]


def contacts(engine: Engine, row: int) -> set[str]:
    """Bodies that touch the robot, read off MuJoCo's list of contacts."""
    model, data = engine.model, engine.batch.get_data(row)
    touched = set()
    for pair in data.contact.geom:
        names = [model.body(int(model.geom_bodyid[g])).name for g in pair]
        for mine, other in (names, names[::-1]):
            if mine.startswith("robot/") and not other.startswith("robot/"):
                touched.add(other)
    return touched - {"world"}


def touching(engine: Engine, row: int) -> set[str]:
    """Bodies whose sensor feels the robot."""
    sensors = [engine.model.sensor(i) for i in range(engine.model.nsensor)]
    found = engine.batch.bind("sensordata")[row]
    return {
        s.name for s in sensors
        if s.type == mujoco.mjtSensor.mjSENS_CONTACT and found[int(s.adr[0])] > 0
    }  # fmt: skip

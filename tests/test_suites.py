"""The named suites: which there are, how large they are, and that they hold for long."""

import resource

import gymnasium
import numpy as np
import pytest
from suites import IDS, SIZES

from sb3_guard.envs import GuardVectorEnv, Scenario, env_ids, registry


def test_there_are_72_suites_from_one_product():
    ids = env_ids()
    assert len(ids) == len(set(ids)) == 72
    assert "Goal_Arm6_8Hazards-v0" in ids and "Defense_Drone_8Ghosts-v0" in ids
    assert all(env_id in gymnasium.registry for env_id in ids)
    assert not any("Car" in env_id or "Doggo" in env_id for env_id in ids)


def test_there_are_eleven_robots_and_the_parts_of_the_paper():
    assert set(registry.ROBOTS) == set(SIZES)
    assert list(registry.TASKS) == ["Goal", "Push", "Chase", "Defense", "Button"]
    kinds = {c: registry.CONSTRAINTS[c].spaces for c in registry.CONSTRAINTS}
    # hazards and ghosts exist in both spaces: eight constraints in all
    assert sum(map(len, kinds.values())) == 8


@pytest.mark.parametrize("env_id", IDS)
def test_sizes_of_observations_and_actions(env_id):
    task, robot, _ = env_id.split("_")
    actions, goal, push, chase = SIZES[robot]
    size = {"Goal": goal, "Push": push, "Chase": chase, "Defense": chase}.get(task)
    engine = Scenario.parse(env_id).build()
    assert engine.robot.action_size == actions
    if size is not None:
        assert engine.observation_size == size


@pytest.mark.slow
@pytest.mark.parametrize("env_id", IDS)
def test_a_hundred_episodes_of_random_actions(env_id):
    env = GuardVectorEnv(50, env_id.removesuffix("-v0"))
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    ended, memory = 0, 0
    for t in range(2000):
        action = rng.uniform(-1, 1, env.action_space.shape)
        obs, reward, terminated, truncated, info = env.step(action)
        assert np.isfinite(obs).all() and np.isfinite(reward).all()
        assert np.isfinite(info["cost"]).all() and (info["cost"] >= 0).all()
        assert not terminated.any(), np.flatnonzero(terminated)
        ended += int(truncated.sum())
        if t == 1200:
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert ended >= 100
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory < 5000  # KiB

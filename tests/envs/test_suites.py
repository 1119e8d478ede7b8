"""The named suites: which there are, how large they are, and that they hold for long."""

import resource

import gymnasium
import numpy as np
import pytest
from suites import IDS, SIZES

import sb3_guard
from sb3_guard import list as listing
from sb3_guard import show
from sb3_guard.envs import GuardVectorEnv, Scenario, env_ids, suites
from sb3_guard.ids import with_version


def test_there_are_72_suites_from_one_product():
    ids = env_ids("guard")
    assert len(ids) == len(set(ids)) == 72
    assert "Goal_Arm6_8Hazards-v0" in ids and "Defense_Drone_8Ghosts-v0" in ids
    assert all(env_id in gymnasium.registry for env_id in ids)
    assert not any("Car" in env_id or "Doggo" in env_id for env_id in ids)


def test_every_id_that_is_printed_is_an_environments_own(capsys):
    assert listing.main(["environments"]) == 0
    rows = [line.split("|")[2:-1] for line in capsys.readouterr().out.splitlines()]
    printed = [name.strip() for row in rows for name in row]
    named = [with_version(name) for name in printed if name and not {*name} <= {"-"} | {*"id"}]
    assert len(named) == len({*named}) and {*named} == {*env_ids()}


@pytest.fixture
def mazes(monkeypatch):
    """A family of two ids, in which a third name is explained."""

    def explain(name):
        if not name.startswith("Maze"):
            return None
        raise ValueError(f"{name!r} is not here: use 'MazeSmall-v1'")

    table = {
        f"MazeSmall-v{i}": {"constraints": {"hazards": {"num": 2 + i}}, "layout": {"margin": 0.1}}
        for i in range(2)
    }
    suite = suites.Suite("Mazes", table, {"MazeSmall-v1": 5}, explain)
    monkeypatch.setitem(suites.SUITES, "mazes", suite)
    yield suite
    for env_id in table:
        gymnasium.registry.pop(env_id, None)


def test_a_family_of_its_own_is_known_everywhere(mazes, capsys, tmp_path):
    assert env_ids("mazes") == ["MazeSmall-v0", "MazeSmall-v1"] == env_ids()[-2:]
    scenario = Scenario.parse("MazeSmall")  # the latest version
    assert scenario.constraints == {"hazards": {"num": 3}}
    for name in ("MazeSmall-v1", sb3_guard.envs.register("MazeSmall-v1")):
        for env in (sb3_guard.make(name, hazards={"size": 0.2}), gymnasium.make("MazeSmall-v1")):
            env.reset(seed=0)
            cut = [env.step(env.action_space.sample())[3] for _ in range(5)]
            assert cut == [False] * 4 + [True]
    vec = sb3_guard.make_vec_env("MazeSmall-v1", 2, env_kwargs={"hazards": {"num": 4}})
    assert vec.get_attr("scenario")[0].constraints["hazards"]["num"] == 4
    assert GuardVectorEnv(2, "MazeSmall-v1").max_episode_steps == 5
    assert GuardVectorEnv(2, "MazeSmall-v0").max_episode_steps == 1000
    assert listing.main(["environments"]) == 0
    assert "MazeSmall-v1" in capsys.readouterr().out
    assert show.main(["MazeSmall-v0", "-o", str(tmp_path / "maze.png")]) == 0
    with pytest.raises(ValueError, match="'MazeLarge' is not here"):
        Scenario.parse("MazeLarge")
    with pytest.raises(ValueError, match="unknown suite 'maze': did you mean 'mazes'"):
        env_ids("maze")
    with pytest.raises(ValueError, match="did you mean 'MazeSmall-v0'"):
        Scenario.parse("aMazeSmal")


@pytest.mark.parametrize("env_id", IDS)
def test_sizes_of_observations_and_actions(env_id):
    task, robot, _ = env_id.split("_")
    actions, goal, push, chase = SIZES[robot]
    size = {"Goal": goal, "Push": push, "Chase": chase, "Defense": chase}.get(task)
    engine = Scenario.parse(env_id).build()
    assert engine.robot.action_size == actions
    if size is not None:
        assert engine.observer.size == size


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

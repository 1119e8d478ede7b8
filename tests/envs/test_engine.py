"""The engine's promises: bit-exact rows, whole states, honest steps."""

import weakref
from dataclasses import dataclass, replace

import gymnasium
import numpy as np
import pytest
from suites import CASES, COVER

from sb3_guard.envs import GuardVectorEnv, Scenario, env_spec, make
from sb3_guard.envs.constraints import Hazards
from sb3_guard.envs.engine import Engine
from sb3_guard.envs.layout import LayoutError
from sb3_guard.envs.observation import Values
from sb3_guard.envs.part import Constraint, Task
from sb3_guard.envs.robots.guard import Point
from sb3_guard.envs.tasks import Goal


def actions_for(env, steps, n, seed=0):
    rng = np.random.default_rng(seed)
    size = env.single_action_space.shape[0] if hasattr(env, "single_action_space") else None
    size = size or env.action_space.shape[0]
    return rng.uniform(-1.2, 1.2, (steps, n, size)).astype(np.float32)


# tasks of Safety-Gymnasium, of which bodies sleep in the first
SAFETY = ["SafetyPointGoal1-v0", "SafetyDoggoCircle1-v0", "SafetyHopperVelocity-v1"]


@pytest.mark.parametrize("env_id", [*CASES, *SAFETY])
def test_row_of_a_batch_is_a_lone_environment_bit_for_bit(env_id, length=25, steps=60):
    n = 3
    batch = gymnasium.make_vec(env_spec(env_id), num_envs=n, max_episode_steps=length)
    lone = [make(env_id, max_episode_steps=length) for _ in range(n)]
    obs, _ = batch.reset(seed=10)
    for i, env in enumerate(lone):
        np.testing.assert_array_equal(obs[i], env.reset(seed=10 + i)[0])
    # staggered: row 0 begins anew in mid-episode
    engine = batch.unwrapped.engine
    engine.reset(np.zeros(1, dtype=np.int32))
    np.testing.assert_array_equal(engine.observe()[0], lone[0].reset()[0])
    ends = 0
    for action in actions_for(batch, steps, n):
        obs, reward, terminated, truncated, info = batch.step(action)
        for i, env in enumerate(lone):
            o, r, term, trunc, inf = env.step(action[i])
            assert (r, term, trunc) == (reward[i], terminated[i], truncated[i])
            assert all(inf[k] == info[k][i] for k in inf if k.startswith("cost"))
            if term or trunc:
                ends += 1
                np.testing.assert_array_equal(o, info["final_obs"][i])
                assert inf["cost"] == info["final_info"]["cost"][i]
                o, _ = env.reset()
            np.testing.assert_array_equal(o, obs[i])
    assert ends >= 2 * n


@pytest.mark.slow
def test_rows_of_a_batch_are_lone_environments_for_whole_episodes():
    test_row_of_a_batch_is_a_lone_environment_bit_for_bit("Goal_Point_8Hazards-v0", 1000, 2100)


@pytest.mark.parametrize("env_id", CASES)
def test_threads_change_nothing(env_id):
    what = env_spec(env_id).kwargs["scenario"]
    envs = [GuardVectorEnv(5, what, max_episode_steps=15, num_threads=k) for k in (1, 2)]
    first = [env.reset(seed=0)[0] for env in envs]
    np.testing.assert_array_equal(*first)
    for action in actions_for(envs[0], 40, 5):
        steps = [env.step(action) for env in envs]
        for a, b in zip(steps[0][:4], steps[1][:4], strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_full_episode_is_cut_after_a_thousand_steps_and_repeats_with_its_seed():
    env = gymnasium.make("Goal_Point_8Hazards-v0")
    runs = []
    for _ in range(2):
        obs, _ = env.reset(seed=7)
        trace = [obs]
        for t, action in enumerate(actions_for(env, 1000, 1)[:, 0]):
            obs, reward, terminated, truncated, info = env.step(action)
            trace.append(np.append(obs, [reward, info["cost"]]))
            assert not terminated
            assert truncated == (t == 999)
        runs.append(np.concatenate([np.ravel(x) for x in trace]))
    np.testing.assert_array_equal(*runs)


@pytest.mark.parametrize("env_id", [*CASES, *SAFETY])
def test_a_restored_state_continues_bit_for_bit_on_other_threads(env_id):
    what = env_spec(env_id).kwargs["scenario"]
    a = GuardVectorEnv(4, what, max_episode_steps=13, num_threads=1)
    b = GuardVectorEnv(4, what, max_episode_steps=13, num_threads=2)
    a.reset(seed=3)
    b.reset(seed=99)
    actions = actions_for(a, 40, 4)
    for action in actions[:10]:
        a.step(action)
    b.restore(a.state())
    for action in actions[10:]:  # past two automatic resets, so the generators matter
        for x, y in zip(a.step(action)[:4], b.step(action)[:4], strict=True):
            np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(
    ("rows", "env_id"), [(3, "Goal_Point_8Hazards"), (2, "Goal_Point_1Hazards")]
)
def test_a_state_of_another_world_is_refused(rows, env_id):
    a = GuardVectorEnv(2, "Goal_Point_8Hazards")
    b = GuardVectorEnv(rows, env_id)
    before = b.reset(seed=0)[0]
    for one, other in ((a, b), (b, a)):
        with pytest.raises(ValueError, match="the state has arrays"):
            other.restore(one.state())
    np.testing.assert_array_equal(b.engine.observe(), before)


@pytest.mark.parametrize("env_id", CASES)
def test_episodes_begin_without_a_cost_and_inside_the_layout_rule(env_id):
    env = GuardVectorEnv(20, env_spec(env_id).kwargs["scenario"])
    env.reset(seed=1)
    engine = env.engine
    for _ in range(3):
        env.reset()
        assert not any(c.cost().any() for c in engine.constraints)
        groups = [
            (f, engine.placing.owners[name].positions(name))
            for name, f in engine.footprints.items()
        ]
        xy = np.concatenate([p[..., :2] for _, p in groups], axis=1)
        keep = np.concatenate([np.full(f.num, f.keepout) for f, _ in groups])
        gap = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=-1)
        need = keep[:, None] + keep[None]
        assert (gap - need)[:, ~np.eye(len(keep), dtype=bool)].min() > -1e-6


@pytest.mark.parametrize("env_id", ["Goal_Point_8Hazards-v0", "Push_Point_8Pillars-v0"])
def test_simulations_are_freed_with_their_environment(env_id):
    """They reserve 15 MB each, and every part has views of them; no garbage collection comes."""
    env = make(env_id)
    env.reset(seed=0)
    engine = env.unwrapped.engine
    seen = [weakref.ref(one) for one in (engine, engine.batch, *engine.parts)]
    del env, engine
    assert not any(one() for one in seen)


def test_actions_that_are_not_finite_never_reach_the_physics():
    env = GuardVectorEnv(3, "Goal_Point_8Hazards")
    env.reset(seed=0)
    before = env.engine.batch.state.copy()
    with pytest.raises(ValueError, match=r"rows \[1\] are not finite"):
        env.step(np.array([[0, 0], [0, np.nan], [0, 0]]))
    np.testing.assert_array_equal(env.engine.batch.state, before)
    with pytest.raises(ValueError, match=r"shape \(3, 3\), expected \(3, 2\)"):
        env.step(np.zeros((3, 3)))


def test_actions_outside_the_box_are_clipped():
    envs = [gymnasium.make("Goal_Point_8Hazards-v0") for _ in range(2)]
    for env in envs:
        env.reset(seed=0)
    for _ in range(5):
        a, b = envs[0].step(np.array([5.0, -7.0])), envs[1].step(np.array([1.0, -1.0]))
        np.testing.assert_array_equal(a[0], b[0])


def test_diverged_physics_ends_the_episode_and_says_so():
    env = GuardVectorEnv(3, "Goal_Point_8Hazards")
    env.reset(seed=0)
    env.engine.batch.bind("qvel")[1] = 1e12
    obs, reward, terminated, truncated, info = env.step(np.zeros((3, 2)))
    assert terminated.tolist() == [False, True, False]
    assert not truncated.any()
    assert reward[1] == 0 and info["cost"][1] == 0
    assert info["physics_error"].tolist() == [False, True, False]
    assert info["final_info"]["physics_error"][1]
    assert np.isfinite(obs).all()
    _, _, terminated, *_ = env.step(np.zeros((3, 2)))  # reported once
    assert not terminated.any()


def test_a_reached_goal_pays_and_moves_clear_of_everything():
    env = GuardVectorEnv(2, "Goal_Point_8Hazards")
    env.reset(seed=0)
    engine = env.engine
    old = engine.places("goal")[0, 0].copy()
    engine.places("goal")[0, 0, :2] = engine.robot.position[0, :2]
    engine._before[0] = 0.0
    _, reward, terminated, _, info = env.step(np.zeros((2, 2)))
    assert info["goal_met"].tolist() == [True, False]
    assert reward[0] == pytest.approx(1.0, abs=0.01)
    assert not terminated.any()
    new = engine.places("goal")[0, 0]
    assert not np.array_equal(new, old)
    hazards = engine.places("hazards")[0, :, :2]
    assert np.linalg.norm(hazards - new[:2], axis=1).min() >= 0.8
    assert np.linalg.norm(engine.robot.position[0, :2] - new[:2]) >= 0.8
    # the next reward counts from the new goal
    d0 = np.linalg.norm(engine.robot.position[0, :2] - new[:2])
    _, reward, *_ = env.step(np.ones((2, 2)))
    assert reward[0] == pytest.approx(
        d0 - np.linalg.norm(engine.robot.position[0, :2] - new[:2]), abs=1e-12
    )


def test_noconti_ends_the_episode_at_the_goal():
    env = GuardVectorEnv(1, "Goal_Point_8Hazards_noconti")
    env.reset(seed=0)
    env.engine.places("goal")[0, 0, :2] = env.engine.robot.position[0, :2]
    _, _, terminated, truncated, info = env.step(np.zeros((1, 2)))
    assert terminated[0] and not truncated[0] and info["goal_met"][0]


def test_a_goal_without_room_cuts_the_episode():
    env = GuardVectorEnv(1, "Goal_Point_8Hazards")
    env.reset(seed=0)
    engine = env.engine
    grid = np.stack(np.meshgrid([-1.5, 0.0, 1.5], [-1.5, 0.0, 1.5]), -1).reshape(-1, 2)
    engine.places("hazards")[0, :, :2] = grid[[0, 1, 2, 3, 5, 6, 7, 8]] * 0.7
    engine.batch.bind("mocap_pos")[0, 0, :2] = 0.0
    engine.batch.forward()
    engine.places("goal")[0, 0, :2] = 0.0
    _, _, terminated, truncated, info = env.step(np.zeros((1, 2)))
    assert truncated[0] and not terminated[0]
    assert info["goal_unplaced"][0]


def test_rewards_and_costs_equal_scalar_loops():
    env = GuardVectorEnv(6, "Goal_Point_8Hazards", goal={"size": 1.2})
    env.reset(seed=4)
    engine = env.engine
    paid, reached = 0, 0
    for t in range(300):
        before = [
            float(np.hypot(*(p[:2] - g[0, :2])))
            for p, g in zip(engine.robot.position.copy(), engine.places("goal").copy(), strict=True)
        ]
        goals = engine.places("goal").copy()
        action = np.tile([1.0, 0.2 * np.sin(t / 30)], (6, 1))
        _, reward, _, _, info = env.step(action)
        for i in range(6):
            p = engine.robot.position[i]
            d = float(np.hypot(*(p[:2] - goals[i, 0, :2])))
            want = before[i] - d + (1.0 if d <= 1.2 else 0.0)
            assert reward[i] == pytest.approx(want, abs=1e-12)
            cost = 0.0
            for h in engine.places("hazards")[i]:
                gap = 0.3 - float(np.hypot(*(p[:2] - h[:2])))
                cost += max(0.0, gap)
            assert info["cost"][i] == pytest.approx(cost, abs=1e-12)
            assert info["cost_hazards"][i] == info["cost"][i]
            paid += cost > 0
            reached += d <= 1.2
    assert paid > 10 and reached > 0


def part(base, name, **verbs):
    """A part as a user may write it, with these methods."""
    return dataclass(type(name.capitalize(), (base,), {"name": name, **verbs}))()


@pytest.mark.parametrize(
    ("verbs", "words"),
    [
        ({"cost": lambda self: np.zeros((2, 3))}, r"cost\(\) of odd has shape \(2, 3\), .* \(2,\)"),
        ({"cost": lambda self: np.array([0.0, -0.5])}, r"cost_odd is -0\.5: .* at least 0"),
    ],
)
def test_what_is_wrong_with_a_users_constraint_is_said(verbs, words):
    with pytest.raises(ValueError, match=words):
        engine = Engine(Point(), Goal(), [part(Constraint, "odd", **verbs)], num_envs=2)
        engine.reset(np.arange(2))
        engine.observe()
        engine.step(np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("verb", "value", "words"),
    [
        ("reward", np.zeros((2, 1)), r"reward\(\) of odd has shape \(2, 1\), expected \(2,\)"),
        ("invalid_start", False, r"invalid_start\(\) of odd has shape \(\), expected \(2,\)"),
    ],
)
def test_what_is_wrong_with_a_users_task_is_said(verb, value, words):
    verbs = {
        "reward": lambda self, before, now: np.zeros(2),
        "invalid_start": lambda self: np.zeros(2, dtype=bool),
        verb: lambda self, *_: value,
    }
    with pytest.raises(ValueError, match=words):
        engine = Engine(Point(), part(Task, "odd", **verbs), num_envs=2)
        engine.reset(np.arange(2))
        engine.step(np.zeros((2, 2)))


def test_costs_of_a_users_constraint_may_be_whole_or_yes_and_no():
    engine = Engine(
        Point(),
        Goal(),
        [
            part(Constraint, "whole", cost=lambda self: self.sim.steps),
            part(Constraint, "often", cost=lambda self: self.sim.steps > 0),
            part(Constraint, "kept", cost=lambda self: self.sim.array("kept")),
        ],
        num_envs=2,
    )
    engine.reset(np.arange(2))
    engine.step(np.zeros((2, 2)))
    outcome = engine.step(np.zeros((2, 2)))
    assert outcome.cost.tolist() == [3.0, 3.0] and outcome.costs["cost_often"].dtype == float
    engine.array("kept")[:] = 5.0  # the next step's, not this one's
    assert outcome.costs["cost_kept"].tolist() == [0.0, 0.0]


def test_an_impossible_layout_names_the_crowded_part():
    env = GuardVectorEnv(1, "Goal_Point_8Hazards", hazards={"num": 60})
    with pytest.raises(LayoutError, match="hazards cannot be placed: 60 with"):
        env.reset(seed=0)


def test_infos_and_observations_are_not_reused():
    from sb3_guard import make_vec_env

    env = make_vec_env("Goal_Point_8Hazards", 2, seed=0, max_episode_steps=20)
    kept, copies = [], []
    obs = env.reset()
    for action in actions_for(env, 50, 2):
        obs, rewards, dones, infos = env.step(action)
        kept.append((obs, rewards, dones, infos))
        copies.append((obs.copy(), rewards.copy(), dones.copy(), [dict(i) for i in infos]))
    for a, b in zip(kept, copies, strict=True):
        for x, y in zip(a[:3], b[:3], strict=True):
            np.testing.assert_array_equal(x, y)
        for i, j in zip(a[3], b[3], strict=True):
            assert i.keys() == j.keys() and i["cost"] == j["cost"]


def test_the_observation_is_laid_out_as_guard_does():
    env = gymnasium.make("Goal_Point_8Hazards-v0").unwrapped
    layout = {k: (v.start, v.stop) for k, v in env.observation_layout.items()}
    assert layout == {
        "accelerometer": (0, 3),
        "goal_compass": (3, 5),
        "gyro": (5, 8),
        "hazards_lidar": (8, 24),
        "magnetometer": (24, 27),
        "velocimeter": (27, 30),
    }
    obs, _ = env.reset(seed=0)
    engine = env.engine
    heading = np.arctan2(engine.robot.frames[1][0, 0, 1, 0], engine.robot.frames[1][0, 0, 0, 0])
    # magnetometer: the field (0, -0.5, 0) in the robot's frame; accelerometer: gravity's reaction
    np.testing.assert_allclose(
        obs[24:27], [-0.5 * np.sin(heading), -0.5 * np.cos(heading), 0], atol=1e-6
    )
    np.testing.assert_allclose(obs[0:3], [0, 0, 9.81], atol=1e-4)


@pytest.mark.parametrize("env_id", COVER)
def test_the_world_keeps_the_robots_time_step(env_id):
    engine = Scenario.parse(env_id).build()
    assert engine.model.opt.timestep == engine.robot.timestep
    assert engine.model.geom("floor").margin == 0


@pytest.mark.parametrize("bodies", [(1, 3, 5), (2, 3), (5, 1), (1, 2, 5), (4,)], ids=str)
def test_lidar_of_any_bodies_is_that_of_each_in_their_order(bodies):
    def lidar(links):
        links = tuple(f"link_{k}" for k in links)
        env = GuardVectorEnv(3, "Goal_Arm3_8Ghosts", num_threads=1, robot={"sensing": links})
        obs, _ = env.reset(seed=0)
        return obs[:, env.observation_layout["ghosts_lidar"]]

    np.testing.assert_array_equal(lidar(bodies), np.hstack([lidar((k,)) for k in bodies]))


@dataclass
class Glow(Hazards):
    """A user's cost, summed over many objects by the base class and by itself."""

    name = "glow"

    def amounts(self):
        position = self.sim.robot.position
        x, y = (self.group.centers[..., i] - position[:, None, i] for i in (0, 1))
        return np.exp(-np.hypot(x, y))

    def observations(self):
        east = self.group.centers[..., 0].sum(axis=1)
        warmth = self.amounts().mean(axis=1)
        return {"warmth": Values(warmth[:, None]), "east": Values(east[:, None])}

    def cost(self):
        return super().cost() * (self.sim.steps > 0)  # an episode begins clean


def test_a_users_sums_are_those_of_a_lone_environment():
    engines = [
        Engine(Point(), Goal(), [Glow(num=9, size=0.01, keepout=0.2)], num_envs=n) for n in (4, 1)
    ]
    rng = np.random.default_rng(0)
    for engine in engines:
        for i in range(engine.num_envs):
            engine.seed(i, np.random.default_rng(i))
        engine.reset(np.arange(engine.num_envs))
    many, lone = engines
    for _ in range(50):
        actions = rng.uniform(-1, 1, (4, 2))
        row, own = many.step(actions), lone.step(actions[:1])
        np.testing.assert_array_equal(row.obs[0], own.obs[0])
        assert row.cost[0] == own.cost[0]


def test_a_law_set_anew_holds_from_the_next_step():
    engine = Scenario.parse("Goal_Point_3Ghosts").build(2)
    engine.reset(np.arange(2))
    ghosts = engine.constraints[0]

    def moved():
        before = engine.places("ghosts").copy()
        engine.step(np.zeros((2, 2)))
        return np.linalg.norm(engine.places("ghosts") - before, axis=2).max()

    ghosts.motion = replace(ghosts.motion, r1=0.0)
    assert moved() == pytest.approx(0.001)
    ghosts.motion = replace(ghosts.motion, far=0.02, home=0.02)
    assert moved() == pytest.approx(0.02)
    ghosts.moving = lambda: ()
    assert moved() == 0.0

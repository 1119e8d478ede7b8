"""Velocity tasks: Gymnasium's robots bit for bit, and a price for speed."""

import gymnasium
import mujoco
import numpy as np
import pytest
from safety_traces import load, velocity_steps
from worlds import gymnasium_robot

from sb3_guard.envs import GuardVectorEnv, Scenario, env_ids, make
from sb3_guard.envs.suites.velocity import TABLE

LIMITS = {  # Safety-Gymnasium 1.0.0: v0, v1, m/s
    "Ant": (2.5745, 2.6222),
    "HalfCheetah": (2.8795, 3.2096),
    "Hopper": (0.37315, 0.7402),
    "Humanoid": (2.3475, 1.4149),
    "Swimmer": (0.04845, 0.2282),
    "Walker2d": (1.7075, 2.3415),
}


MARGINS = {"Ant": 0.01, "Hopper": 0.001, "Humanoid": 0.001}  # of every geom in the files, m
# How far one control step of MuJoCo 4 is from one of 2.3.3: the median and the 90 % quantile of the
# largest difference of a coordinate, m or rad, among steps in contact. The file has 24 bits.
STEP = {
    "Ant": (2e-5, 1e-4),  # its quaternion differs with RK4, see docs/fidelity.md
    "HalfCheetah": (1e-7, 1e-7),
    "Hopper": (1e-7, 1e-7),
    "Humanoid": (2e-6, 1e-5),
    "Walker2d": (1e-7, 1e-7),
}


def gymnasium_of_old(name):
    """Gymnasium's environment with the margins and unit quaternions that MuJoCo 2.3.3 gave it."""
    env = gymnasium_robot(f"{name}-v4")
    env.model.geom_margin[:] /= 2
    set_state = env.set_state

    def set_unit_state(qpos, qvel):
        mujoco.mj_normalizeQuat(env.model, qpos)
        set_state(qpos, qvel)

    env.set_state = set_unit_state
    return env


@pytest.mark.parametrize("name", TABLE)
def test_every_step_is_gymnasiums_bit_for_bit(name):
    """Starts of the same seed, observations, rewards, deaths, new starts; speeds and costs."""
    theirs = [gymnasium_of_old(name) for _ in range(2)]
    ours = GuardVectorEnv(2, f"Safety{name}Velocity-v1")
    engine, limit = ours.engine, LIMITS[name][1]
    ours.reset(seed=5)
    seen = np.array([env.reset(seed=5 + i)[0] for i, env in enumerate(theirs)])
    np.testing.assert_array_equal(engine.observe(np.float64), seen)
    rng = np.random.default_rng(0)
    low, high = engine.robot.action_range
    died, costs = 0, set()
    for t in range(80):
        actions = rng.uniform(low, high, (2, engine.robot.action_size))
        if t % 40 > 20:
            actions[:] = high  # all one way: fast, or fallen
        out = engine.step(actions)
        for i, env in enumerate(theirs):
            obs, reward, terminated, _, info = env.step(actions[i])
            np.testing.assert_array_equal(engine.observe(np.float64)[i], obs)
            assert (out.reward[i], out.terminated[i]) == (reward, terminated)
            speed = info["x_velocity"]
            if name in ("Ant", "Humanoid"):
                speed = np.sqrt(speed**2 + info["y_velocity"] ** 2)
            assert out.costs["cost_speed"][i] == out.cost[i] == (speed > limit)
            costs.add(out.cost[i])
            if terminated:
                env.reset()
        ended = np.flatnonzero(out.terminated)
        died += len(ended)
        if len(ended):
            engine.reset(ended)
            for i in ended:
                np.testing.assert_array_equal(engine.observe(np.float64)[i], theirs[i]._get_obs())
    assert (died > 0) == (name in ("Ant", "Hopper", "Humanoid", "Walker2d"))
    assert 0.0 in costs


@pytest.mark.parametrize("name", TABLE)
def test_episodes_begin_as_in_the_original(name):
    """Safety-Gymnasium 1.0.0 with MuJoCo 2.3.3, seeds 0 to 9; its quaternions have length 1."""
    starts = load("velocity")[f"{name}_starts"]
    env = GuardVectorEnv(len(starts), f"Safety{name}Velocity-v1")
    env.reset(seed=0)
    batch = env.engine.batch
    ours = np.hstack([batch.bind("qpos"), batch.bind("qvel")])
    np.testing.assert_allclose(ours, starts, rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", STEP)
def test_steps_in_contact_are_the_originals(name):
    """One step from each state recorded of Safety-Gymnasium 1.0.0 with MuJoCo 2.3.3."""
    theirs, qpos, out = velocity_steps(name)
    touching = theirs["contacts"] > 0
    assert touching.sum() > 80
    off = np.abs(qpos - theirs["next_qpos"]).max(axis=1)[touching]
    median, most = STEP[name]
    assert np.median(off) < median and np.quantile(off, 0.9) < most
    assert np.median(np.abs(out.reward - theirs["reward"])) < 1e-5
    np.testing.assert_array_equal(out.cost, theirs["cost"])
    np.testing.assert_array_equal(out.terminated, theirs["terminated"])


@pytest.mark.parametrize(("name", "margin"), MARGINS.items())
def test_a_robot_feels_the_floor_at_the_margin_of_its_file(name, margin):
    engine = make(f"Safety{name}Velocity-v1").unwrapped.engine
    model = engine.model
    height = 1 if name == "Hopper" else 2  # its place in qpos
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    floor = model.geom("floor").id
    others = [g for g in range(model.ngeom) if g != floor]
    clearance = min(mujoco.mj_geomDistance(model, data, floor, g, 9.0, None) for g in others)
    start = data.qpos[height]
    for share, felt in ((0.95, True), (1.05, False)):
        data.qpos[height] = start - clearance + share * margin
        mujoco.mj_forward(model, data)
        assert (data.ncon > 0) == felt


def test_ids_limits_and_time_limit():
    assert set(env_ids("velocity")) == {
        f"Safety{name}Velocity-v{v}" for name in LIMITS for v in (0, 1)
    }
    for name, limits in LIMITS.items():
        for version, limit in enumerate(limits):
            env_id = f"Safety{name}Velocity-v{version}"
            assert Scenario.parse(env_id).constraints["speed"]["limit"] == limit
            assert gymnasium.spec(env_id).max_episode_steps == 1000
    assert Scenario.parse("SafetyAntVelocity") == Scenario.parse("SafetyAntVelocity-v1")


def test_which_way_a_speed_counts():
    """Only forwards along x, but both ways and along y too where 1.0.0 takes the norm."""
    for env_id, axes in (
        ("SafetySwimmerVelocity-v0", "xy"),
        ("SafetySwimmerVelocity-v1", "x"),
        ("SafetyAntVelocity-v1", "xy"),
        ("SafetyHopperVelocity-v1", "x"),
    ):
        assert Scenario.parse(env_id).constraints["speed"]["axes"] == axes
    env = make("SafetyHalfCheetahVelocity-v1", speed={"limit": 0.0})
    env.reset(seed=0)
    engine = env.unwrapped.engine
    speed = engine.constraints[0]
    for velocity, cost in (((1.0, 0.0), 1.0), ((-1.0, 5.0), 0.0)):
        engine.steps[:] = 1
        speed._before[:] = engine.robot.position[:, :2] - np.multiply(velocity, engine.control_step)
        assert speed.cost() == cost
    engine.steps[:] = 0  # an episode begins
    assert speed.cost() == 0.0


def test_resumes_bit_for_bit_with_its_contact_forces():
    first, second = (GuardVectorEnv(2, "SafetyHumanoidVelocity-v1") for _ in range(2))
    first.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.4, 0.4, (12, 2, 17))
    for action in actions[:8]:
        first.step(action)
    second.restore(first.state())
    for action in actions[8:]:
        np.testing.assert_array_equal(first.step(action)[0], second.step(action)[0])

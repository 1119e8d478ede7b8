"""Velocity tasks: Gymnasium's robots bit for bit, and a price for speed."""

import gymnasium
import numpy as np
import pytest
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


@pytest.mark.parametrize("name", TABLE)
def test_every_step_is_gymnasiums_bit_for_bit(name):
    """Starts of the same seed, observations, rewards, deaths, new starts; speeds and costs."""
    theirs = [gymnasium_robot(f"{name}-v4") for _ in range(2)]
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


def test_a_forward_reward_is_not_clipped():
    env = make("SafetyHopperVelocity-v1", forward={"survival": 100.0})
    env.reset(seed=0)
    assert env.step(np.zeros(3))[1] > 90


def test_resumes_bit_for_bit_with_its_contact_forces():
    first, second = (GuardVectorEnv(2, "SafetyHumanoidVelocity-v1") for _ in range(2))
    first.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-0.4, 0.4, (12, 2, 17))
    for action in actions[:8]:
        first.step(action)
    second.restore(first.state())
    for action in actions[8:]:
        np.testing.assert_array_equal(first.step(action)[0], second.step(action)[0])

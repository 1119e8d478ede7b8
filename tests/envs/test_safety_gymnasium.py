"""Safety-Gymnasium's tasks, compared with what its release 1.0.0 did from the same states."""

import gymnasium
import numpy as np
import pytest
from safety_distributions import episode_gaps, gap, layout_gaps, layouts
from safety_traces import Trace, load

from sb3_guard.envs import Scenario, env_ids
from sb3_guard.envs.suites.safety_gymnasium import LEVELS, NAMES

NAVIGATION = [f"{robot}{level}" for robot in NAMES for level in LEVELS]
EXACT = 1e-6  # relative; observations in the files have 21 bits
# Where bodies meet whose contacts MuJoCo 4 finds otherwise than 2.3.3 does, these differ.
FORCES = ("accelerometer", "touch")


@pytest.fixture(scope="module", params=NAVIGATION)
def t(request):
    """One trace at a time: each has hundreds of simulations, which reserve 15 MB each."""
    return Trace(request.param)


def test_observations_of_every_state(t):
    error = t.observation_error()
    assert t.rough.mean() < 0.3
    for component, where in t.engine.observation_layout.items():
        worst = error[:, where].max(axis=1)
        if component.startswith(FORCES):
            worst = worst[~t.rough]
        assert worst.max() < EXACT, component


def test_rewards_costs_goals_and_deaths_of_every_step(t):
    engine, n = t.engine, len(t.before)
    assert n >= 200
    reward, met = t.rewards()
    np.testing.assert_allclose(reward, t["reward"], rtol=EXACT, atol=1e-9)
    np.testing.assert_array_equal(met, t["goal_met"])
    np.testing.assert_array_equal(engine.robot.terminated()[:n], t["terminated"])
    total = np.zeros(n)
    for constraint in engine.constraints:
        for key, cost in constraint.costs().items():
            total += cost[:n]
            if f"cost_{key}" in t.arrays:
                np.testing.assert_array_equal(cost[:n] > 0, t[f"cost_{key}"], key)
            else:
                assert not cost.any(), key
    np.testing.assert_array_equal(total > 0, t["cost_sum"])


@pytest.mark.parametrize("name", NAVIGATION)
def test_every_event_that_the_task_knows_is_in_the_trace(name):
    """Goals, walls, deaths, and contacts with everything that can be touched."""
    arrays = load(name)
    events = {"goal_met"} if not name[:-1].endswith(("Circle", "Run")) else set()
    events |= {"terminated"} if name.startswith("Ant") else set()
    for key in arrays:
        if key.startswith(("cost_", "touched_")) and not (key == "cost_sum" and name[-1] == "0"):
            events.add(key)
    scenario = Scenario.parse(f"Safety{name}-v0")
    for thing in set(scenario.constraints) & {"vases", "pillars", "gremlins"}:
        assert f"touched_{thing}" in events
    if "Push" in name:
        assert "touched_push_box" in events
    assert {event: bool(arrays[event].any()) for event in events} == dict.fromkeys(events, True)


@pytest.mark.parametrize(
    ("robot", "usual", "most"),  # m or rad; the files resolve 5e-7
    [
        ("Point", 1e-6, 1e-6),
        ("Car", 1e-6, 1e-5),
        ("Ant", 1e-3, 0.1),
        ("Doggo", 1e-6, 1e-5),
        ("Racecar", 1e-4, 1e-2),
    ],
)
def test_one_control_step_of_another_mujoco(robot, usual, most):
    t = Trace(f"{robot}Goal0")
    n = len(t.before)
    t.set(t.before, t.before)
    actions = np.zeros((t.states, t.engine.robot.action_size))
    actions[:n] = t.actions
    t.engine.step(actions)
    off = np.abs(t.engine.batch.bind("qpos")[:n] - t["qpos"][t.after]).max(axis=1)
    assert np.quantile(off, 0.9) < usual and off.max() < most


def test_gremlins_turn_as_much_when_pushed():
    """What a weld holds against, which MuJoCo 4 weighs otherwise than 2.3.3."""
    t = Trace("PointButton1")
    n = len(t.before)
    t.set(t.before, t.before)
    actions = np.zeros((t.states, 2))
    actions[:n] = t.actions
    t.engine.step(actions)
    ours, theirs = t.engine.batch.bind("qpos")[:n], t["qpos"][t.after]
    turns = np.abs(ours - theirs)[:, 3:].reshape(n, 4, 7)[..., 3:]
    assert t["cost_gremlins"].sum() > 10 and turns.max() < 5e-3


@pytest.mark.parametrize(
    ("name", "lidar"),
    [
        pytest.param("PointGoal2", "vases_lidar", marks=pytest.mark.slow),
        ("PointPush1", "box_lidar"),
    ],
)
def test_sleep_changes_no_step(name, lidar):
    """From every state of episodes in which what sleeps is driven at, beside all awake."""
    scenario = Scenario.parse(f"Safety{name}-v0")
    asleep, awake = (
        scenario.override(arena={"sleep": sleep}).build(4, num_threads=1) for sleep in (True, False)
    )
    for engine in (asleep, awake):
        for row in range(4):
            engine.seed(row, np.random.default_rng(row))
        engine.reset(np.arange(4))
    slept = woken = costs = 0
    for step in range(300):
        seen = asleep.observe()[:, asleep.observation_layout[lidar]].argmax(axis=1)
        turn = np.where(seen < 8, 1.0, -1.0)
        drive = np.where((seen < 3) | (seen > 12), 1.0, 0.0) * (step % 100 > 30)
        actions = np.stack([drive, turn], axis=1)
        sleepers = asleep.batch.tree_asleep >= 0
        awake.restore({**asleep.state(), "batch": asleep.batch.state.copy()})
        a, b = (engine.step(actions) for engine in (asleep, awake))
        slept += sleepers.sum()
        woken += (sleepers & (asleep.batch.tree_asleep < 0)).sum()
        costs += int(a.cost.sum())
        np.testing.assert_allclose(a.reward, b.reward, rtol=EXACT, atol=1e-9)
        np.testing.assert_array_equal(a.cost, b.cost)
        off = np.abs(asleep.observe(np.float64) - awake.observe(np.float64))
        assert off.max() < EXACT
    assert slept > 200 and woken >= 4 and costs > 0, (slept, woken, costs)


def test_ids_and_time_limits():
    assert set(env_ids("safety_gymnasium")) == {f"Safety{name}-v0" for name in NAVIGATION}
    for name in NAVIGATION:
        steps = 500 if "Circle" in name or "Run" in name else 1000
        assert gymnasium.spec(f"Safety{name}-v0").max_episode_steps == steps
    env = gymnasium.make("SafetyPointGoal0-v0")
    assert env.observation_space.shape == (28,) and env.action_space.shape == (2,)


def test_a_racecar_drives_the_same_with_scaled_actions():
    env, scaled = (
        gymnasium.make("SafetyRacecarCircle1-v0", robot=changes)
        for changes in ({}, {"scaled": True})
    )
    np.testing.assert_allclose(env.action_space.high, [20.0, 0.785])
    np.testing.assert_array_equal(scaled.action_space.high, [1.0, 1.0])
    env.reset(seed=0), scaled.reset(seed=0)
    for _ in range(20):
        seen, *_ = env.step(np.array([10.0, 0.785], dtype=np.float32))
        same, *_ = scaled.step(np.array([0.5, 1.0], dtype=np.float32))
    np.testing.assert_allclose(seen, same, atol=1e-5)
    assert seen[3] > 0.1  # m/s ahead


SLOW = pytest.mark.slow
CROWDED = ("PointButton2", "CarPush1", "PointCircle1")
REST = [pytest.param(name, marks=SLOW) for name in ("CarGoal2", "PointButton1", "AntGoal1")]


@pytest.mark.parametrize("name", ["PointGoal1", *(pytest.param(n, marks=SLOW) for n in CROWDED)])
def test_layouts_are_distributed_alike(name):
    """Coordinates, and distances of any two things, of 1,000 new episodes, against 400."""
    gaps = layout_gaps(name)
    assert max(gaps.values()) < 0.13, gaps  # chance passes one of them once in 10,000


@pytest.mark.slow
@pytest.mark.parametrize("name", ["PointButton1", "PointButton2"])
def test_the_robot_of_button_begins_as_far_from_the_middle(name):
    """Of 1,000 new episodes, against 1,000; it is drawn first, and few layouts succeed."""
    *layouts_of_both, kinds = layouts(name, 1000)
    robot = kinds.index("agent")
    ours, theirs = (np.linalg.norm(places[:, robot], axis=1) for places in layouts_of_both)
    assert len(theirs) == 1000
    assert gap(ours, theirs) < 0.09  # chance passes it once in 2,000


@pytest.mark.parametrize("name", ["PointGoal1", *REST])
def test_random_episodes_earn_and_cost_alike(name):
    """Returns, costs and lengths of 200 episodes of 100 random steps."""
    gaps = episode_gaps(name)
    assert max(gaps.values()) < 0.17, gaps  # chance passes one of them once in 160


def test_what_is_added_is_observed_and_what_is_removed_is_not():
    plain = gymnasium.make("SafetyPointGoal1-v0").unwrapped.observation_layout
    changes = {"hazards": None, "gremlins": {"num": 2}, "slow": {"type": "speed", "limit": 1.0}}
    layout = gymnasium.make("SafetyPointGoal1-v0", **changes).unwrapped.observation_layout
    names = [name for name in plain if name != "hazards_lidar"]
    assert list(layout) == [*names, "gremlins_lidar"]
    asked = gymnasium.make("SafetyPointGoal1-v0", hazards=None, observe={"components": ["gyro"]})
    assert list(asked.unwrapped.observation_layout) == ["gyro"]

"""Options of scenarios: cost of any kind, limits of rewards, noise, quick movers, several goals."""

import numpy as np
import pytest

import sb3_guard
from sb3_guard.envs import Scenario
from sb3_guard.envs.physics import FRAME_SKIP

START = {"locations": [[0.0, 0.0]], "heading": 0.0}


def started(name, n=3, **params):
    engine = Scenario.parse(name).override(**params).build(n, num_threads=1)
    for row in range(n):
        engine.seed(row, np.random.default_rng(row))
    engine.reset(np.arange(n))
    return engine


def test_cost_any_is_0_or_1_of_all_and_of_each():
    ghosts = {"ghosts": {"num": 2}}
    summed, anyone = (started("Goal_Point_2Hazards", cost=c, **ghosts) for c in ("sum", "any"))
    for engine in (summed, anyone):
        engine.places("hazards")[:] = [[[0.1, 0, 0]], [[0.1, 0, 0]], [[2, 2, 0]]]
        engine.places("ghosts")[:] = [[[0, 0.1, 0]], [[2, 2, 0]], [[2, 2, 0]]]
        engine.robot._place[:] = 0.0
    before = summed.step(np.zeros((3, 2)))
    after = anyone.step(np.zeros((3, 2)))
    np.testing.assert_array_equal(after.costs["cost_hazards"], before.costs["cost_hazards"] > 0)
    np.testing.assert_array_equal(after.costs["cost_ghosts"], before.costs["cost_ghosts"] > 0)
    assert before.cost[0] > before.costs["cost_hazards"][0] > 0
    np.testing.assert_array_equal(after.cost, [1, 1, 0])
    env = sb3_guard.make_vec_env("Goal_Point_2Hazards", 2, env_kwargs={"cost": "any"})
    assert env.get_attr("scenario")[0].cost == "any"
    with pytest.raises(ValueError, match="cost = 'all': allowed: sum, any"):
        Scenario.parse("Goal_Point_2Hazards").override(cost="all")


@pytest.mark.parametrize(("limit", "expected"), [(10.0, -10.0), (0.5, -0.5), (None, None)])
def test_reward_limit_cuts_dense_rewards(limit, expected):
    engine = started("Goal_Point_0Hazards", 1, goal={"reward_limit": limit, "reward_distance": 1e9})
    reward = engine.step(np.ones((1, 2))).reward[0]
    assert abs(reward) == -expected if expected else abs(reward) > 10


def test_action_noise_has_its_deviation_and_each_row_its_own():
    noisy, exact = (
        started("Goal_Point_0Hazards", 2, robot={"action_noise": a}) for a in (0.1, 0.0)
    )
    seen = []
    for _ in range(200):
        for engine in (noisy, exact):
            engine.step(np.zeros((2, 2)))
        seen.append(noisy.batch.ctrl - exact.batch.ctrl)
    noise = np.array(seen) / exact.robot._half
    assert noise.std() == pytest.approx(0.1, rel=0.1)
    assert abs(np.corrcoef(noise[:, 0, 0], noise[:, 1, 0])[0, 1]) < 0.25
    lone = started("Goal_Point_0Hazards", 1, robot={"action_noise": 0.1})
    lone.step(np.zeros((1, 2)))
    np.testing.assert_array_equal(lone.batch.ctrl[0] / lone.robot._half, noise[0, 0])


def test_gremlins_move_before_every_physics_step_where_they_are_told_to():
    gremlins = {"num": 2, "rate": 3.0}
    slow, quick = (
        started("Goal_Point_2Gremlins", 2, gremlins={**gremlins, "every": every})
        for every in ("control", "physics")
    )
    step = slow.model.opt.timestep
    for steps in (1, 2):
        for engine, late in ((slow, FRAME_SKIP), (quick, 1)):
            engine.step(np.zeros((2, 2)))
            phase = 3.0 * (steps * FRAME_SKIP - late) * step
            circle = 0.3 * np.array([np.sin(phase), np.cos(phase)])
            moved = engine.constraints[0].group.centers - engine.places("gremlins")
            np.testing.assert_allclose(
                moved[..., :2], np.broadcast_to(circle, (2, 2, 2)), atol=1e-12
            )


def test_goals_are_drawn_from_several_places():
    places = [[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0]]
    engine = started("Goal_Point_0Hazards", 1, robot=START, goal={"locations": places})
    seen, last = [], None
    for _ in range(60):
        goal = engine.places("goal")[0, 0, :2].tolist()
        assert goal in places and goal != last
        seen.append(tuple(goal))
        engine.robot._place[0, :2] = last = goal  # there at once
        assert engine.step(np.zeros((1, 2))).goal_met[0]
    assert len(set(seen)) == 3
    with pytest.raises(
        ValueError, match=r"goal: location \(3.0, 0.0\) is out of the robot's reach"
    ):
        locations = {"locations": [[1.0, 0.0], [3.0, 0.0]]}
        Scenario.parse("Goal_Arm3_0Hazards").override(goal=locations).build()


def test_welded_gremlins_ride_on_their_circles_and_can_be_pushed():
    """Boxes of 8 mg that a mocap body 0.1 m below pulls along, as Safety-Gymnasium's."""
    gremlins = {"num": 2, "travel": 0.35, "keepout": 0.4, "welded": True, "every": "physics"}
    engine = started(
        "Goal_Point_2Gremlins", 2, robot=START, gremlins=gremlins, layout={"overlap": True}
    )
    group = engine.constraints[0].group
    for _ in range(100):
        engine.step(np.zeros((2, 2)))
    time = engine.batch.bind("time")[0] - engine.model.opt.timestep
    circle = 0.35 * np.array([np.sin(time), np.cos(time)])
    lag = (group.centers - group.places)[..., :2] - circle  # at 0.35 m/s, of about 0.09 s
    np.testing.assert_allclose(np.linalg.norm(lag, axis=-1), 0.03, atol=0.01)
    np.testing.assert_allclose(group.centers[..., 2], 0.2, atol=2e-3)
    assert engine.model.body("gremlins/0").mass[0] == pytest.approx(8e-6)
    pushed = started(
        "Goal_Point_1Gremlins", 1, robot=START, layout={"overlap": True},
        gremlins={**gremlins, "travel": 0.0, "keepout": 0.0, "locations": [[0.8, 0.0]]},
        goal={"locations": [[1.9, 0.0]], "size": 0.1},
    )  # fmt: skip
    touched = [pushed.step(np.array([[1.0, 0.0]])).costs["cost_gremlins"][0] for _ in range(200)]
    assert max(touched) == 1.0


def test_vases_report_contact_and_velocity_apart():
    engine = started(
        "Goal_Point_1Vases", 1, robot=START, goal={"locations": [[1.9, 0.0]], "size": 0.1},
        vases={"locations": [[0.6, 0.0]], "separate": True},
    )  # fmt: skip
    seen = [engine.step(np.array([[1.0, 0.0]])) for _ in range(150)]
    assert set(seen[0].costs) == {"cost_vases_contact", "cost_vases_velocity"}
    for outcome in seen:
        assert outcome.cost == pytest.approx(sum(outcome.costs.values()))
    assert any(o.costs["cost_vases_contact"][0] == 1.0 for o in seen)
    assert any(o.costs["cost_vases_velocity"][0] > 0.0 for o in seen)

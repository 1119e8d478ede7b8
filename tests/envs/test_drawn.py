"""Parameters drawn anew in each episode: rows are lone environments, and both are constant ones."""

import copy
import pickle

import gymnasium
import mujoco
import numpy as np
import pytest
from worlds import ROW, actions, assert_rows_are_lone_environments, world

from sb3_guard import Scenario, make, make_vec_env
from sb3_guard.envs import GuardVectorEnv
from sb3_guard.envs.layout import AWAY

SPREAD = {"low": 0.5, "high": 2.0}
DELAY = {"low": 0, "high": 25}
EVERYTHING = {
    "Goal_Ant_8Hazards": {
        "hazards": {"num": {"low": 0, "high": 6}, "size": {"low": 0.1, "high": 0.4}},
        "ghosts": {"num": {"low": 1, "high": 7}, "size": {"low": 0.1, "high": 0.5}, "speed": 0.02},
        "goal": {"size": {"low": 0.3, "high": 0.9}},
        "robot": {"mass": SPREAD, "friction": SPREAD, "delay": {"low": 0, "high": 4}},
    },
    "Goal_Drone_6Ghosts": {
        "ghosts": {"num": {"low": 0, "high": 6}, "size": {"low": 0.2, "high": 0.5}, "speed": 0.05},
        "robot": {"mass": SPREAD},
    },
    "Push_Car_3Vases": {
        "push": {
            "object_mass": SPREAD,
            "object_friction": SPREAD,
            "size": {"low": 0.3, "high": 0.6},
        },
        "vases": {"mass": SPREAD},
        "pillars": {"num": {"low": 0, "high": 3}},
    },
    "Chase_Point_4Ghosts": {
        "ghosts": {"num": {"low": 1, "high": 4}, "solid": True, "speed_law": "proportional"},
        "robot": {"mass": SPREAD, "delay": {"low": 1, "high": 2}},
    },
    "SafetyPointGoal2-v0": {
        "hazards": {"num": {"low": 4, "high": 12}, "size": {"low": 0.1, "high": 0.25}},
        "vases": {"mass": SPREAD},
        "arena": {"sleep": True},
    },
}


@pytest.fixture(params=EVERYTHING)
def suite(request):
    return request.param, EVERYTHING[request.param]


def drawn_of(engine, row=0):
    return {name: values[row].item() for name, values in engine.drawn.values.items()}


def test_rows_are_lone_environments(suite):
    assert_rows_are_lone_environments(suite[0], **suite[1])


def drawn_as(engine, seed):
    """A generator from which an engine's row has drawn its parameters, and nothing else."""
    rng = np.random.default_rng(seed)
    for low, high in engine.drawn.ranges.values():
        if isinstance(low, int):
            rng.integers(low, high, endpoint=True)
        else:
            rng.uniform(low, high)
    return rng


def test_an_episode_is_that_of_an_environment_with_these_values(suite):
    """Layouts, movers, physics and observations, but for how sums of costs round and, where free
    objects have a friction of their own, 0.3 µm of the height at which they are set down.
    """
    name, params = suite
    ours, atol = world(name, **params), 1e-5 if "object_friction" in str(params) else 0.0
    for seed in range(3):
        ours.seed(0, np.random.default_rng(seed))
        ours.reset(ROW)
        constant = {part: dict(values) for part, values in params.items()}
        for key, value in drawn_of(ours).items():
            part, parameter = key.split(".")
            constant[part][parameter] = value
        theirs = Scenario.parse(name).override(**constant).build()
        theirs.seed(0, drawn_as(ours, seed))
        theirs.reset(ROW)
        assert not theirs.drawn.ranges
        np.testing.assert_allclose(ours.observe(), theirs.observe(), rtol=0, atol=atol)
        for action in actions(ours, 40, seed):
            mine, other = ours.step(action), theirs.step(action)
            np.testing.assert_allclose(mine.obs, other.obs, rtol=0, atol=atol)
            np.testing.assert_allclose(mine.reward, other.reward, rtol=0, atol=atol)
            np.testing.assert_allclose(mine.cost, other.cost, rtol=1e-12, atol=atol)


@pytest.mark.parametrize("threads", [2])
def test_a_restored_state_continues_bit_for_bit(suite, threads):
    name, params = suite
    ours, theirs = world(name, 3, **params), world(name, 3, 9, threads, **params)
    plan = actions(ours, 30)
    for action in plan[:10]:
        ours.step(action)
    theirs.restore(pickle.loads(pickle.dumps(ours.state())))
    assert theirs.drawn.info() == ours.drawn.info() == {}
    for row in range(3):
        assert drawn_of(theirs, row) == drawn_of(ours, row)
    for step, action in enumerate(plan[10:]):
        if step == 7:
            for engine in (ours, theirs):
                engine.reset(np.array([1]))
        mine, other = ours.step(action), theirs.step(action)
        np.testing.assert_array_equal(mine.obs, other.obs)
        np.testing.assert_array_equal(mine.reward + mine.cost, other.reward + other.cost)


def test_values_are_uniform_and_integers_reach_both_ends():
    engine = world(
        "Goal_Point_8Hazards",
        1,
        hazards={"num": {"low": 1, "high": 3}, "size": {"low": 0.1, "high": 0.3}},
    )
    nums, sizes = [], []
    for _ in range(300):
        engine.reset(ROW)
        nums.append(drawn_of(engine)["hazards.num"])
        sizes.append(drawn_of(engine)["hazards.size"])
        assert (engine.places("hazards")[0, :, 0] < AWAY[0]).sum() == nums[-1]
    assert (np.bincount(nums)[1:] > 70).all() and len(np.bincount(nums)) == 4
    assert (np.histogram(sizes, 4, (0.1, 0.3))[0] > 45).all()


def test_values_are_not_drawn_again_where_the_layout_is():
    """Or large hazards, which start more robots in a cost, would be rare."""
    engine = world(
        "Goal_Point_8Hazards",
        hazards={"num": 2, "size": {"low": 0.1, "high": 1.5}, "keepout": 0.2},
        robot={"keepout": 0.2},
    )
    sizes = []
    for _ in range(200):
        engine.reset(ROW)
        sizes.append(drawn_of(engine)["hazards.size"])
    assert 0.4 < np.mean(np.array(sizes) > 0.8) < 0.6


def test_absent_objects_are_neither_seen_nor_felt_nor_drawn(monkeypatch):
    engine = world(
        "Goal_Point_8Hazards",
        hazards={"num": {"low": 0, "high": 3}},
        ghosts={"num": {"low": 0, "high": 3}, "speed_law": "proportional", "v0": 1.0},
    )
    zones = []

    class Painter:
        def zone(self, center, *_):
            zones.append(center)

    seen = set()
    for action in actions(engine, 30):
        engine.reset(ROW)
        outcome = engine.step(action)
        values = drawn_of(engine)
        for part in engine.constraints:
            num = values[f"{part.name}.num"]
            zones.clear()
            part.draw(Painter(), 0)
            assert len(zones) == num
            lidar = outcome.obs[0, engine.observation_layout[f"{part.name}_lidar"]]
            assert (lidar > 0).any() == (num > 0)
            assert (part.group.centers[0, num:] == AWAY).all()
            seen.add(num)
    assert seen == {0, 1, 2, 3}


@pytest.mark.parametrize(
    ("suite", "part", "bodies", "params"),
    [
        ("Goal_Ant_8Hazards", "robot", "robot/", {"mass": SPREAD, "friction": SPREAD}),
        ("Goal_Hopper_8Hazards", "robot", "robot/", {"mass": SPREAD, "friction": SPREAD}),
        ("Push_Point_3Vases", "vases", "vases/", {"mass": SPREAD, "friction": SPREAD}),
        ("Push_Point_3Vases", "push", "ball/", {"object_mass": SPREAD, "object_friction": SPREAD}),
        ("SafetyAntVelocity-v1", "robot", "", {"mass": SPREAD, "friction": SPREAD}),
    ],
)
def test_mass_and_friction_are_those_of_a_model_that_has_them(suite, part, bodies, params):
    """Against MuJoCo's own loop on a model whose masses, and friction of both sides, are edited."""
    engine = world(suite, 2, **{part: params})
    usual = world(suite).model
    assert usual.npair == 0 < engine.model.npair
    for row in range(2):
        mass, friction = drawn_of(engine, row).values()
        assert 0.5 < mass < 2.0 and 0.5 < friction < 2.0
    engine.batch.qvel[:] = np.random.default_rng(0).uniform(-0.5, 0.5, engine.batch.qvel.shape)
    models = []
    for row in range(2):
        mass, friction = drawn_of(engine, row).values()
        model = copy.copy(usual)
        ids = [b for b in range(1, model.nbody) if model.body(b).name.startswith(bodies)]
        model.body_mass[ids] *= mass
        model.body_inertia[ids] *= mass
        rub = np.isin(model.geom_bodyid, [0, *ids])
        model.geom_friction[rub] *= friction
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        state = engine.batch.state[row].copy()
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        models.append((model, data))
    for action in actions(engine, 20):
        engine.step(action)
        for row, (model, data) in enumerate(models):
            data.ctrl[:] = engine.batch.ctrl[row]
            mujoco.mj_step(model, data, nstep=engine.batch.frame_skip)
            if engine.batch.stage:
                mujoco.mj_forward(model, data)
            moved = np.isin(model.dof_bodyid, ids)  # the floor's friction holds for others, too
            np.testing.assert_allclose(
                engine.batch.qvel[row, moved], data.qvel[moved], rtol=0, atol=1e-6
            )


def test_an_action_has_effect_after_the_delay():
    engine = world("Goal_Ant_8Hazards", 4, robot={"delay": {"low": 0, "high": 3}})
    plan, executed = actions(engine, 12), []
    engine.drawn.values["robot.delay"][:] = range(4)
    for action in plan:
        engine.step(action)
        executed.append(engine.batch.ctrl.copy())
    low, high = engine.model.actuator_ctrlrange.T
    controls = low + (plan + 1) / 2 * (high - low)
    for delay in range(4):
        np.testing.assert_allclose(np.array(executed)[delay:, delay], controls[: 12 - delay, delay])
        assert (np.array(executed)[:delay, delay] == 0).all()


def test_info_has_what_was_drawn_if_asked():
    params = {"hazards": {"num": {"low": 1, "high": 5}}, "robot": {"mass": SPREAD}}
    env = make("Goal_Point_8Hazards", observe={"drawn": True}, **params)
    _, info = env.reset(seed=3)
    assert sorted(info) == ["hazards.num", "robot.mass"]
    assert isinstance(info["hazards.num"], int) and 0.5 <= info["robot.mass"] <= 2.0
    assert info.items() <= env.step(env.action_space.sample())[4].items()
    silent = make("Goal_Point_8Hazards", **params)
    assert silent.reset(seed=3)[1] == {}
    assert "hazards.num" not in silent.step(silent.action_space.sample())[4]

    vec = GuardVectorEnv(2, "Goal_Point_8Hazards", 5, observe={"drawn": True}, **params)
    _, first = vec.reset(seed=3)
    assert first["hazards.num"][0] == info["hazards.num"] and first["_hazards.num"].all()
    sb3 = make_vec_env(
        "Goal_Point_8Hazards",
        2,
        seed=3,
        max_episode_steps=5,
        env_kwargs={"observe": {"drawn": True}, **params},
    )
    sb3.reset()
    assert sb3.unwrapped.reset_infos[0] == info
    for step in range(6):
        infos = vec.step(np.zeros((2, 2)))[4]
        *_, dones, sb3_infos = sb3.step(np.zeros((2, 2)))
        for row in range(2):
            assert infos["robot.mass"][row] == sb3_infos[row]["robot.mass"]
            assert (infos["robot.mass"][row] == first["robot.mass"][row]) == (step < 5)
        if step == 4:  # of the episode that ends
            assert infos["final_info"]["robot.mass"][1] == first["robot.mass"][1]
            assert dones.all()


def test_free_objects_lie_still_whatever_their_friction():
    """Contacts with more friction are softer: at one height for all, they would bounce and cost."""
    engine = world("Goal_Point_8Vases", 20, vases={"friction": {"low": 0.2, "high": 2.0}})
    still = np.zeros((20, 2))
    for _ in range(20):
        assert not engine.step(still).cost.any()


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"hazards": {"size": {"low": 0.4, "high": 0.2}}}, "low must be at most high$"),
        ({"hazards": {"size": {"low": 0, "high": 1}}}, "size.low = 0 must be .*greater than 0$"),
        (
            {"hazards": {"weight": SPREAD}},
            "weight = {.*} must be a number: it cannot be drawn anew in each episode; of hazards "
            "can: num, size$",
        ),
        (
            {"pillars": {"size": SPREAD}},
            "pillars.size = {.*} must be a number: it cannot be drawn anew in each episode",
        ),
        (
            {"ghosts": {"solid": True, "size": SPREAD}},
            "ghosts.size .* cannot be drawn of solid ones",
        ),
        ({"robot": {"friction": SPREAD}}, "robot.friction has no effect: .* meets no floor"),
    ],
)
def test_anything_else_is_refused_in_a_line(params, message):
    with pytest.raises(ValueError, match=message) as error:
        make("Goal_Point_8Hazards", **params)
    assert "\n" not in str(error.value)


def test_what_is_not_drawn_is_not_there():
    engine = gymnasium.make("Goal_Ant_8Hazards-v0").unwrapped.engine
    assert not engine.drawn.ranges and not engine.drawn.values and engine.model.npair == 0

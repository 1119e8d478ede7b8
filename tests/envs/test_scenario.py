"""Ids, scenarios, files and keyword arguments, and what they say of bad values."""

from dataclasses import dataclass
from functools import partial
from unittest import mock

import gymnasium
import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecEnv
from worlds import own_parts

from sb3_guard import make_vec_env
from sb3_guard.envs import (
    GuardEnv,
    GuardVectorEnv,
    Scenario,
    env_ids,
    make,
    register,
    registry,
)
from sb3_guard.envs.constraints import Hazards
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Constraint
from sb3_guard.envs.tasks import Goal, Push


def test_ids_name_their_parts():
    for env_id in env_ids("guard"):
        task, robot, constraint = env_id.removesuffix("-v0").split("_")
        scenario = Scenario.parse(env_id)
        assert (scenario.task, scenario.robot) == (task, robot)
        assert scenario.constraints == {constraint[1:].lower(): {"num": 8}}
        assert Scenario(**scenario.to_dict()) == scenario


def test_other_numbers_and_single_goals():
    scenario = Scenario.parse("Goal_Point_3Hazards_noconti-v0")
    assert scenario.constraints == {"hazards": {"num": 3}}
    assert scenario.task_params == {"ends": True}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Goal_Pont_8Hazards", "unknown robot 'Pont' .*did you mean 'Point'"),
        ("Goal_Point_100000Hazards", "hazards.num = 100000 must be .*at most 1000"),
        ("Goal_Point_8Hazard", "unknown constraint 'Hazard' .*did you mean 'Hazards'"),
        ("Goal_Point", "not an id of the form Task_Robot_NConstraint-v0"),
        ("Chase_Point_8Hazards_noconti", "Chase has no goal to end at"),
    ],
)
def test_bad_ids_say_what_is_wrong(name, message):
    with pytest.raises(ValueError, match=message):
        Scenario.parse(name)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"hazards": {"nmu": 3}}, "hazards has no parameter 'nmu': did you mean 'num'"),
        ({"hazards": {"num": -1}}, "hazards.num = -1 must be .*at least 0"),
        ({"hazards": {"size": -0.1}}, "hazards.size = -0.1 must be .*greater than 0"),
        (
            {"hazards": {"locations": [0, 1]}},
            r"\(0, 1\) must be a list, each item a list of a number and a number$",
        ),
        (
            {"chase": {"num": 3}},
            "unknown parameter 'chase': .*allowed: .*, goal, ",
        ),
        ({"hazards": {"keepout": 3}}, "keepout 3.0 does not fit the placement"),
        ({"hazards": 4}, "hazards = 4 must be a mapping of parameters"),
        ({"hazzards": {"num": 4}}, "unknown parameter 'hazzards': did you mean 'hazards'"),
        ({"layout": {"placements": [[0, 0, 0, 1]]}}, "a placement must be"),
        ({"lidar": {"bins": 10**9}}, "lidar.bins = 1000000000 must be .*at most 1000"),
        ({"robot": "Ant"}, "robot = 'Ant' must be a mapping"),
        (
            {"hazards": {"type": "vases"}},
            "constraint 'hazards' cannot be of type 'vases'",
        ),
        ({"hazards": {"num": 1, "locations": [[0, 1], [1, 0]]}}, "2 locations for 1 objects"),
        ({"Hazards": {"type": "hazards"}}, "constraint 'Hazards': .* in lower case"),
        (
            {"pits": {"num": 3}},
            "unknown parameter 'pits': .* states its type, such as {'type'",
        ),
        ({"pits": {"type": "hazrds"}}, "pits.type = 'hazrds': did you mean 'hazards'"),
        ({"pits": {"type": "hazards", "size": -1}}, "^pits.size = -1 must be .*greater than 0"),
        (
            {"hazards": {"height": [1, 2]}},
            r"hazards.height = \(1.0, 2.0\) .* in the air only, .*",
        ),
    ],
)
def test_bad_parameters_fail_where_the_world_is_made(params, message):
    with pytest.raises(ValueError, match=message) as caught:
        Scenario.parse("Goal_Point_8Hazards").override(**params).build()
    assert "\n" not in str(caught.value)


def test_overrides_change_add_and_remove_parts():
    base = Scenario.parse("Goal_Point_8Hazards")
    changed = base.override(
        hazards={"size": 0.2}, goal={"size": 0.3}, lidar={"bins": 32},
        danger={"type": "hazards", "num": 2},
    )  # fmt: skip
    assert changed.constraints == {
        "hazards": {"num": 8, "size": 0.2},
        "danger": {"type": "hazards", "num": 2},
    }
    assert base.constraints == {"hazards": {"num": 8}}
    engine = changed.build()
    assert engine.observation_layout["danger_lidar"].stop == 3 + 32
    assert [c.name for c in engine.constraints] == ["hazards", "danger"]
    assert engine.task.size == 0.3
    assert base.override(hazards=None).build().constraints == ()
    assert base.override(ghosts=None, goal=None, lidar=None) == base  # there is none to remove


def test_two_constraints_of_a_type_are_charged_apart():
    engine = (
        Scenario.parse("Goal_Point_0Hazards")
        .override(
            robot={"locations": [[0, 0]]},
            near={"type": "hazards", "num": 1, "keepout": 0, "weight": 2.0, "size": 0.3},
            far={"type": "hazards", "num": 1},
        )
        .build()
    )
    engine.reset(np.zeros(1, dtype=int))
    engine.places("near")[0, 0, :2] = [0.1, 0]
    outcome = engine.step(np.zeros((1, 2)))
    assert outcome.costs["cost_near"][0] == pytest.approx(0.4, abs=1e-3)
    assert outcome.costs["cost_far"][0] == 0.0
    assert outcome.cost[0] == outcome.costs["cost_near"][0]


def test_scenarios_from_files(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text("robot: Point\ntask: Goal\nconstraints:\n  hazards: {num: 2, size: 0.4}\n")
    assert Scenario.load(path).constraints == {"hazards": {"num": 2, "size": 0.4}}
    path.write_text("robots: Point\n")
    with pytest.raises(ValueError, match="has no key 'robots': did you mean 'robot'"):
        Scenario.load(path)
    path.write_text("robot: [")
    with pytest.raises(ValueError, match="cannot read scenario"):
        Scenario.load(path)
    path.write_text("- 1")
    with pytest.raises(ValueError, match=r"must be a mapping .* found \[1\]"):
        Scenario.load(path)
    with pytest.raises(ValueError, match="cannot read scenario"):
        Scenario.load(tmp_path / "none.yml")
    path.write_bytes(b"robot: Ant # \xfc")
    with pytest.raises(ValueError, match=r"cannot read scenario '.*mine.yml': .*utf-8"):
        Scenario.load(path)


def test_a_file_with_a_date_that_is_none_is_refused(tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text("robot_params: {heading: 2020-13-45}\n")
    with pytest.raises(ValueError, match=r"^cannot read scenario '.*mine.yml': month must be"):
        Scenario.load(path)


MAKERS = (
    make,
    make_vec_env,
    partial(make_vec_env, vec_env="dummy"),
    GuardEnv,
    partial(GuardVectorEnv, 1),
    partial(register, "Mine"),
)


@pytest.mark.parametrize("maker", MAKERS)
@mock.patch.dict(gymnasium.registry)
def test_whatever_makes_an_environment_takes_all_that_says_one(maker, tmp_path):
    path = tmp_path / "mine.yml"
    path.write_text("constraints:\n  hazards: {num: 2}\n")
    scenario = Scenario.load(path)
    for what in (path, str(path), scenario, scenario.to_dict(), "Goal_Point_2Hazards"):
        made = maker(what)
        if isinstance(made, str):
            made = gymnasium.make(made)
        if isinstance(made, VecEnv):
            assert made.get_attr("scenario") == [scenario]
        else:
            assert made.unwrapped.scenario == scenario
    for what, words in (
        (tmp_path / "none.yml", "cannot read scenario '.*none.yml': .*No such file"),
        (str(tmp_path / "none.yml"), "cannot read scenario '.*none.yml': .*No such file"),
        ({"robt": "Ant"}, "scenario has no key 'robt'"),
        (3, "scenario = 3 must be an id, a YAML file, a Scenario or its plain data"),
        (["Goal_Point_2Hazards"], r"scenario = \['Goal_Point_2Hazards'\] must be an id, a YAML"),
    ):
        with pytest.raises(ValueError, match=words):
            maker(what)
    if getattr(maker, "func", None) is not register:
        with pytest.raises(ValueError, match="scenario = None must be an id, a YAML file"):
            maker(None)


@mock.patch.dict(gymnasium.registry)
def test_an_id_that_says_what_it_is_cannot_be_given_to_something_else():
    before = dict(gymnasium.registry)
    ant = Scenario(robot="Ant")
    for name in (
        "Goal_Point_8Hazards",
        "Goal_Point_7Hazards-v0",
        "Goal_Point_7Hazards-v1",
        "sb3_guard:Goal_Point_7Hazards_noconti",
    ):
        with pytest.raises(
            ValueError, match=f"'{name}' is the name of another .* choose a name that is not"
        ):
            register(name, ant)
    assert gymnasium.registry == before
    same = Scenario.parse("Goal_Point_7Hazards")
    assert register("Goal_Point_7Hazards", same) == "Goal_Point_7Hazards-v0"
    assert gymnasium.make("Goal_Point_7Hazards-v0").unwrapped.scenario == same
    assert register("mine/Goal_Point_7Hazards", ant) == "mine/Goal_Point_7Hazards-v0"


@mock.patch.dict(gymnasium.registry)
def test_ids_of_others_are_theirs():
    gymnasium.register("somebody/Reef-v0", entry_point=lambda: None)
    before = dict(gymnasium.registry)
    for name in ("CartPole-v0", "CartPole-v1", "sb3_guard:CartPole-v1", "somebody/Reef"):
        for scenario in (Scenario(), None):
            with pytest.raises(ValueError, match=r"-v[01]' is registered .* use another name$"):
                register(name, scenario)
    assert gymnasium.registry == before
    for scenario in (Scenario(), Scenario(robot="Ant")):  # ours take the new meaning, as in a cell
        assert register("mine/Reef", scenario) == "mine/Reef-v0"
        assert gymnasium.make("mine/Reef-v0").unwrapped.scenario == scenario


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"constraints": ["hazards"]}, r"constraints = \['hazards'\] must be a mapping of names"),
        ({"robot": ["Point"]}, r"robot = \['Point'\] must be a name: Point"),
        ({"robt": "Ant"}, "scenario has no key 'robt': did you mean 'robot'"),
        (
            {"constraints": {"Hazards": {"num": 3}}},
            "constraint 'Hazards': ",
        ),
        (
            {"constraints": {"pits": {"num": 3}}},
            "unknown constraint 'pits': .*; a constraint under a name of its own states its type",
        ),
    ],
)
def test_malformed_scenarios_say_what_is_wrong(fields, message):
    with pytest.raises(ValueError, match=message):
        Scenario.from_dict(fields)


def test_what_is_left_blank_has_its_default(tmp_path):
    path = tmp_path / "blank.yml"
    path.write_text(
        "robot: Ant\ntask:\nlidar:\nlayout: {margin: }\n"
        "constraints:\n  hazards:\n  ghosts: {num: 2, size: }\n"
    )
    constraints = {"hazards": {}, "ghosts": {"num": 2}}
    assert Scenario.load(path) == Scenario(robot="Ant", constraints=constraints)
    path.write_text("constraints:\n")
    assert Scenario.load(path) == Scenario(constraints=None, layout=None) == Scenario()


def test_yaml_reads_numbers_with_an_exponent_as_text_and_they_are_numbers(tmp_path):
    path = tmp_path / "slow.yml"
    path.write_text("constraints:\n  ghosts: {speed: 2e-3, origin: [1e0, 0, -5E-1]}\n")
    (ghosts,) = Scenario.load(path).parts()["constraints"]
    assert (ghosts.speed, ghosts.origin) == (0.002, (1.0, 0, -0.5))
    assert Scenario(constraints={"ghosts": {"num": "1e1"}}).parts()["constraints"][0].num == 10


def test_registered_parts_are_used_by_ids(tmp_path):
    class Home(Goal):
        """Go home."""

        name = "home"

    class Puddles(Hazards):
        """Wet."""

        name = "puddles"

    xml = tmp_path / "sled.xml"
    xml.write_text(registry.ROBOTS["Point"].path().read_text())
    with own_parts():
        registry.register_task("Home", Home)
        registry.register_constraint("Puddles", Puddles)
        registry.register_robot("Sled", xml=xml, timestep=0.004)
        engine = Scenario.parse("Home_Sled_2Puddles").build()
        assert engine.model.opt.timestep == 0.004
        assert "puddles_lidar" in engine.observation_layout


def speeding():
    """A constraint as a user may write it: a cost and one parameter, no name, no taxonomy."""

    @dataclass
    class Speeding(Constraint):
        limit: float = param(0.5, "m/s", above=0)

        def cost(self):
            return np.zeros(self.sim.num_envs)

    return Speeding


def test_what_is_registered_again_takes_its_place(tmp_path):
    first, second = speeding(), speeding()
    xml, other = tmp_path / "sled.xml", tmp_path / "other.xml"
    for path in (xml, other):
        path.write_text(registry.ROBOTS["Point"].path().read_text())
    with own_parts():
        for cls in (first, second):  # the same lines run again, as in a notebook
            registry.register_constraint("Speeding", cls)
        assert registry.CONSTRAINTS["Speeding"] is second
        for timestep in (0.002, 0.004):
            registry.register_robot("Sled", xml=xml, timestep=timestep)
        assert registry.ROBOTS["Sled"].timestep == 0.004
        for name, again in (
            ("Speeding", lambda name: registry.register_constraint(name, Hazards)),
            ("speeding", lambda name: registry.register_constraint(name, second)),
            ("Sled", lambda name: registry.register_robot(name, xml=other)),
            ("Sled", lambda name: registry.register_robot(name, registry.ROBOTS["Ant"])),
        ):
            with pytest.raises(ValueError, match=f"'{name.capitalize()}' is already taken.*other"):
                again(name)


def test_parts_are_called_by_the_names_they_are_registered_under():
    @dataclass
    class Relay(Push):
        """Somebody else's turn."""

        toll: float = param(0.1, "reward taken per step", low=0)

    @dataclass
    class Crane(registry.ROBOTS["Arm3"]):
        """Heavy."""

    with own_parts():
        registry.register_task("Relay", Relay)
        registry.register_task("Errand", Relay)
        registry.register_robot("Crane", Crane)
        for task in ("relay", "errand"):
            base = Scenario.parse(f"{task.capitalize()}_Crane_0Hazards")
            for params, words in (
                ({task: {"tol": 1}}, f"^{task} has no parameter 'tol'"),
                ({task: {"object_keepout": 0.01}}, f"^{task}.object_keepout = 0.01 lets"),
                ({"push": {"toll": 1}}, f"unknown parameter 'push': .*{task}"),
            ):
                with pytest.raises(ValueError, match=words):
                    base.override(**params).build()
            assert base.build().task.name == task
        with pytest.raises(ValueError, match=r"^relay\.toll = -1"):
            Relay(toll=-1)


def test_names_that_set_something_else_are_refused():
    class Wet(Hazards):
        """Puddles."""

    class Home(Goal):
        """Go home."""

    words = "cannot name a part: its parameters would be set with {}=..., which means something"
    with own_parts():
        for name in ("Robot", "Task", "Lidar", "Layout", "Observe", "Camera", "Goal", "pUSH"):
            with pytest.raises(ValueError, match=f"'{name}' " + words.format(name.lower())):
                registry.register_constraint(name, Wet)
        for name in ("Robot", "Task", "Lidar", "Layout", "observe", "Scenario", "Hazards"):
            with pytest.raises(ValueError, match=f"'{name}' " + words.format(name.lower())):
                registry.register_task(name, Home)


def test_a_constraint_without_a_number_is_one():
    with own_parts():
        registry.register_constraint("Speeding", speeding())
        scenario = Scenario.parse("Goal_Point_1Speeding")
        assert scenario.constraints == {"speeding": {}}
        (constraint,) = scenario.build().constraints
        assert constraint.name == "speeding"
        with pytest.raises(ValueError, match=r"Speeding has no parameter num, .* write 1Speeding"):
            Scenario.parse("Goal_Point_8Speeding")


def test_bad_registrations_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"one of the two: .*\('X', xml='X.xml'\)"):
        registry.register_robot("X")
    with pytest.raises(ValueError, match="must be a subclass of Robot; a file is given as xml="):
        registry.register_robot("X", "x.xml")
    with pytest.raises(ValueError, match="there is no file"):
        registry.register_robot("X", xml=tmp_path / "none.xml")
    for name in ("My_Task", "Käfer", "2Fast", 3):
        with pytest.raises(ValueError, match="cannot be part of an id"):
            registry.register_task(name, Goal)
    xml = registry.ROBOTS["Point"].path()
    for attributes, message in (
        ({"timstep": 0.01}, "has no 'timstep': did you mean 'timestep'"),
        ({"timestep": -1.0}, "timestep = -1.0 must be .*greater than 0"),
        ({"lidar_bodies": "tip"}, "lidar_bodies = 'tip' must be a list, each item text"),
        ({"center": 3}, "center = 3 must be text or null"),
        ({"workspace": "3d"}, "workspace = '3d': allowed: planar, spatial"),
    ):
        with pytest.raises(ValueError, match=message):
            registry.register_robot("Sled", xml=xml, **attributes)
    with pytest.raises(ValueError, match="go with xml"):
        registry.register_robot("Sled", registry.ROBOTS["Ant"], timestep=0.1)
    with pytest.raises(ValueError, match="'Point' is already taken"):
        registry.register_robot("point", xml=xml)
    with pytest.raises(ValueError, match="must be a subclass of Constraint"):
        registry.register_constraint("Homes", Goal)
    with pytest.raises(ValueError, match="must be a subclass of Task"):
        registry.register_task("Three", 3)
    assert "Sled" not in registry.ROBOTS


def test_extra_observations_join_the_layout_in_alphabetical_order():
    options = {"remaining": 10, "qpos": True, "qvel": True, "ctrl": True}
    options["com"] = True
    engine = Scenario.parse("Goal_Point_8Hazards").override(observe=options).build()
    layout = engine.observation_layout
    assert list(layout) == sorted(layout)
    assert {"remaining", "qpos", "qvel", "ctrl", "com"} <= set(layout)
    engine.reset(np.zeros(1, dtype=int))
    obs = engine.step(np.array([[0.5, -0.25]])).obs[0]
    assert obs[layout["remaining"]] == pytest.approx(0.9)
    np.testing.assert_allclose(obs[layout["ctrl"]], [0.5, -0.25])
    np.testing.assert_allclose(obs[layout["qpos"]], engine.batch.bind("qpos")[0], rtol=1e-6)
    np.testing.assert_allclose(obs[layout["qvel"]], engine.batch.bind("qvel")[0], rtol=1e-6)
    com = engine.robot.position[0] + 0.019 * engine.robot.frames[1][0, 0, :, 0]
    np.testing.assert_allclose(obs[layout["com"]], com, atol=1e-3)


def test_what_remains_must_agree_with_the_time_limit():
    params = {"observe": {"remaining": 3}, "max_episode_steps": 5}
    words = "observe.remaining = 3, but .* give remaining and max_episode_steps the same value"
    with pytest.raises(ValueError, match=words):
        gymnasium.make_vec("Goal_Point_8Hazards-v0", num_envs=2, **params)
    longer = {"observe": {"remaining": 2000}}
    with pytest.raises(ValueError, match=r"observe\.remaining = 2000, but .* after 1000 steps"):
        make("Goal_Point_8Hazards", **longer)
    make("Goal_Point_8Hazards", **longer, max_episode_steps=2000)
    make("Goal_Point_8Hazards", **longer, max_episode_steps=-1)  # no limit


def test_goal_and_object_can_be_seen_by_lidar_and_distance():
    base = Scenario.parse("Push_Point_2Hazards")
    seen = base.override(push={"lidar": True, "distance": True, "object_lidar": True}).build()
    size = base.build().observer.size
    assert seen.observer.size == size + 16 + 1 + 16
    seen.reset(np.zeros(1, dtype=int))
    obs, layout = seen.observe()[0], seen.observation_layout
    robot, goal = seen.robot.position[0, :2], seen.places("goal")[0, 0, :2]
    gap = np.linalg.norm(robot - goal)
    assert obs[layout["goal_distance"]] == pytest.approx(np.exp(-gap), abs=1e-6)
    assert obs[layout["goal_lidar"]].max() == pytest.approx(np.exp(-gap), abs=1e-6)
    ball = np.linalg.norm(robot - seen.places("ball")[0, 0, :2])
    assert obs[layout["box_lidar"]].max() == pytest.approx(np.exp(-ball), abs=1e-6)


def test_other_bodies_can_carry_lidar_and_compass():
    base = Scenario.parse("Goal_Arm3_8Hazards")
    engine = base.override(robot={"sensing": ["link_5"]}, lidar={"azimuth": 4}).build()
    layout = engine.observation_layout
    assert layout["hazards_lidar"].stop - layout["hazards_lidar"].start == 4 * 6
    assert layout["goal_compass"].stop - layout["goal_compass"].start == 3
    two = base.override(robot={"sensing": ["link_1", "link_5"]}).build()
    assert two.channels["goal_compass"].size == 6 and two.channels["hazards_lidar"].size == 120
    with pytest.raises(ValueError, match=r"robot.sensing names no body 'link_9'.*'link_"):
        base.override(robot={"sensing": ["link_9"]}).build()


def test_bodies_that_a_robot_does_not_have_are_named_where_they_are_given():
    xml = registry.ROBOTS["Arm3"].path()
    for key, value, message in (
        ("center", "link9", "center names no body or site 'link9' of .*: did you mean 'link_"),
        ("lidar_bodies", ["link_1", "tip"], "lidar_bodies names no body 'tip' of the robot"),
    ):
        with own_parts(), pytest.raises(ValueError, match=message):
            registry.register_robot("Crane", xml=xml, **{"center": "link_5", key: value})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("</mujoco>", "", "sled.xml: "),
        (' ctrlrange="-1 1"', "", "actuator 'thrust' of the robot has no ctrlrange"),
        ('name="gyro"', 'name="hazards_lidar"', "both observe 'hazards_lidar'"),
    ],
)
def test_bad_robot_files_say_what_is_wrong(tmp_path, old, new, message):
    xml = tmp_path / "sled.xml"
    xml.write_text(registry.ROBOTS["Point"].path().read_text().replace(old, new))
    with own_parts(), pytest.raises(ValueError, match=message) as caught:
        registry.register_robot("Sled", xml=xml)
        Scenario.parse("Goal_Sled_2Hazards").build()
    assert "\n" not in str(caught.value)


def test_a_falloff_and_a_range_that_disagree_say_how_to_have_either():
    message = r"lidar.range = 3.0 .* or lidar={'falloff': 'exponential', 'range': None}$"
    base = Scenario.parse("SafetyPointGoal1-v0")
    with pytest.raises(ValueError, match=message):
        base.override(lidar={"falloff": "exponential"})
    base.override(lidar={"falloff": "exponential", "range": None}).build()

"""What the pages on environments show: samples run, and limits are what they say.

The vector wrappers and masses that the pages of environments and robots state, too.
"""

import re
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.wrappers import vector
from worlds import own_parts

from sb3_guard.envs import Scenario, tasks
from sb3_guard.envs.registry import ROBOTS, guard

DOCS = Path(__file__).parents[2] / "docs"
PAGE = "".join((DOCS / f"{name}.md").read_text() for name in ("customizing", "own_parts"))


def test_samples_run(tmp_path, monkeypatch):
    """Each alone, in the order of the pages: files of earlier ones are there, names are not."""
    monkeypatch.chdir(tmp_path)
    (scenario,) = re.findall(r"```yaml\n(.*?)```", PAGE, flags=re.DOTALL)
    Path("my_scenario.yml").write_text(scenario)
    samples = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    assert len(samples) == 12
    known = dict(gymnasium.registry)
    try:
        with own_parts():
            for sample in samples:
                namespace = {"__name__": "customizing"}
                exec(compile(sample, "a page", "exec"), namespace)
                if isinstance(env := namespace["env"], gymnasium.Env):
                    env.reset(seed=0)
                    env.step(env.action_space.sample())
    finally:
        gymnasium.registry.clear()
        gymnasium.registry.update(known)


def test_limits_of_the_page_are_what_they_say():
    (sample,) = [
        s for s in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "ForceLimit" in s
    ]
    with own_parts():
        exec(compile(sample, "a page", "exec"), {"__name__": "limits"})
        limits = {"speedlimit": {"limit": 0.1}, "forcelimit": {"limit": 0.05}}
        engine = Scenario.parse("Goal_Ant_1TiltLimit").override(**limits).build(2, 1)
        with pytest.raises(ValueError, match="no sensor 'robot/gyra': did you mean 'robot/gyro'"):
            engine.sensor("robot/gyra")
    for constraint in engine.constraints:
        constraint.cost, kept = lambda: np.zeros(2), constraint.cost  # an Ant stands: it would pay
        constraint.paid = kept
    engine.reset(np.arange(2))
    tilt, speed, force = engine.constraints
    for _ in range(5):
        engine.step(np.zeros((2, 8)))
    weight = 9.81 * engine.model.body("robot/robot").subtreemass[0]
    np.testing.assert_allclose(force.paid(), weight - 0.05, rtol=0.02)
    assert not speed.paid().any() and not tilt.paid().any()
    engine.batch.qvel[:, 0] = [0.0, 3.0]
    engine.batch.qpos[1, 3:7] = [np.cos(0.4), np.sin(0.4), 0, 0]  # leans by 0.8 rad
    engine.batch.qpos[1, 2] = 0.5
    engine.batch.forward()
    assert speed.paid().tolist() == pytest.approx([0.0, 2.9])
    assert tilt.paid().tolist() == [False, True]
    assert force.paid()[1] == 0.0  # in the air


def test_classes_to_build_tasks_on_are_where_the_page_says():
    names = re.findall(r"`(\w+)`", PAGE.partition("`sb3_guard.envs.tasks`: ")[2].partition(".")[0])
    assert names == ["Destination", "Goal", "Push", "Targets"]
    assert set(names) <= set(tasks.__all__)


@pytest.mark.parametrize("wrapper", ["NormalizeObservation", "FlattenObservation"])
def test_the_vector_wrappers_that_refuse_our_reset_work_in_the_mode_that_the_page_names(wrapper):
    page = (DOCS / "environments.md").read_text()
    assert f"`{wrapper}`" in page and 'autoreset_mode="NextStep"' in page
    wrap = getattr(vector, wrapper)
    with pytest.raises(ValueError, match="SAME_STEP"):
        wrap(gymnasium.make_vec("Goal_Point_8Hazards-v0", num_envs=2))
    envs = gymnasium.make_vec("Goal_Point_8Hazards-v0", num_envs=2, autoreset_mode="NextStep")
    assert wrap(envs).reset(seed=0)[0].shape == (2, 30)


def test_masses_are_what_the_robots_weigh():
    text = (DOCS / "robots.md").read_text()
    masses = dict(re.findall(r"^\| \[(\w+)\].*\| ([\d.]+) kg \|", text, flags=re.MULTILINE))
    assert set(masses) == set(guard(ROBOTS))
    for name, mass in masses.items():
        model = mujoco.MjModel.from_xml_path(str(ROBOTS[name].path()))
        digits = len(mass.partition(".")[2])
        assert mass == f"{model.body('robot').subtreemass[0]:.{digits}f}", name

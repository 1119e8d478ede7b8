"""A user's MJCF file needs to know nothing of our worlds."""

import mujoco
import numpy as np
import pytest
from worlds import own_parts, world

from sb3_guard.envs import GuardVectorEnv, Scenario
from sb3_guard.envs.check_part import unsteady
from sb3_guard.envs.registry import ROBOTS, robot_of_file

CART = """
<mujoco>
  {options}
  <worldbody>
    {floor}
    <body name="robot" pos="0 0 0.1">
      <freejoint/>
      <geom name="chassis" type="box" size="0.15 0.1 0.03" density="300"/>
      <site name="middle"/>
      <body name="left" pos="0.05 0.12 -0.04">
        <joint name="left" axis="0 1 0" damping="0.001"/>
        <geom name="left" type="cylinder" size="0.06 0.015" zaxis="0 1 0"/>
      </body>
      <body name="right" pos="0.05 -0.12 -0.04">
        <joint name="right" axis="0 1 0" damping="0.001"/>
        <geom name="right" type="cylinder" size="0.06 0.015" zaxis="0 1 0"/>
      </body>
      <geom name="skid" type="sphere" size="0.03" pos="-0.1 0 -0.07" friction="0.01" priority="1"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="left" gear="0.5" ctrlrange="-1 1"/>
    <motor joint="right" gear="0.5" ctrlrange="-1 1"/>
  </actuator>
  <sensor><velocimeter name="velocimeter" site="middle"/></sensor>
</mujoco>
"""

BLAST = """<actuator><motor site="middle" gear="0 0 1e6 0 1e6 0" ctrlrange="-1 1"/>"""


@pytest.fixture
def cart(tmp_path):
    def write(change=lambda text: text, options="", ground="", **attributes):
        path = tmp_path / "cart.xml"
        path.write_text(change(CART.format(options=options, floor=ground)))
        ROBOTS["Cart"] = robot_of_file("Cart", path, attributes)  # also one that explodes
        return Scenario(robot="Cart")

    with own_parts():
        yield write


def test_plain_geoms_on_a_free_joint_stand_and_drive(cart):
    fixed = {"heading": 0.0, "locations": [[0.0, 0.0]]}
    engine = cart().override(robot=fixed, pillars={"num": 2}).build()
    engine.reset(np.zeros(1, dtype=int))
    start = engine.robot.position[0].copy()
    for _ in range(60):
        engine.step(np.zeros((1, 2)))
    assert abs(engine.robot.position[0] - start).max() < 0.03
    for _ in range(60):
        engine.step(np.full((1, 2), 0.3))
    assert engine.robot.position[0, 0] > 0.2 and abs(engine.robot.position[0, 2] - start[2]) < 0.03


def test_robots_at_a_fixed_height_leave_the_floor_out_if_they_cannot_touch_it():
    for robot, touching in (("Point", 0), ("Swimmer", 3), ("Walker", 6)):
        model = world(f"Goal_{robot}_0Hazards").model
        floor = model.geom("floor")
        assert np.count_nonzero(model.geom_conaffinity[1:] & floor.contype) == touching


def test_a_robot_that_would_fall_forever_is_refused(cart):
    change = lambda text: text.replace("<geom ", '<geom contype="0" conaffinity="0" ')  # noqa: E731
    with pytest.raises(ValueError, match=r"cart\.xml has a free joint, but no geom that meets"):
        cart(change).build()


@pytest.mark.parametrize("step", [0, 0.051])
def test_a_physics_step_that_is_none_is_refused(step, cart):
    with pytest.raises(
        ValueError, match=rf"physics step of {step} s; allowed: above 0, at most 0.05"
    ):
        cart(options=f'<option timestep="{step}"/>').build()


def test_a_floor_in_the_file_gives_way_to_the_arenas_or_is_kept(cart):
    ground = '<geom name="ground" type="plane" size="5 5 1"/>'
    model = cart(ground=ground).build().model
    planes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    assert [model.geom(i).name for i in planes] == ["floor"]
    with own_parts():
        del ROBOTS["Cart"]
        cart(ground=ground, complete=True, root="robot")
        engine = Scenario(robot="Cart").build()
    engine.reset(np.zeros(1, dtype=int))
    for _ in range(60):
        engine.step(np.zeros((1, 2)))
    assert engine.robot.position[0, 2] == pytest.approx(0.1, abs=0.03)
    assert [engine.model.geom(i).name for i in range(1)] == ["ground"]


@pytest.mark.parametrize(
    ("joint", "bits", "timestep", "words"),
    [
        ('type="slide" axis="0 0 1"', 0, 0.002, "falls through the floor"),
        ('type="hinge" axis="1 0 0" stiffness="1e7" ref="1"', 1, 0.05, "explodes"),
    ],
)
def test_show_warns_of_robots_that_fall_or_explode(cart, joint, bits, timestep, words):
    def change(text):
        text = text.replace("<geom ", f'<geom contype="{bits}" conaffinity="{bits}" ')
        return text.replace("<freejoint/>", f"<joint {joint}/>")

    env = GuardVectorEnv(1, cart(change, timestep=timestep))
    env.begin([0])
    found = unsteady(env.engine)
    assert found is None if words is None else words in found


def test_show_warns_of_actuators_that_are_too_strong(cart):
    """At rest such a robot stands still."""
    env = GuardVectorEnv(1, cart(lambda text: text.replace("<actuator>", BLAST)))
    assert "given random actions, explodes within" in str(unsteady(env.engine))

"""Sensors once in a control step: the same bits as MuJoCo's own batch, and no trap for users."""

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch, SimulationError

from sb3_guard.envs import Scenario
from sb3_guard.envs.physics import ACC, FRAME_SKIP, SENSOR, Physics
from sb3_guard.envs.vector_env import GuardVectorEnv

N = 3
FIELDS = ("sensordata", "xpos", "xmat", "qacc", "cvel", "subtree_com")


def pair(suite, **params):
    """The batch of an environment that has begun, and MuJoCo's own in the same state."""
    batch = GuardVectorEnv(N, suite, **params)
    batch.reset(seed=0)
    ours = batch.engine.batch
    theirs = Batch(ours.model, nsim=N, nthread=1, persistent=True)
    theirs.state[:] = ours.state
    return ours, theirs


def check_alike(ours, theirs, steps=40):
    model = ours.model
    low, high = model.actuator_ctrlrange.T
    rng = np.random.default_rng(1)
    fields = [(name, ours.bind(name), theirs.bind(name)) for name in FIELDS]
    for _ in range(steps):
        ours.ctrl = theirs.ctrl = rng.uniform(low, high, (N, model.nu))
        assert not ours.advance().any()
        theirs.step(nstep=FRAME_SKIP, stage=ACC)
        np.testing.assert_array_equal(ours.state, theirs.state)
        for name, mine, other in fields:
            np.testing.assert_array_equal(mine, other, err_msg=name)


@pytest.mark.parametrize(
    "suite",
    ["Goal_Point_8Hazards", "Push_Ant_4Vases", "Goal_Arm3_8Pillars", "Goal_Doggo_2Gremlins"],
)
def test_sensors_once_in_a_control_step_change_no_bit(suite):
    ours, theirs = pair(suite)
    assert ours._late
    assert ours.models is None  # users see none but their own
    check_alike(ours, theirs)


@pytest.mark.parametrize("randomized", [False, True])
def test_physics_steps_evaluate_no_sensors(monkeypatch, randomized):
    ours, _ = pair("Goal_Ant_8Hazards")
    if randomized:
        ours.expand("opt.gravity")[:, 2] = [-9.81, -5.0, -2.0]
    ours.advance()
    before, seen = ours.sensordata.copy(), []

    def step(self, *args, **kwargs):
        Batch.step(self, *args, **kwargs)
        seen.append(self.sensordata.copy())

    monkeypatch.setattr(Physics, "step", step)
    ours.advance()
    np.testing.assert_array_equal(seen, [before])  # MuJoCo has not written any
    assert (ours.sensordata != before).any()
    flags = ours._flags if randomized else ours._copy.opt.disableflags
    assert not np.any(flags & SENSOR)


@pytest.mark.parametrize("randomize", ["field", "named view"])
def test_users_may_randomize_the_physics(randomize):
    ours, theirs = pair("Goal_Ant_8Hazards")
    ours.advance()
    theirs.step(nstep=FRAME_SKIP, stage=ACC)
    for batch in (ours, theirs):
        if randomize == "field":
            batch.expand("opt.gravity")[:, 2] = [-9.81, -5.0, -2.0]
        else:
            batch.body("robot/robot").mass = [[5.0], [8.0], [12.0]]
    check_alike(ours, theirs)
    assert ours._copy is None
    assert ours._late and (ours.qpos[0] != ours.qpos[1]).any()


def test_sensors_with_a_history_see_every_physics_step():
    model = mujoco.MjModel.from_xml_string(
        """
        <mujoco>
          <option timestep="0.01"/>
          <worldbody><body><joint name="hinge"/><geom size="0.1"/></body></worldbody>
          <actuator><motor joint="hinge"/></actuator>
          <sensor><jointpos joint="hinge" delay="0.03" nsample="5"/></sensor>
        </mujoco>
        """
    )
    assert model.nhistory
    ours, theirs = Physics(model, N, 1), Batch(model, nsim=N, nthread=1, persistent=True)
    ours.ctrl = theirs.ctrl = [[1.0], [2.0], [3.0]]
    ours.bind("sensordata")
    theirs.bind("sensordata")
    for _ in range(5):
        ours.advance()
        theirs.step(nstep=FRAME_SKIP, stage=ACC)
        np.testing.assert_array_equal(ours.sensordata, theirs.sensordata)
    assert (ours.sensordata != 0).all()


def test_sensors_of_bodies_that_fall_asleep_are_up_to_date():
    model = mujoco.MjModel.from_xml_string(
        """
        <mujoco>
          <option timestep="0.004"><flag sleep="enable"/></option>
          <worldbody>
            <geom type="plane" size="1 1 1"/>
            <body name="box" pos="0 0 0.2"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
          </worldbody>
          <sensor><framepos objtype="body" objname="box"/></sensor>
        </mujoco>
        """
    )
    ours, theirs = Physics(model, N, 1), Batch(model, nsim=N, nthread=1, persistent=True)
    for batch in (ours, theirs):
        batch.bind("sensordata")
        batch.forward()
    for _ in range(100):
        ours.advance()
        theirs.step(nstep=FRAME_SKIP, stage=ACC)
        np.testing.assert_array_equal(ours.sensordata, theirs.sensordata)
    assert 0.09 < ours.sensordata[0, 2] < 0.11


PILES = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast" sleep_tolerance="1e-4">
    <flag sleep="enable"/>
  </option>
  <worldbody>
    <geom type="plane" size="2 2 1"/>
    <body pos="-0.5 0 0.1">
      <joint name="push" type="slide" axis="1 0 0" damping="1"/>
      <geom type="box" size="0.1 0.3 0.09" mass="1"/>
    </body>
    <body pos="0 0 0.05"><freejoint/><geom type="box" size="0.05 0.05 0.05" mass="0.1"/></body>
    <body pos="0 0 0.15"><freejoint/><geom type="box" size="0.05 0.05 0.05" mass="0.1"/></body>
    <body pos="0.2 0 0.05"><freejoint/><geom type="box" size="0.05 0.05 0.05" mass="0.1"/></body>
    <body pos="0 0.2 0.3"><freejoint/><geom type="box" size="0.05 0.05 0.05" mass="0.1"/></body>
  </worldbody>
  <actuator><motor joint="push" gear="4"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize("randomized", [pytest.param(False, marks=pytest.mark.slow), True])
def test_sleep_is_restored_bit_for_bit(randomized):
    """Every third physics step: asleep alone, asleep in a pile, and soon to be."""
    model = mujoco.MjModel.from_xml_string(PILES)
    ours, restored, left_alone = (Physics(model, N, 1, frame_skip=3) for _ in range(3))
    batches = (ours, restored, left_alone)
    fields = ("qpos", "qvel", "xpos", "qacc", "cvel", "tree_asleep")
    for batch in batches:
        if randomized:
            batch.expand("opt.gravity")[:, 2] = [-9.81, -9.0, -8.0]
        for name in fields:
            batch.bind(name)
        batch.forward()
    rng, seen, snapshots = np.random.default_rng(0), set(), []
    for step in range(400):
        if step % 40 == 0:
            push = rng.choice([-1.0, 0.0, 1.0], (N, 1))
        seen.update(ours.tree_asleep.ravel().tolist())
        if step % 2 == 0:
            snapshots.append(ours.snapshot())
            restored.restore(snapshots[rng.integers(len(snapshots))])  # others asleep
            restored.restore(snapshots[-1])
        for batch in batches:
            batch.ctrl = push
            batch.advance()
        np.testing.assert_array_equal(ours.state, left_alone.state)
        np.testing.assert_array_equal(ours.state, restored.state)
        for name in fields[2:-1]:
            np.testing.assert_array_equal(ours.bind(name), restored.bind(name), err_msg=name)
        same = [np.where(b.tree_asleep == -1, -2, b.tree_asleep) for b in (ours, restored)]
        np.testing.assert_array_equal(*same)
    assert model.opt.sleep_tolerance == 1e-4
    assert seen >= {*range(-11, -1), 1, 2, 3, 4}, seen


@pytest.mark.parametrize("suite", ["SafetyPointGoal2-v0", "SafetyCarPush2-v0"])
def test_sensors_once_in_a_control_step_while_bodies_sleep(suite):
    ours, theirs = pair(suite)
    assert ours._late
    check_alike(ours, theirs)
    assert (ours.tree_asleep >= 0).any()


@pytest.mark.parametrize(("nsim", "verb"), [(N, "step"), (N, "forward")])
def test_simulations_that_mujoco_gives_up_are_told(monkeypatch, nsim, verb):
    engine = Scenario.parse("Goal_Point_8Hazards").build(nsim)
    engine.reset(np.arange(nsim))

    def fail(self, *args, **kwargs):
        raise SimulationError(np.array([nsim - 1]), "out of memory")

    monkeypatch.setattr(Batch, verb, fail)
    failed = engine.batch.advance()
    assert failed.tolist() == [False] * (nsim - 1) + [True]
    assert nsim == 1 or not engine.batch._copy.opt.disableflags & SENSOR


def test_an_interrupt_leaves_the_sensors_on(monkeypatch):
    ours, theirs = pair("Goal_Point_8Hazards")

    def interrupt(self, *args, **kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Batch, "step", interrupt)
        with pytest.raises(KeyboardInterrupt):
            ours.advance()
    assert not ours._copy.opt.disableflags & SENSOR
    check_alike(ours, theirs)

"""The contract of a part, checked once instead of in every step; and robots that explode.

:func:`check_part` runs a part in a small world of random subsets of rows and staggered resets, as
Stable-Baselines3's ``check_env`` does with an environment. A test of yours calls it::

    check_part(Scenario(task="Leave").build)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from sb3_guard.envs.parameters import PartError

if TYPE_CHECKING:
    from sb3_guard.envs.engine import Engine
    from sb3_guard.envs.outcome import Outcome

ROWS, STEPS = 3, 12


def exploded(engine: Engine, outcome: Outcome, speed: float = 50.0) -> bool:
    """Whether a step ended in a state that no robot is in: diverged, or faster than this, m/s."""
    return bool(outcome.physics_error.any() or np.abs(engine.robot.velocity).max() > speed)


def check_part(make: Callable[[int], Engine], name: str = "a part") -> None:
    """Run a world and see whether its parts keep the contract of :mod:`.part`.

    Rows of a batch must be what lone simulations are, bit for bit; what is read twice must be the
    same; and a restored state must continue as the saved one did.

    :param make: makes an engine with the part and this number of rows
    :param name: what messages call the part
    :raises PartError: what is not so, and what to do
    """
    batch, lone, restored = make(ROWS), make(1), make(ROWS)
    rng = np.random.default_rng(0)
    watched = 1  # the row that is also simulated alone
    for engine, first in ((batch, 0), (lone, watched), (restored, 7)):
        for row in range(engine.num_envs):
            engine.seed(row, np.random.default_rng(first + row))
        engine.reset(np.arange(engine.num_envs))
    size = batch.robot.action_size
    low, high = batch.robot.action_range
    for step in range(STEPS):
        if step % 3 == 2:
            ids = np.flatnonzero(rng.random(ROWS) < 0.5)
            for engine in (batch, restored) if len(ids) else ():
                engine.reset(ids)
            if watched in ids:
                lone.reset(np.zeros(1, dtype=np.int32))
        if step == STEPS // 2:
            restored.restore(batch.state())
        actions = rng.uniform(low, high, (ROWS, size))
        many, one = batch.step(actions), lone.step(actions[[watched]])
        if exploded(batch, many):
            return  # chaos says nothing of the contract; sb3-guard show warns of it
        for what in ("obs", "reward", "cost", "terminated"):
            if not np.array_equal(getattr(many, what)[watched], getattr(one, what)[0]):
                raise PartError(
                    f"{name}: {what} of a row of a batch differs from that of a lone simulation: "
                    "use arithmetic elementwise along N, no matrix products, and draw from rngs[i] "
                    "for row i only"
                )
        if step >= STEPS // 2:
            other = restored.step(actions)
            if not np.array_equal(other.obs, many.obs) or not np.array_equal(
                other.reward + other.cost, many.reward + many.cost
            ):
                raise PartError(
                    f"{name}: a restored state continues differently: take what is kept between "
                    "steps by name, self.sim.array('name'), instead of keeping arrays of your own"
                )
        _check_reading(batch, name)


def _check_reading(engine: Engine, name: str) -> None:
    """Refuse verbs that change what they read.

    :raises PartError: names the part
    """
    before = engine.state()
    first = engine.observe()
    for constraint in engine.constraints:
        constraint.cost()
    engine.task.measure()
    after = engine.state()
    same = np.array_equal(first, engine.observe()) and all(
        np.array_equal(after["arrays"][key], value) for key, value in before["arrays"].items()
    )
    if not same or not np.array_equal(before["batch"], after["batch"]):
        raise PartError(
            f"{name}: observations(), cost() or measure() changes what it reads: change things in "
            "before_step(), reset() or advance()"
        )


def unsteady(engine: Engine) -> str | None:
    """What is wrong with a robot after a second alone, or of random actions: it falls, explodes."""
    return explodes(engine) or _sinks(engine) or explodes(engine, alone=False)


def explodes(engine: Engine, alone: bool = True, speed: float = 50.0) -> str | None:
    """What is wrong with a robot that explodes within a second; None: it does not.

    :param engine: in which episodes begin
    :param alone: whether its actions are the middle of their range; False: they are random
    :param speed: m/s that no robot has
    """
    rng = np.random.default_rng(0)
    low, high = engine.robot.action_range
    shape = engine.num_envs, engine.robot.action_size
    rest = np.broadcast_to((np.asarray(low) + high) / 2, shape)
    for row in range(engine.num_envs):
        engine.seed(row, np.random.default_rng(row))
    engine.reset(np.arange(engine.num_envs))
    for step in range(1, round(1 / engine.control_step) + 1):
        outcome = engine.step(rest if alone else rng.uniform(low, high, shape))
        if exploded(engine, outcome, speed):
            return (
                f"the robot, {'left alone' if alone else 'given random actions'}, explodes within "
                f"{step * engine.control_step:.2g} s: reduce its timestep (now "
                f"{engine.model.opt.timestep:g} s), or choose the integrator implicitfast, or "
                "reduce the stiffness of its joints and the gears, "
                "gains and control ranges of its actuators (of servos in rad, also where a file "
                "has degrees), or move apart geoms that overlap"
            )
        if outcome.terminated[0]:
            break
    return None


def _sinks(engine: Engine) -> str | None:
    """What is wrong with a robot that was left alone and is below the floor now."""
    if engine.robot.position[0, 2] >= -0.1:
        return None
    return (
        "the robot, left alone, falls through the floor within a second: its geoms need contype "
        "and conaffinity of 1, and its class floor=True"
    )

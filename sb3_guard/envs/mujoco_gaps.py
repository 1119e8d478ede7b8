"""Needless once MuJoCo's state holds who is asleep and its Python bindings install no clock.

Two workarounds for MuJoCo 4.0, each with the behaviour that calls for it. Where MuJoCo changes it,
the function and its call in :mod:`sb3_guard.envs.physics` can go.
"""

import ctypes
from pathlib import Path

import mujoco
import numpy as np
from mujoco.batch import Batch

from sb3_guard.envs.types import Array

REST = int(mujoco.mjMINAWAKE)  # physics steps at rest after which a body may fall asleep


def put_to_sleep(batch: Batch, model: mujoco.MjModel | None, state: Array, asleep: Array) -> None:
    """Put to sleep the bodies that were, and restore how long the others have been at rest.

    MuJoCo's state does not hold this, and nothing writes it. So all are woken and physics steps
    taken, each from ``state``, in which bodies count as at rest however fast they are, except
    where a force of -0.0 is applied, which changes no result: MuJoCo compares its bytes with 0.

    :param batch: the simulations
    :param model: what they run on; None: the batch's model, with fields of their own
    :param state: [N, nstate]
    :param asleep: MuJoCo's ``tree_asleep``, [N, trees]: at least 0 is asleep; else the physics
        steps at rest - 11, where -2 means the same as -1: the next at rest is the last awake
    """
    rest = np.where(asleep >= 0, REST, np.minimum(asleep, -2) + REST + 1)
    trees, force = batch.model.body_treeid, batch.bind("xfrc_applied")
    batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
    tolerances = _swap_tolerances(batch, model, np.full(batch.nsim, np.inf))
    try:
        for left in range(REST)[::-1]:
            batch.state[:] = state
            force[(rest <= left)[:, trees] & (trees >= 0)] = -0.0
            batch.step()
    finally:
        _swap_tolerances(batch, model, tolerances)


def _swap_tolerances(batch: Batch, model: mujoco.MjModel | None, new: Array) -> Array:
    """Set the speed, m/s, below which bodies are at rest; return what it was, [N] both."""
    if model is None:
        field = batch.expand("opt.sleep_tolerance")
        old: Array = field.copy()
        field[:] = new
        return old
    old = np.full(batch.nsim, model.opt.sleep_tolerance)
    model.opt.sleep_tolerance = new[0]
    return old


def profiling_clock() -> ctypes.c_void_p | None:
    """Where MuJoCo keeps the clock that its Python bindings install; None if it is not found."""
    for path in Path(mujoco.__file__).parent.glob("*mujoco*"):
        if path.name.startswith(("libmujoco", "mujoco.dll")):
            try:
                return ctypes.c_void_p.in_dll(ctypes.CDLL(str(path)), "mjcb_time")
            except (OSError, ValueError):
                continue
    return None


def silence_profiler() -> None:
    """Remove the profiling clock, which slows short steps by 5 to 44 %.

    Only the timers of MjData lose their values; the simulation is the same.
    """
    clock = profiling_clock()
    if clock is not None:
        clock.value = None

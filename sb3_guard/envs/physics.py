"""The simulations of a world: the one module that makes a :class:`mujoco.batch.Batch`.

It advances them by control steps, evaluates the sensors once in each, and tells which simulations
diverged.
"""

import copy
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from sb3_guard.envs.mujoco_gaps import put_to_sleep, silence_profiler
from sb3_guard.envs.types import Array

FRAME_SKIP = 10
ACC = int(mujoco.mjtStage.mjSTAGE_ACC)  # touch, accelerometer and contacts describe the new state
NONE = int(mujoco.mjtStage.mjSTAGE_NONE)
SENSOR = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
_NEVER = (mujoco.mjtSleepPolicy.mjSLEEP_NEVER, mujoco.mjtSleepPolicy.mjSLEEP_AUTO_NEVER)
# CONTACTFULL, CNSTRFULL, BADQPOS, BADQVEL, BADQACC: the result is not to be trusted
_BAD = slice(int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1)


class Physics(Batch):
    """A persistent :class:`mujoco.batch.Batch` that advances by control steps.

    ``step`` evaluates the sensors in every physics step, which takes up to a sixth of an arm's
    time, though they are read when the control step ends. Here they are switched off until then,
    with the same results bit for bit. The switch is in a copy of the model that the batch runs on,
    or, once simulations have fields of their own, one of these fields. Every physics step evaluates
    the sensors where it could make a difference, because sensors have a history or may fall asleep
    with what they are on, plugins read sensors or nothing is computed at the new state; and for a
    lone simulation, where it gains little.

    :param model: the model
    :param nsim: number of simulations N
    :param nthread: threads that step them
    :param frame_skip: physics steps in a control step
    :param stage: what is computed at the new state when a control step ends, a
        :class:`mujoco.mjtStage`; ``NONE`` leaves positions, velocities and sensors as of the last
        physics step's beginning, as :func:`mujoco.mj_step` does
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        nsim: int,
        nthread: int,
        frame_skip: int = FRAME_SKIP,
        stage: int = ACC,
    ) -> None:
        silence_profiler()
        mujoco.set_mju_user_warning(_ignore_warning)
        super().__init__(model, nsim, nthread, persistent=True)
        self.frame_skip, self.stage = frame_skip, stage
        self._copy: mujoco.MjModel | None = None
        self._usual = int(model.opt.disableflags)
        self._sleeps = bool(model.opt.enableflags & SLEEP)
        self._late = nsim > 1 and stage != NONE and not (model.nhistory or model.nplugin)
        if self._sleeps:
            self._late = self._late and _sensors_stay_awake(model)
            self._asleep = self.bind("tree_asleep")
        if self._late or self._sleeps:
            self._copy = copy.copy(model)
            self.set_models(self._copy)
            self._models = None  # not the caller's: named views write per-simulation fields
        self._warnings = self.warning[:, _BAD, 1]  # live counts since the batch was made
        self._warned = self._warnings.copy()

    def advance(self, before: Callable[[], None] | None = None) -> Array:
        """Advance every simulation by one control step.

        :param before: called before every physics step, to move what moves by itself; None:
            nothing moves within the control step
        :return: which simulations diverged or were given up, [N] bool; they are to be reset
        """
        failed = np.zeros(self.nsim, dtype=bool)
        if self._late:
            self._leave_out(SENSOR)
            try:
                self._steps(failed, before, NONE)
            finally:
                self._leave_out(0)
            _run(self.forward, failed, stage=self.stage)
        else:
            self._steps(failed, before, self.stage)
        changed = self._warnings != self._warned
        if np.count_nonzero(changed):  # MuJoCo has reset these simulations by itself
            failed |= changed.any(axis=1)
            self._warned[:] = self._warnings
        return failed

    def _leave_out(self, bits: int) -> None:
        """Let the simulations leave out these, bits of :class:`mujoco.mjtDisableBit`, too."""
        if self._copy is None:
            self._flags[:] = self._usual | bits
        else:
            self._copy.opt.disableflags = self._usual | bits

    def _steps(self, failed: Array, before: Callable[[], None] | None, stage: int) -> None:
        """The physics steps of a control step, then ``stage`` at the new state."""
        if before is None:
            _run(self.step, failed, nstep=self.frame_skip, stage=stage)
            return
        for left in range(self.frame_skip)[::-1]:
            before()
            _run(self.step, failed, nstep=1, stage=NONE if left else stage)

    def clear(self, ids: Array) -> None:
        """Set simulations ``ids`` to the model's initial state, to be written before :meth:`begin`.

        :param ids: [n]
        """
        self.reset(ids, stage=NONE)

    def begin(self, ids: Array) -> None:
        """Compute everything at the state just written to simulations ``ids``, [n]."""
        self.forward(ids, stage=ACC)
        self._warned[ids] = self._warnings[ids]

    def snapshot(self) -> Array:
        """A copy of ``state`` and, behind it, of who is asleep, to restore from."""
        state: Array = self.state.copy()
        return np.hstack([state, self._asleep]) if self._sleeps else state

    def restore(self, snapshot: Array) -> None:
        """Continue from a :meth:`snapshot`, bit for bit."""
        state = snapshot[:, : self.nstate]
        if self._sleeps:
            put_to_sleep(self, self._copy, state, snapshot[:, self.nstate :])
        self.state[:] = state
        self.forward(stage=ACC)
        self.state[:] = state  # without the solver's warm start of the new computation
        self._warned[:] = self._warnings

    def expand(self, name: str) -> Array:
        self._release()
        values: Array = super().expand(name)
        return values

    def set_const(self, ids: Any = None) -> None:
        self._release()
        super().set_const(ids)

    def _release(self) -> None:
        """Run on the batch's own model again: only its fields can differ between simulations."""
        if self._copy is not None:
            self.set_models(None)
            self._copy = None
            if self._late:
                self._flags = super().expand("opt.disableflags")

    def scale(self, field: str, rows: Array, ids: Array, factors: Array) -> None:
        """Give simulations multiples of what the model has.

        :param field: of the model
        :param rows: of the field, [R]
        :param ids: simulations, [n]
        :param factors: [n]
        """
        usual = getattr(self.model, field)[rows]  # [R, ...]
        shape = (-1, *[1] * usual.ndim)
        self.expand(field)[np.ix_(ids, rows)] = factors.reshape(shape) * usual


def _run(call: Callable[..., None], failed: Array, **arguments: int) -> None:
    """Call the batch; mark the simulations, [N] bool, that MuJoCo gives up."""
    try:
        call(**arguments)
    except SimulationError as error:
        failed[error.ids] = True


def _sensors_stay_awake(model: mujoco.MjModel) -> bool:
    """Whether every sensor is on a body that never sleeps, or relates something to one."""
    never = np.append(np.isin(model.tree_sleep_policy, _NEVER), False)  # the last: no tree
    bodies = {
        mujoco.mjtObj.mjOBJ_BODY: np.arange(model.nbody),
        mujoco.mjtObj.mjOBJ_XBODY: np.arange(model.nbody),
        mujoco.mjtObj.mjOBJ_JOINT: model.jnt_bodyid,
        mujoco.mjtObj.mjOBJ_GEOM: model.geom_bodyid,
        mujoco.mjtObj.mjOBJ_SITE: model.site_bodyid,
    }
    awake = np.zeros(model.nsensor, dtype=bool)
    for kinds, ids in (
        (model.sensor_objtype, model.sensor_objid),
        (model.sensor_reftype, model.sensor_refid),
    ):
        for kind, body in bodies.items():
            on = kinds == kind
            awake[on] |= never[model.body_treeid[body[ids[on]]]]
    return bool(awake.all())


def _ignore_warning(message: str) -> None:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT: the warning counters are read instead."""

"""The simulations of a world, whose sensors are evaluated once in a control step."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

Array = np.ndarray
SENSOR = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)


class ControlBatch(Batch):
    """A persistent :class:`mujoco.batch.Batch` that advances by control steps.

    ``step`` evaluates the sensors in every physics step, which takes up to a sixth of an arm's
    time, though they are read when the control step ends. Here they are switched off until then,
    with the same results bit for bit. The switch is in a copy of the model that the batch runs on.
    Every physics step evaluates the sensors where that copy cannot be, because someone gives
    simulations fields or models of their own; where it could make a difference, because sensors
    have a history, bodies sleep or plugins read sensors; and for a lone simulation, where it gains
    little. A physics callback in C (``mjcb_control``) reads them as of the last control step.

    :param model: the model
    :param nsim: number of simulations N
    :param nthread: threads that step them
    """

    def __init__(self, model: mujoco.MjModel, nsim: int, nthread: int) -> None:
        super().__init__(model, nsim, nthread, persistent=True)
        self._switched: mujoco.MjModel | None = None
        sleep = model.opt.enableflags & SLEEP
        if nsim > 1 and not (model.nhistory or model.nplugin or sleep):
            self._switched = copy.copy(model)
            super().set_models(self._switched)
            self._models = None  # not the caller's: named views write per-simulation fields

    def advance(self, nstep: int, stage: int) -> Array:
        """Advance every simulation by ``nstep`` physics steps, then compute stages.

        :param nstep: number of physics steps
        :param stage: the stages to compute at the new state, a :class:`mujoco.mjtStage`
        :return: which simulations MuJoCo gave up, [N] bool; they are to be reset
        """
        failed = np.zeros(self.nsim, dtype=bool)
        if self._switched is None:
            _run(self.step, failed, nstep=nstep, stage=stage)
            return failed
        option = self._switched.opt
        flags = option.disableflags
        option.disableflags = flags | SENSOR
        try:
            _run(self.step, failed, nstep=nstep)
        finally:
            option.disableflags = flags
        _run(self.forward, failed, stage=stage)
        return failed

    def expand(self, name: str) -> Array:
        self._release()
        values: Array = super().expand(name)
        return values

    def set_const(self, ids: Any = None) -> None:
        self._release()
        super().set_const(ids)

    def set_models(self, models: mujoco.MjModel | Sequence[mujoco.MjModel] | None) -> None:
        super().set_models(models)
        self._switched = None  # not before: the batch reads it as long as the call may fail

    def _release(self) -> None:
        """Run on the batch's own model again: only its fields can differ between simulations."""
        if self._switched is not None:
            self.set_models(None)


def _run(call: Callable[..., None], failed: Array, **arguments: int) -> None:
    """Call the batch; mark the simulations, [N] bool, that MuJoCo gives up."""
    try:
        call(**arguments)
    except SimulationError as error:
        failed[error.ids] = True

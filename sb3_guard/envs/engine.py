"""The engine: a robot, a task and constraints become N running simulations.

One compiled world, one :class:`~sb3_guard.envs.physics.Physics`; every control step advances all
rows on its threads. The engine draws layouts, keeps the clock, the random generators and the arrays
of the parts, and hands out what one control step brought. It knows no automatic reset and no time
limit: those belong to the gymnasium classes above it.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from numpy.typing import DTypeLike

from sb3_guard.envs.arena import Arena
from sb3_guard.envs.drawn import Drawn
from sb3_guard.envs.extras import Extras
from sb3_guard.envs.layout import Footprint, Layout, LayoutError
from sb3_guard.envs.motion import Motion
from sb3_guard.envs.observation import Channel, Lidar
from sb3_guard.envs.observer import Observer
from sb3_guard.envs.outcome import Outcome
from sb3_guard.envs.parameters import PartError
from sb3_guard.envs.part import Constraint, Part, Robot, Task
from sb3_guard.envs.physics import Physics
from sb3_guard.envs.placing import Placing
from sb3_guard.envs.types import Array
from sb3_guard.errors import NumberError
from sb3_guard.fields import did_you_mean, fit

CLEAN_STARTS = 100  # layouts drawn before a start with a cost is an error


class Engine:
    """N simulations of one world.

    :param robot: the robot
    :param task: the task
    :param constraints: the constraints, at most one of each type
    :param num_envs: number of simulations N
    :param num_threads: threads that step them; by default one per CPU, at most N
    :param lidar: settings of the pseudo-lidar
    :param layout: options of the layout
    :param extras: what else is observed
    :param arena: where everything happens
    :param cost: ``"sum"`` of the constraints' costs, or ``"any"``: 1 if there is one, else 0, also
        of each constraint
    :raises ValueError: parts that do not go together
    """

    def __init__(
        self,
        robot: Robot,
        task: Task,
        constraints: Sequence[Constraint] = (),
        num_envs: int = 1,
        num_threads: int | None = None,
        lidar: Lidar | None = None,
        layout: Layout | None = None,
        extras: Extras | None = None,
        arena: Arena | None = None,
        cost: str = "sum",
    ) -> None:
        fit("num_envs", num_envs, int, 1, 10**6, "[]")
        if num_threads is not None:
            fit("num_threads", num_threads, int, 1, ends="[)")
        self.robot, self.task, self.constraints = robot, task, tuple(constraints)
        self.extras, self.arena = extras or Extras(), arena or Arena()
        self.parts: tuple[Part, ...] = (
            robot, self.arena, task, *self.constraints, self.extras
        )  # fmt: skip
        self._any = cost == "any"
        self.num_envs = int(num_envs)
        self.num_threads = min(num_threads or _cpus(), self.num_envs)
        self._arrays: dict[str, Array] = {}
        self._build()

        self._process: int | None = os.getpid()  # whose threads step it; None: closed
        self.rngs = [np.random.default_rng() for _ in range(self.num_envs)]
        self.steps = self.array("steps", dtype=np.int64)
        self.steps[:] = -1  # no episode has begun
        self._begun = False
        layout = layout or Layout()
        self.placing = Placing(self.parts, layout, self.arena.placements, self.array)
        self.footprints: dict[str, Footprint] = self.placing.footprints
        self._bind(lidar or Lidar())

    def _build(self) -> None:
        """Compile the world that the parts build."""
        names = [part.name for part in self.parts]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two parts are called {name!r}; give one of them another name")
        world = self.arena.world(self.robot)
        for part in self.parts:
            part.build(world)
        self.drawn = Drawn(self.parts, world, self, self.extras.drawn)
        self.spec = world.spec  # its to_xml() is the world as MJCF
        self.model = self.spec.compile()
        frame_skip = self.arena.frame_skip or self.robot.frame_skip
        fit("frame_skip", frame_skip, int, 1, 1000, "[]")
        self.control_step = frame_skip * float(self.model.opt.timestep)
        self.batch = Physics(
            self.model, self.num_envs, self.num_threads, frame_skip, int(self.robot.stage)
        )

    def _bind(self, lidar: Lidar) -> None:
        """Give the parts their views, and look at what they move, observe and measure."""
        for part in self.parts:
            part.bind(self)
        self.drawn.bind(self.model)
        # a part that does not define a verb is not asked
        movers, acting, self._enders = (
            [p for p in self.parts if getattr(type(p), verb) is not getattr(Part, verb)]
            for verb in ("moving", "before_step", "terminated")
        )
        self._motion = Motion(movers)
        self.observer = Observer(self.robot, self.parts, lidar, self.extras.components)
        # of each named component, in the order of the flat observation: where it lies; its size,
        # bounds and unit
        self.observation_layout: dict[str, slice] = self.observer.slices
        self.channels: dict[str, Channel] = self.observer.channels
        # what moves before every physics step instead of before a control step
        self._quick = [part for part in acting if part.every == "physics"]
        self._slow = [part for part in acting if part.every != "physics"]
        self._before = self.array("before", np.shape(self.task.measure())[1:])

    def array(self, name: str, shape: tuple[int, ...] = (), dtype: Any = float) -> Array:
        """The array ``name``, ``[N, *shape]``, zero when first asked for; part of the state."""
        if name not in self._arrays:
            self._arrays[name] = np.zeros((self.num_envs, *shape), dtype=dtype)
        return self._arrays[name]

    def sensor(self, name: str) -> Array:
        """Live values of a sensor, [N, d]; the robot's file's are called ``"robot/..."``.

        :raises ValueError: there is no such sensor, with the nearest match
        """
        known = [self.model.sensor(i).name for i in range(self.model.nsensor)]
        if name not in known:
            hint = did_you_mean(name, [n for n in known if n])
            raise ValueError(f"the world has no sensor {name!r}: {hint}")
        sensor = self.model.sensor(name)
        first = int(sensor.adr[0])
        return self.batch.bind("sensordata")[:, first : first + int(sensor.dim[0])]

    def places(self, name: str) -> Array:
        """The live places of footprint ``name``, [N, num, 3] m."""
        return self.placing.places[name]

    def redraw(self, name: str, row: int) -> bool:
        """Draw the first object of footprint ``name`` again in one row; whether it found room."""
        return self.placing.redraw(name, row, self.rngs[row])

    def observe(self, dtype: DTypeLike = np.float32) -> Array:
        """The flat observation of every row, [N, D], a new array; float64 before the cast."""
        return self.observer.observe(dtype)

    def seed(self, row: int, rng: np.random.Generator) -> None:
        """Give one row its generator; its layouts and its movers draw from nothing else."""
        self.rngs[row] = rng
        self.placing.forget(row)

    def reset(self, ids: Array) -> None:
        """Begin an episode in rows ``ids``, sorted, with no cost and no goal reached at the start.

        :raises LayoutError: a part finds no room, or no start is without a cost
        """
        self._check_open()
        ids = np.asarray(ids, dtype=np.int32)
        self.steps[ids] = 0
        if self.drawn.ranges:
            self.drawn.draw(ids)
            self.placing.forget(ids)  # layouts that are kept may be of another number of objects
        pending = ids
        refusals: dict[str, None] = {}  # reasons of starts that are not used
        for _ in range(CLEAN_STARTS):
            self._start(pending)
            faults = self._faults()
            pending = pending[np.logical_or.reduce(list(faults.values()))[pending]]
            if not len(pending):
                break
            refusals |= dict.fromkeys(why for why, rows in faults.items() if rows[pending].any())
        else:
            raise LayoutError(
                f"none of {CLEAN_STARTS} layouts lets an episode begin clean "
                f"({'; '.join(refusals)}): make size or num smaller, limits wider, keepout or "
                "placements larger, or state where the robot begins"
            )
        self._before[ids] = self.task.measure()[ids]
        self._begun = self._begun or bool((self.steps >= 0).all())

    def _start(self, ids: Array) -> None:
        """Draw a layout for rows ``ids``, [n], and put everything there."""
        self.batch.clear(ids)
        for row in ids.tolist():
            self.placing.draw(row, self.rngs[row])
        for part in self.parts:
            part.reset(ids, self.rngs)
        self.batch.begin(ids)

    def _faults(self) -> dict[str, Array]:
        """Why no episode is to begin as everything is now, and rows [N] bool."""
        task, n = self.task, self.num_envs
        invalid = per_row(task, "invalid_start()", task.invalid_start(), n, bool)
        faults = {f"{_sized(task)}: {task.invalid_reason}": invalid}
        for c in self.constraints:
            pays = per_row(c, "cost()", c.cost(), n) > 0
            faults[f"{_sized(c)}: a cost at the start"] = pays
        for p in self._enders:
            ends = per_row(p, "terminated()", p.terminated(), n, bool)
            faults[f"{_sized(p)}: it ends the episode immediately"] = ends
        return faults

    def step(self, actions: Array) -> Outcome:
        """Advance every row by one control step.

        :param actions: [N, action_size]; values outside the robot's ``action_range``, by default
            [−1, 1], are clipped
        :raises ValueError: actions of the wrong shape or not finite
        :raises gymnasium.error.ResetNeeded: no episode has begun
        """
        self._check_open()
        if not self._begun:
            raise ResetNeeded("call reset() before step()")
        actions = self._check_actions(actions)
        self._motion.advance(self.robot.position)  # from the positions last observed
        for part in self._slow:
            part.before_step()
        low, high = self.robot.action_range
        self.robot.act(np.minimum(np.maximum(actions, low), high))
        diverged = self.batch.advance(self._before_physics if self._quick else None)
        self.steps += 1

        task, n = self.task, self.num_envs
        now = task.measure()
        reward = self._reward(now)
        costs = {
            f"cost_{name}": per_row(c, "cost()", cost, n)
            for c in self.constraints
            for name, cost in c.costs().items()
        }
        met = per_row(task, "succeeded()", task.succeeded(now), n, bool)
        if np.count_nonzero(diverged):  # any() takes three times as long
            met &= ~diverged
            reward[diverged] = 0.0
            for cost in costs.values():
                cost[diverged] = 0.0
        total = self._total(costs)
        terminated = diverged.copy()
        unplaced = np.zeros(n, dtype=bool)
        self._before[:] = now
        if np.count_nonzero(met):
            reward[met] += task.bonus
            if task.ends:
                terminated |= met
            else:
                ids = np.flatnonzero(met)
                unplaced[task.advance(ids)] = True
                self._before[ids] = task.measure()[ids]
        ended_by = {}
        for part in self._enders:
            ended = per_row(part, "terminated()", part.terminated(), n, bool) & ~diverged
            if np.count_nonzero(ended):
                ended_by[part.name] = ended & ~terminated
                terminated |= ended
        return Outcome(
            self.observe(), reward, costs, total, met, terminated, unplaced, diverged, ended_by,
            self.drawn.info(),
        )  # fmt: skip

    def close(self) -> None:
        """Refuse any further step or reset."""
        self._process = None

    def _check_open(self) -> None:
        """
        :raises gymnasium.error.ClosedEnvironmentError: it was closed
        :raises RuntimeError: it came here by ``os.fork``, without the threads that step it
        """
        if self._process is None:
            raise ClosedEnvironmentError("the environment was closed: make another one")
        if self.num_threads > 1 and self._process != os.getpid():
            raise RuntimeError(
                "the environment was made before this process was forked, and the threads that "
                "step it are not here: make it in this process, or with num_threads=1"
            )

    def _before_physics(self) -> None:
        for part in self._quick:
            part.before_step()

    def _check_actions(self, actions: Array) -> Array:
        """The actions, [N, action_size].

        :raises ValueError: they have another shape
        :raises NumberError: they are not finite
        """
        actions = np.asarray(actions, dtype=float)
        shape = (self.num_envs, self.robot.action_size)
        if actions.shape != shape:
            raise ValueError(f"actions have shape {actions.shape}, expected {shape}")
        if np.count_nonzero(np.isfinite(actions)) < actions.size:  # all() takes longer
            rows = np.flatnonzero(~np.isfinite(actions).all(axis=1)).tolist()
            raise NumberError(
                f"actions of rows {rows} are not finite: {actions[rows[0]].tolist()}; allowed: "
                "numbers, which are clipped to the action space"
            )
        return actions

    def _reward(self, now: Array) -> Array:
        """The dense reward of a step after which the task measures ``now``, [N]."""
        task = self.task
        reward = per_row(task, "reward()", task.reward(self._before, now), self.num_envs)
        limit = task.reward_limit
        return reward if limit is None else np.minimum(np.maximum(reward, -limit), limit)

    def _total(self, costs: dict[str, Array]) -> Array:
        """The sum of the costs, or whether there are any, [N] each.

        :raises PartError: one is negative or not a number
        """
        total = np.zeros(self.num_envs)
        for name, cost in costs.items():
            if np.count_nonzero(cost >= 0.0) < self.num_envs:
                raise PartError(
                    f"{name} is {cost[~(cost >= 0.0)][0]}: a cost must be at least 0; "
                    "benefits belong in the task's reward"
                )
            if self._any:
                costs[name] = cost = (cost > 0).astype(float)
            total += cost
        return np.minimum(total, 1.0) if self._any else total

    def state(self) -> dict[str, Any]:
        """Everything that the coming steps depend on, as plain arrays and mappings."""
        return {
            "batch": self.batch.snapshot(),
            "arrays": {name: a.copy() for name, a in self._arrays.items()},
            "rngs": [rng.bit_generator.state for rng in self.rngs],
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state`, bit for bit, whatever the number of threads.

        :raises ValueError: the state belongs to another world or another number of rows
        """
        theirs = {"physics": state["batch"].shape}
        theirs |= {name: array.shape for name, array in state["arrays"].items()}
        own = {"physics": self.batch.snapshot().shape}
        own |= {name: array.shape for name, array in self._arrays.items()}
        if theirs != own:
            raise ValueError(f"the state has arrays {theirs}; those of this engine are {own}")
        for name, value in state["arrays"].items():
            self._arrays[name][:] = value
        self.rngs = [_generator(s) for s in state["rngs"]]
        self.drawn.apply(np.arange(self.num_envs))
        self.batch.restore(state["batch"])
        self._begun = bool((self.steps >= 0).all())


def per_row(part: Part, verb: str, value: Any, rows: int, dtype: type = float) -> Array:
    """What a verb of a part gave, [N], a copy: the part may keep and change its own.

    :raises PartError: it has another shape, in which it would be broadcast
    """
    out: Array = np.array(value, dtype=dtype)
    if out.shape != (rows,):
        raise PartError(
            f"{verb} of {part.name} has shape {out.shape}, expected ({rows},): one row for each "
            "simulation of the batch"
        )
    return out


def _sized(part: Part) -> str:
    """What messages call a part whose size may be at fault."""
    return f"{part.name}.size = {part.size}" if hasattr(part, "size") else part.name


def _generator(state: Mapping[str, Any]) -> np.random.Generator:
    """A generator that continues from a saved state."""
    bits = getattr(np.random, state["bit_generator"])()
    bits.state = state
    return np.random.Generator(bits)


def _cpus() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

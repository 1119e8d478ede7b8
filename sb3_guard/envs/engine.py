"""The engine: a robot, a task and constraints become N running simulations.

One compiled world, one :class:`~sb3_guard.envs.batch.ControlBatch`; every control step advances all
rows by ten physics steps on the batch's threads. The engine draws layouts, keeps the clock, the
random generators and the arrays of the parts, and hands out what one control step brought. It knows
no automatic reset and no time limit: those belong to the gymnasium classes above it.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from gymnasium.error import ResetNeeded

from sb3_guard.envs.batch import ControlBatch
from sb3_guard.envs.extras import Extras
from sb3_guard.envs.layout import (
    ARENA,
    Footprint,
    LayoutError,
    Rectangle,
    arrange,
    check_locations,
    farthest,
    redraw,
)
from sb3_guard.envs.motion import Fleet, Law, Moving, fleets
from sb3_guard.envs.parameters import Parameters, check_count, param
from sb3_guard.envs.part import FLOOR, Array, Constraint, Part, Robot, Task
from sb3_guard.envs.sensors import Channel, Compass, Lidar, Lookout, Scan

FRAME_SKIP = 10
STAGE = int(mujoco.mjtStage.mjSTAGE_ACC)  # touch, accelerometer and contacts describe the new state
CLEAN_STARTS = 100  # layouts drawn before a start with a cost is an error
REWARD_LIMIT = 10.0

# CONTACTFULL, CNSTRFULL, BADQPOS, BADQVEL, BADQACC: the result is not to be trusted
_BAD = slice(int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_BADQACC) + 1)


@dataclass(frozen=True)
class Layout(Parameters):
    """Options of the world that belong to no part."""

    name = "layout"

    placements: tuple[Rectangle, ...] = param(
        ARENA,
        "rectangles (x low, y low, x high, y high) that parts without their own are drawn in, m",
    )
    margin: float = param(0.0, "extra distance between any two objects, m", low=0)
    randomize: bool = param(True, "false: every episode of a row begins and goes on alike")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.placements:
            raise ValueError(
                "layout.placements = () must hold at least one rectangle, [x low, y low, x high, "
                "y high] in m; leave it out for the arena, [[-2, -2, 2, 2]]"
            )


@dataclass
class WorldSpec:
    """The world under construction: floor, light, cameras and what the parts add."""

    robot: Robot
    spec: mujoco.MjSpec = field(default_factory=mujoco.MjSpec)

    def __post_init__(self) -> None:
        spec = self.spec
        spec.modelname = "sb3_guard"
        option = spec.option
        option.timestep = self.robot.timestep  # attach() keeps the parent's options
        option.gravity = [0, 0, -9.81]
        option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        spec.visual.global_.offwidth = 1920
        spec.visual.global_.offheight = 1440
        spec.visual.headlight.ambient = [0.3, 0.3, 0.3]
        spec.visual.headlight.diffuse = [0.4, 0.4, 0.4]
        spec.visual.map.znear = 0.005
        spec.stat.center = [0, 0, 0.3]
        spec.stat.extent = 3.0
        spec.add_texture(
            name="sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=[0.72, 0.82, 0.93],
            rgb2=[0.95, 0.97, 1.0],
            width=64,
            height=64,
        )
        spec.add_texture(
            name="floor",
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
            rgb1=[0.86, 0.87, 0.88],
            rgb2=[0.80, 0.82, 0.84],
            width=256,
            height=256,
        )
        material = spec.add_material(name="floor", texrepeat=[1, 1], texuniform=True)
        textures = [""] * int(mujoco.mjtTextureRole.mjNTEXROLE)
        textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
        material.textures = textures
        world = spec.worldbody
        # margin 0: MuJoCo 4 adds the margins of the two geoms
        world.add_geom(
            name="floor",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 1],
            contype=FLOOR,
            conaffinity=FLOOR,
            condim=3,
            material="floor",
        )
        world.add_light(
            pos=[1.5, -1.5, 5],
            dir=[-0.25, 0.25, -1],
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            castshadow=False,  # zones and halos would throw shadows too
            diffuse=[0.5, 0.5, 0.5],
            specular=[0.1, 0.1, 0.1],
        )
        world.add_camera(name="fixed", pos=[0, -5.0, 4.6], xyaxes=[1, 0, 0, 0, 0.66, 0.75], fovy=45)
        world.add_camera(name="top", pos=[0, 0, 6.5], xyaxes=[1, 0, 0, 0, 1, 0], fovy=45)

    def feel(self, name: str, body: str) -> None:
        """Count contacts between any part of the robot and ``body``; 0 if there are none.

        :param name: name of the sensor
        :param body: name of a body in the world
        """
        self.spec.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_XBODY,  # in contact sensors: the body's whole subtree
            objname=self.robot.root,
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname=body,
            intprm=[1, 0, 1],  # found, no reduction, one slot
        )


@dataclass
class Outcome:
    """What one control step brought to each row.

    :param obs: observation, [N, D] float32
    :param reward: [N]
    :param costs: cost per constraint type, [N] each, under the names of their info keys
    :param cost: the sum of the costs, [N]
    :param goal_met: whether the goal was reached in this step, [N] bool
    :param terminated: the task ended the episode or the physics diverged, [N] bool
    :param unplaced: no room was left for the next goal: the episode is to be cut, [N] bool
    :param physics_error: the physics diverged, [N] bool
    """

    obs: Array
    reward: Array
    costs: dict[str, Array]
    cost: Array
    goal_met: Array
    terminated: Array
    unplaced: Array
    physics_error: Array


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
    ) -> None:
        check_count("num_envs", num_envs)
        if num_threads is not None:
            check_count("num_threads", num_threads)
        self.robot, self.task, self.constraints = robot, task, tuple(constraints)
        self.extras = extras or Extras()
        self.parts: tuple[Part, ...] = (robot, task, *self.constraints, self.extras)
        self.num_envs = int(num_envs)
        self.num_threads = min(num_threads or _cpus(), self.num_envs)
        self._lookout = Lookout(lidar or Lidar(), robot.workspace == "planar")
        self._layout = layout or Layout()

        names = [part.name for part in self.parts]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two parts are called {name!r}; give one of them another name")
        world = WorldSpec(robot)
        for part in self.parts:
            part.build(world)
        self.model = world.spec.compile()
        _silence_profiler()
        mujoco.set_mju_user_warning(_ignore_warning)
        self.batch = ControlBatch(self.model, self.num_envs, self.num_threads)

        self.rngs = [np.random.default_rng() for _ in range(self.num_envs)]
        self._arrays: dict[str, Array] = {}
        self.steps = self.array("steps", dtype=np.int64)
        self.steps[:] = -1  # no episode has begun
        self._begun = False
        self.footprints: dict[str, Footprint] = {}
        self._owners: dict[str, Part] = {}
        for part in self.parts:
            for f in part.footprints():
                if f.name in self.footprints:
                    raise ValueError(
                        f"{part.name} and {self._owners[f.name].name} both place {f.name!r}; "
                        "give the constraint another name"
                    )
                self.footprints[f.name] = replace(
                    f,
                    placements=f.placements or self._layout.placements,
                    margin=max(f.margin, self._layout.margin),
                )
                self._owners[f.name] = part
                self.array(f"places/{f.name}", (f.num, 3))
        check_locations(list(self.footprints.values()))
        # where the generators begin every episode of rows whose layout is not to change
        self._origins: dict[int, Any] = {}
        for part in self.parts:
            part.bind(self)
        self._moving: list[Moving] = []
        self._fleets: list[Fleet] = []
        for part in self.parts:
            self._check_moving(part)
        self._channels: dict[str, Channel] = {}
        for part in self.parts:
            self._check_sights(part)
            for name, channel in self.channels_of(part).items():
                if not isinstance(channel, Channel):
                    raise ValueError(
                        f"channels() of {part.name} gives {name!r} as {channel!r}: it must be a "
                        "Channel, such as Channel(1, low=0.0, high=1.0, unit='m')"
                    )
                if name in self._channels:
                    raise ValueError(
                        f"{part.name} and another part both observe {name!r}; give the constraint, "
                        "or the robot's sensor, another name"
                    )
                self._channels[name] = channel
        self._slices: dict[str, slice] = {}
        start = 0
        for name in sorted(self._channels):
            size = self._channels[name].size
            self._slices[name] = slice(start, start + size)
            start += size
        self.observation_size = start
        self._observed = False  # whether the parts' observations have been found to be in order
        measure = np.shape(task.measure())
        if measure[:1] != (self.num_envs,):
            raise ValueError(_misshapen(task, "measure()", measure, (self.num_envs, "M")))
        self._before = self.array("before", measure[1:])
        self._warnings = self.batch.warning[:, _BAD, 1]  # live counts since the batch was made
        self._warned = self._warnings.copy()

    def array(self, name: str, shape: tuple[int, ...] = (), dtype: Any = float) -> Array:
        """The array ``name``, ``[N, *shape]``, zero when first asked for; part of the state."""
        if name not in self._arrays:
            self._arrays[name] = np.zeros((self.num_envs, *shape), dtype=dtype)
        return self._arrays[name]

    def places(self, name: str) -> Array:
        """The live places of footprint ``name``, [N, num, 3] m."""
        return self._arrays[f"places/{name}"]

    def farthest(self, one: str, other: str) -> float:
        """Greatest distance in the plane at which two footprints may begin, m."""
        return farthest(self.footprints[one], self.footprints[other])

    def redraw(self, name: str, row: int) -> bool:
        """Draw the first object of footprint ``name`` anew in one row.

        It keeps clear of where everything is now; movers are ignored if there is no room otherwise.

        :return: whether a place was found
        """
        others = {
            f: self._owners[f.name].positions(f.name)[row]
            for f in self.footprints.values()
            if f.name != name
        }
        place = redraw(self.footprints[name], others, self.rngs[row])
        if place is not None:
            self.places(name)[row, 0] = place
        return place is not None

    def channels_of(self, part: Part) -> dict[str, Channel]:
        """Size, bounds and unit of what one part lets the robot observe, by name."""
        bodies = self.robot.frames[0].shape[1]
        seen = {n: self._lookout.channel(s, bodies) for n, s in part.sights().items()}
        return {**seen, **part.channels()}

    def halos(self, row: int) -> list[tuple[Array, int, tuple[float, float, float]]]:
        """Every lidar of a row: closeness [bodies · bins], bins around, and color."""
        sights = {n: (s, part) for part in self.parts for n, s in part.sights().items()}
        seen = self._lookout.look({n: s for n, (s, _) in sights.items()}, *self.robot.frames)
        return [
            (
                seen[name][row],
                self._lookout.azimuth(sight),
                part.color if sight.color is None else sight.color,
            )
            for name, (sight, part) in sights.items()
            if isinstance(sight, Scan)
        ]

    @property
    def observation_layout(self) -> dict[str, slice]:
        """Where each named component lies in the flat observation, in alphabetical order."""
        return dict(self._slices)

    @property
    def channels(self) -> dict[str, Channel]:
        """Size, bounds and unit of each named component, in alphabetical order."""
        return {name: self._channels[name] for name in self._slices}

    def seed(self, row: int, rng: np.random.Generator) -> None:
        """Give one row its generator; its layouts and its movers draw from nothing else."""
        self.rngs[row] = rng
        self._origins.pop(row, None)

    def reset(self, ids: Array) -> None:
        """Begin an episode in rows ``ids``, sorted, with no cost and no goal reached at the start.

        :raises LayoutError: a part finds no room, or no start is without a cost
        """
        ids = np.asarray(ids, dtype=np.int32)
        self.steps[ids] = 0
        footprints = list(self.footprints.values())
        if not self._layout.randomize:
            for row in ids.tolist():
                bits = self.rngs[row].bit_generator
                bits.state = self._origins.setdefault(row, bits.state)
        pending = ids
        spoilt = np.zeros(1 + len(self.constraints), dtype=int)  # starts, by who spoilt them
        for _ in range(CLEAN_STARTS):
            self.batch.reset(pending, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
            for row in pending.tolist():
                for name, places in arrange(footprints, self.rngs[row]).items():
                    self.places(name)[row] = places
            for part in self.parts:
                part.reset(pending, self.rngs)
            self.batch.forward(pending, stage=STAGE)
            blemishes: Array = np.array(
                [
                    self._per_row(self.task, "blemished()", self.task.blemished(), bool),
                    *(self._per_row(c, "cost()", c.cost()) > 0 for c in self.constraints),
                ]
            )  # [parts, N]
            pending = pending[np.logical_or.reduce(blemishes)[pending]]
            if not len(pending):
                break
            spoilt += blemishes[:, pending].sum(axis=1)
        else:
            reasons = [f"{self.task.name}: {self.task.spoils}"]
            reasons += [f"{c.name}: the robot pays for them at once" for c in self.constraints]
            found = "; ".join(reasons[i] for i in np.argsort(-spoilt).tolist() if spoilt[i])
            raise LayoutError(
                f"none of {CLEAN_STARTS} layouts lets an episode begin clean ({found}): make size "
                "or num smaller, or keepout or placements larger"
            )
        self._before[ids] = self.task.measure()[ids]
        self._warned[ids] = self._warnings[ids]
        self._begun = self._begun or bool((self.steps >= 0).all())

    def observe(self) -> Array:
        """The flat observation of every row, [N, D] float32, a new array."""
        sights: dict[str, Scan | Compass] = {}
        seen: dict[str, Array] = {}
        for part in self.parts:
            sights.update(part.sights())
            seen.update(part.observe() if self._observed else self._checked_observation(part))
        self._observed = True
        try:
            seen.update(self._lookout.look(sights, *self.robot.frames))
        except Exception:
            for part in self.parts:  # whose fault is it?
                self._check_sights(part)
            raise
        if seen.keys() != self._channels.keys():
            odd = ", ".join(map(repr, sorted(seen.keys() ^ self._channels.keys())))
            raise ValueError(
                f"sights() and observe() must always name the same ones; {odd} came or went: for "
                "what does not show, give a Scan that is not lit, or zeros"
            )
        obs = np.concatenate([seen[name] for name in self._slices], axis=1, dtype=np.float32)
        if obs.shape[1] != self.observation_size:
            widths = {name: (c.size, np.shape(seen[name])[1]) for name, c in self._channels.items()}
            name = next(n for n, (size, width) in widths.items() if size != width)
            raise ValueError(
                f"{name!r} of the observation has {widths[name][1]} columns; its channel has "
                f"{widths[name][0]}"
            )
        return obs

    def _check_sights(self, part: Part) -> None:
        """Refuse sights that are none.

        :raises ValueError: names the sight and what it must be
        """
        if not isinstance(part.sights(), Mapping):
            raise ValueError(
                f"sights() of {part.name} gives {part.sights()!r}: it must be a mapping of "
                "names to Scan or Compass, {} for none"
            )
        for name in part.sights().keys() & part.channels().keys():
            raise ValueError(
                f"{part.name} has {name!r} in sights() and in channels(): what is seen has its "
                "channel already, leave it out there"
            )
        for name, sight in part.sights().items():
            if not isinstance(sight, (Scan, Compass)):
                raise ValueError(
                    f"sights() of {part.name} gives {name!r} as {sight!r}: it must be a Scan of "
                    "points [N, K, 3] or a Compass to a point [N, 3]"
                )
            verb, points = f"sights()[{name!r}]", sight[0]
            if not isinstance(points, np.ndarray):
                raise ValueError(f"{verb} of {part.name} has {points!r}: it must have an array")
            rest = ("K", 3) if isinstance(sight, Scan) else (3,)
            shape = points.shape
            if len(shape) != 1 + len(rest) or (shape[0], shape[-1]) != (self.num_envs, 3):
                raise ValueError(_misshapen(part, verb, shape, (self.num_envs, *rest)))
            if self._begun and not np.isfinite(points.astype(float)).all():
                raise ValueError(f"points of {verb} of {part.name} are not finite")
            lit = sight.lit if isinstance(sight, Scan) else None
            if lit is not None and np.shape(lit) != (self.num_envs,):
                shape = np.shape(lit)
                raise ValueError(_misshapen(part, f"lit of {verb}", shape, (self.num_envs,)))

    def _check_moving(self, part: Part) -> None:
        """Refuse movers that are none.

        :raises ValueError: names the part and what it must give
        """
        moving = part.moving()
        for group in moving if isinstance(moving, tuple | list) else (moving,):
            if not (
                isinstance(group, Moving)
                and isinstance(group.points, np.ndarray)
                and isinstance(group.law, Law)
            ):
                raise ValueError(
                    f"moving() of {part.name} gives {group!r}: it must be a tuple of "
                    "Moving(points, law, planar), of an array [N, K, 3] and a Law"
                )
            shape = group.points.shape
            if len(shape) != 3 or (shape[0], shape[2]) != (self.num_envs, 3):
                raise ValueError(_misshapen(part, "moving()", shape, (self.num_envs, "K", 3)))

    def _current_fleets(self) -> list[Fleet]:
        """All that moves by a law: the same fleets as before unless a part says otherwise."""
        moving = [group for part in self.parts for group in part.moving()]
        same = len(moving) == len(self._moving) and all(
            new.points is old.points
            and (new.law is old.law or new.law == old.law)
            and new.planar is old.planar
            for new, old in zip(moving, self._moving, strict=True)
        )
        if not same:
            self._moving, self._fleets = moving, fleets(moving)
        return self._fleets

    def _checked_observation(self, part: Part) -> dict[str, Array]:
        """What a part observes.

        :raises ValueError: it is not what its ``channels`` say
        """
        self._check_sights(part)
        seen, channels = part.observe(), part.channels()
        for name in channels.keys() - seen.keys():
            raise ValueError(
                f"channels() of {part.name} names {name!r}, but observe() does not return it"
            )
        for name, value in seen.items():
            if name not in channels:
                raise ValueError(
                    f"observe() of {part.name} returns {name!r}, which has no channel: add "
                    f"{name!r}: Channel(size) to what its channels() returns"
                )
            expected = (self.num_envs, channels[name].size)
            if np.shape(value) != expected:
                verb = f"observe()[{name!r}]"
                raise ValueError(_misshapen(part, verb, np.shape(value), expected))
            if not np.isfinite(value).all():
                raise ValueError(f"observe()[{name!r}] of {part.name} is not finite: {value[0]}")
        return seen

    def _per_row(self, part: Part, verb: str, value: Any, dtype: type = float) -> Array:
        """What a verb of a part gave, [N], a copy: the part may keep and change its own.

        :raises ValueError: it has another shape
        """
        out: Array = np.array(value, dtype=dtype)
        if out.shape != (self.num_envs,):
            raise ValueError(_misshapen(part, verb, out.shape, (self.num_envs,)))
        return out

    def step(self, actions: Array) -> Outcome:
        """Advance every row by one control step.

        :param actions: [N, action_size]; values outside [−1, 1] are clipped
        :raises ValueError: actions of the wrong shape or not finite
        :raises gymnasium.error.ResetNeeded: no episode has begun
        """
        if not self._begun:
            raise ResetNeeded("call reset() before step()")
        actions = np.asarray(actions, dtype=float)
        shape = (self.num_envs, self.robot.action_size)
        if actions.shape != shape:
            raise ValueError(f"actions have shape {actions.shape}, expected {shape}")
        if np.count_nonzero(np.isfinite(actions)) < actions.size:  # all() takes longer
            rows = np.flatnonzero(~np.isfinite(actions).all(axis=1)).tolist()
            raise ValueError(
                f"actions of rows {rows} are not finite: {actions[rows[0]].tolist()}; allowed: "
                "numbers within [-1, 1]"
            )
        # everything moves from the positions last observed; nothing moves between physics steps
        for fleet in self._current_fleets():
            fleet.advance(self.robot.position)
        for part in self.parts:
            part.before_step()
        self.robot.act(np.minimum(np.maximum(actions, -1.0), 1.0))
        diverged = self.batch.advance(FRAME_SKIP, STAGE)
        changed = self._warnings != self._warned
        if np.count_nonzero(changed):  # MuJoCo has reset these rows by itself
            diverged |= changed.any(axis=1)
            self._warned[:] = self._warnings
        self.steps += 1

        now = self.task.measure()
        reward = self._per_row(self.task, "reward()", self.task.reward(self._before, now))
        reward = np.minimum(np.maximum(reward, -REWARD_LIMIT), REWARD_LIMIT)
        costs = {f"cost_{c.name}": self._per_row(c, "cost()", c.cost()) for c in self.constraints}
        met = self._per_row(self.task, "succeeded()", self.task.succeeded(now), bool)
        unplaced = np.zeros(self.num_envs, dtype=bool)
        if np.count_nonzero(diverged):  # any() takes three times as long
            met = met & ~diverged
            reward[diverged] = 0.0
            for cost in costs.values():
                cost[diverged] = 0.0
        if np.count_nonzero(reward != reward):
            raise ValueError(
                f"reward() of {self.task.name} is nan in rows "
                f"{np.flatnonzero(np.isnan(reward)).tolist()}: it must be a number"
            )
        total = np.zeros(self.num_envs)
        for name, cost in costs.items():
            if np.count_nonzero(cost >= 0.0) < self.num_envs:
                raise ValueError(
                    f"{name} is {cost[~(cost >= 0.0)][0]}: a cost must be at least 0; what is "
                    "good belongs into the task's reward"
                )
            total += cost
        terminated = diverged.copy()
        self._before[:] = now
        if np.count_nonzero(met):
            reward[met] += self.task.bonus
            if self.task.ends:
                terminated |= met
            else:
                ids = np.flatnonzero(met)
                unplaced[self.task.advance(ids)] = True
                self._before[ids] = self.task.measure()[ids]
        return Outcome(self.observe(), reward, costs, total, met, terminated, unplaced, diverged)

    def state(self) -> dict[str, Any]:
        """Everything that the coming steps depend on, as plain arrays and mappings."""
        return {
            "batch": self.batch.state.copy(),
            "arrays": {name: a.copy() for name, a in self._arrays.items()},
            "rngs": [rng.bit_generator.state for rng in self.rngs],
            "origins": dict(self._origins),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state`, bit for bit, whatever the number of threads.

        :raises ValueError: the state belongs to another world or another number of rows
        """
        theirs = {"physics": state["batch"].shape}
        theirs |= {name: array.shape for name, array in state["arrays"].items()}
        own = {"physics": self.batch.state.shape}
        own |= {name: array.shape for name, array in self._arrays.items()}
        if theirs != own:
            raise ValueError(f"the state has arrays {theirs}; those of this engine are {own}")
        self.batch.state[:] = state["batch"]
        for name, value in state["arrays"].items():
            self._arrays[name][:] = value
        self.rngs = [_generator(s) for s in state["rngs"]]
        self._origins = dict(state["origins"])
        self.batch.forward(stage=STAGE)
        self._warned[:] = self._warnings
        self._begun = bool((self.steps >= 0).all())


def _misshapen(part: Part, verb: str, shape: tuple[Any, ...], expected: tuple[Any, ...]) -> str:
    """An error message about what a part's verb gave."""
    words = f"({', '.join(map(str, expected))}{',' * (len(expected) == 1)})"
    return (
        f"{verb} of {part.name} has shape {shape}, expected {words}: one row for each simulation "
        "of the batch"
    )


def _generator(state: Mapping[str, Any]) -> np.random.Generator:
    """A generator that continues from a saved state."""
    bits = getattr(np.random, state["bit_generator"])()
    bits.state = state
    return np.random.Generator(bits)


def _cpus() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _ignore_warning(message: str) -> None:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT: the engine reads the warning counters itself."""


def profiling_clock() -> ctypes.c_void_p | None:
    """Where MuJoCo keeps the clock that its Python bindings install; None if it is not found."""
    for path in Path(mujoco.__file__).parent.glob("*mujoco*"):
        if path.name.startswith(("libmujoco", "mujoco.dll")):
            try:
                return ctypes.c_void_p.in_dll(ctypes.CDLL(str(path)), "mjcb_time")
            except (OSError, ValueError):
                continue
    return None


def _silence_profiler() -> None:
    """Remove the profiling clock, which slows short steps by 5 to 44 %.

    Only the timers of MjData lose their values; the simulation is the same.
    """
    clock = profiling_clock()
    if clock is not None:
        clock.value = None

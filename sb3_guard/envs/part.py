"""What an environment is made of: parts, and the few verbs they share.

A world is a robot, a task and any number of constraints. Each is a :class:`Part`, a dataclass whose
fields are its parameters, written once for N simulations at a time: every array leads with N. The
engine calls the verbs in this order::

    build(world)        once    add bodies and sensors to the MjSpec
    bind(sim)           once    take live [N, ...] views of what was added
    reset(ids, rngs)            an episode begins in rows ids, at the places just drawn
    moving()                    what moves by a law: the engine moves it
    before_step()               move what else moves itself
    observations()              name -> Scan, Compass or Values: what the robot observes

``moving``, ``observations`` and ``measure`` are also called before the first ``reset``.

A task adds ``measure``, ``reward``, ``succeeded`` and ``advance``; a constraint adds ``cost``; any
part may end an episode with ``terminated``. ``observations``, ``measure``, ``reward``,
``cost`` and ``terminated`` only read. A part keeps no arrays of its own between steps: it takes
them by name from the engine (:meth:`Simulation.array`), so that an engine's state can be saved and
restored whole. A parameter that is drawn anew in each episode, ``param(..., drawn=True)``, is read
by :meth:`Part.current`; as an attribute it is its greatest value.
"""

from __future__ import annotations

import math
import re
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import mujoco
import numpy as np

from sb3_guard.envs.layout import Footprint
from sb3_guard.envs.motion import Moving
from sb3_guard.envs.observation import Observations
from sb3_guard.envs.parameters import Parameters, param
from sb3_guard.envs.physics import FRAME_SKIP, Physics
from sb3_guard.envs.types import Array, Generators

PLANE = mujoco.mjtGeom.mjGEOM_PLANE
# parameters of parts that exist on the floor and in the air
SPACE = param(
    None, "planar or spatial; null: the robot's workspace", choices=(None, "planar", "spatial")
)
HEIGHT = param((0.5, 1.5), "range of z in space, m", low=0)
# parameters of parts that have bodies: factors on what the bodies have without them
MASS = param(1.0, "factor on masses and inertias", above=0, drawn="mass")
FRICTION = param(1.0, "factor on friction with the floor", low=0, drawn="friction")


@dataclass
class World:
    """The world under construction: floor, light, cameras and what the parts add.

    :param robot: the robot that it is for
    :param spec: the world, to which the parts add
    """

    robot: Robot
    spec: mujoco.MjSpec

    def __post_init__(self) -> None:
        """Note the floors: planes that are added later are walls."""
        self._floors = [geom for geom in self.spec.worldbody.geoms if geom.type == PLANE]

    def rub(self, body: str) -> int:
        """State the contacts with the floor of all geoms from ``body`` on, as pairs of geoms.

        Each pair has what MuJoCo would give the contact itself, so that nothing changes but that
        its friction is one row of ``pair_friction``. Pairs that a file states stay.

        :return: how many there can be
        """
        count, stated = 0, [{pair.geomname1, pair.geomname2} for pair in self.spec.pairs]
        for geom in self.spec.body(body).find_all("geom"):
            for floor in self._floors:
                if {geom.name, floor.name} in stated:
                    count += 1
                    continue
                if not (geom.contype & floor.conaffinity or floor.contype & geom.conaffinity):
                    continue
                geom.name = geom.name or f"{body}/rubs{count}"
                floor.name = floor.name or "floor"
                self._add_pair(geom, floor)
                count += 1
        return count

    def _add_pair(self, geom: mujoco.MjsGeom, floor: mujoco.MjsGeom) -> None:
        """What two geoms with priorities, or without, make of their contact."""
        most = max(geom.priority, floor.priority)
        ruling = [g for g in (geom, floor) if g.priority == most]
        mixed = [g.solmix for g in ruling]
        slide, spin, roll = np.max([g.friction for g in ruling], axis=0)
        self.spec.add_pair(
            geomname1=floor.name,
            geomname2=geom.name,
            condim=max(g.condim for g in ruling),
            friction=[slide, slide, spin, roll, roll],
            solref=np.average([g.solref for g in ruling], axis=0, weights=mixed),
            solimp=np.average([g.solimp for g in ruling], axis=0, weights=mixed),
            margin=geom.margin + floor.margin,  # MuJoCo 4 adds them
            gap=geom.gap + floor.gap,
        )

    def feel(self, name: str, body: str, force: bool = False, by: str | None = None) -> None:
        """Count contacts between any part of the robot and ``body``; 0 if there are none.

        :param name: name of the sensor
        :param body: name of a body in the world; the floor's and the walls' is ``"world"``
        :param force: whether their net force is felt instead, [N, 3] N along the world's axes
        :param by: the body of the robot that feels them, without those on it; None: the robot
        """
        found = [mujoco.mjtConDataField.mjCONDATA_FOUND, 0]  # no reduction
        net = [mujoco.mjtConDataField.mjCONDATA_FORCE, 3]
        data, reduction = net if force else found
        self.spec.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            # in contact sensors, mjOBJ_XBODY is the body's whole subtree
            objtype=mujoco.mjtObj.mjOBJ_BODY if by else mujoco.mjtObj.mjOBJ_XBODY,
            objname=by or self.robot.root,
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname=body,
            intprm=[1 << int(data), int(reduction), 1],  # one slot
        )


class Simulation(Protocol):
    """N running simulations, as a part sees them after :meth:`Part.bind`."""

    batch: Physics
    model: mujoco.MjModel
    num_envs: int
    robot: Robot
    task: Task
    constraints: tuple[Constraint, ...]
    footprints: dict[str, Footprint]  # what is placed when an episode begins
    rngs: list[np.random.Generator]  # one per row
    steps: Array  # [N] control steps since the episode began
    control_step: float  # s, duration of one

    def array(self, name: str, shape: tuple[int, ...] = (), dtype: Any = float) -> Array:
        """The engine's array ``name``, ``[N, *shape]``, zero at first; part of the state."""

    def places(self, name: str) -> Array:
        """The live places of footprint ``name``, [N, num, 3] m, redrawn at every reset."""

    def sensor(self, name: str) -> Array:
        """Live values of a sensor, [N, d], such as ``"robot/gyro"`` of the robot's file."""

    def redraw(self, name: str, row: int) -> bool:
        """Draw footprint ``name`` again in one row, clear of everything's current place."""


def below(model: mujoco.MjModel, roots: Sequence[str]) -> list[int]:
    """These bodies and all that hang on them, by number."""
    bodies = {model.body(root).id for root in roots}
    for child in range(model.nbody):  # parents come before their children
        if int(model.body_parentid[child]) in bodies:
            bodies.add(child)
    return sorted(bodies)


class Painter(Protocol):
    """Draws what is not a body, such as zones and goals."""

    def zone(
        self, center: Array, radius: float, half_height: float, color: tuple[float, ...]
    ) -> None:
        """A see-through cylinder, or a sphere if ``half_height`` is 0, at ``center``, [3] m."""

    def wall(self, start: Array, end: Array, color: tuple[float, ...]) -> None:
        """A see-through wall, 20 cm high, on the floor between two places, [2] m."""


class Part(Parameters):
    """A robot, a task or a constraint: see the module's text for the verbs."""

    sim: Simulation
    space: str | None = None  # "planar" or "spatial"; None: the robot's workspace
    spaces: ClassVar[tuple[str, ...]] = ("planar", "spatial")
    planar: bool
    height: tuple[float, float] = (0.5, 1.5)  # m, range of z in space
    size: float  # m, radius of its objects
    groups: tuple[Any, ...] = ()  # its objects, each a Group, made by build()
    every: str = "control"  # before which steps before_step is called: "control" or "physics"
    solid: bool = False  # whether its objects are bodies that the robot bumps into
    color: ClassVar[tuple[float, float, float]] = (0.5, 0.5, 0.5)
    family: ClassVar[str] = "guard"  # of suites; a part of GUARD's has a page of its own
    bounds: ClassVar[dict[str, str]] = {}  # of the values of methods

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for method, bound in cls.bounds.items():  # one who replaces a method states its bound anew
            nearest = (vars(c) for c in cls.__mro__ if method in vars(c) or bound in vars(c))
            if bound not in next(nearest, {bound}):
                setattr(cls, bound, math.inf)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.height[0] > self.height[1]:
            raise ValueError(f"{self.name}.height = {self.height!r} must be (low, high), in metres")

    def current(self, name: str) -> Array:
        """The parameter ``name`` in the running episodes, [N], live if it is drawn anew in each."""
        value = getattr(self, name)
        if name in self.ranges:
            return self.sim.array(f"{self.name}.{name}", dtype=type(value))
        return np.full(self.sim.num_envs, value)

    @property
    def roots(self) -> tuple[str, ...]:
        """The bodies that, with all that hangs on them, have the part's mass and friction."""
        return tuple(name for group in self.groups for name in group.movable)

    def footprints(self) -> tuple[Footprint, ...]:
        """What has to be placed when an episode begins: at least its groups."""
        return tuple(group.footprint for group in self.groups)

    def present(self, footprint: Footprint, row: int) -> Footprint:
        """As many of a footprint's objects as there are in the episode of ``row``."""
        return footprint

    def positions(self, footprint: str) -> Array:
        """Where the objects of a footprint are now, [N, num, 3] m."""
        found = next((g.centers for g in self.groups if g.name == footprint), None)
        return self.sim.places(footprint) if found is None else found

    def build(self, world: World) -> None:
        """Settle the part's space, make its groups, add bodies and sensors to ``world.spec``.

        :raises ValueError: it does not exist in this space, or heights of what is on the floor
        """
        only = self.spaces[0] if len(self.spaces) == 1 else None
        space = self.space or only or world.robot.workspace
        if space not in self.spaces:
            raise ValueError(
                f"{self.name} exists in {' and '.join(self.spaces)} space, not in {space} space; "
                f"set {self.name}={{'space': {self.spaces[0]!r}}}"
            )
        self.planar = space == "planar"
        if self.planar and self.height != type(self).height:
            raise ValueError(
                f"{self.name}.height = {self.height!r} counts in the air only, but its space is "
                f"planar: leave it out, or set {self.name}={{'space': 'spatial', 'height': ...}}"
            )

    def bind(self, sim: Simulation) -> None:
        """Take live views of the running simulations."""
        # the engine is freed, with many megabytes, as soon as nobody but its parts refers to it
        self.sim = weakref.proxy(sim)
        for group in self.groups:
            group.bind(sim)

    def reset(self, ids: Array, rngs: Generators) -> None:
        """Begin an episode in rows ``ids``; ``rngs`` holds one generator per row of the batch."""
        for group in self.groups:
            group.reset(ids, rngs)

    def moving(self) -> tuple[Moving, ...]:
        """What moves by a law before the next step, from the positions last observed.

        Cheapest where ``points`` is the same array every time, such as that of ``sim.places``.
        """
        return ()

    def before_step(self) -> None:
        """Move what else moves itself, after what :meth:`moving` says; set controls.

        Called before every control step; before every physics step if :attr:`every` is
        ``"physics"``, which takes a little longer.
        """

    def observations(self) -> Observations:
        """What the robot observes of this part, always under the same names."""
        return {f"{group.name}_lidar": group.scan() for group in self.groups}

    def terminated(self) -> Array:
        """Whether this part ends the episode: a robot that has fallen, a spent budget, [N] bool.

        Called when a control step ends, after ``cost``, and of a part that defines it only.
        """
        return np.zeros(self.sim.num_envs, dtype=bool)

    def draw(self, painter: Painter, row: int) -> None:
        """Draw one row's share of what is not a body."""
        for group in self.groups:
            group.draw(painter, row)

    def words(self, row: int) -> dict[str, str]:
        """What a row's picture says in its corner, by name."""
        return {}


class Robot(Part):
    """What a robot answers to the other parts, none of which may ask its name."""

    name = "robot"
    workspace: ClassVar[str]  # "planar" or "spatial": the default space of every other part
    # of one physics step, s, and how MuJoCo integrates it: Euler, RK4, implicit or implicitfast;
    # None: as its own world says
    timestep: ClassVar[float | None] = None
    integrator: ClassVar[str | None] = None
    frame_skip: ClassVar[int] = FRAME_SKIP  # physics steps in a control step
    # what MuJoCo computes when a control step ends; with mjSTAGE_NONE positions, velocities and
    # sensors are those of the last physics step's beginning, as mj_step leaves them
    stage: ClassVar[mujoco.mjtStage] = mujoco.mjtStage.mjSTAGE_ACC
    root: ClassVar[str]  # name of the outermost body in the compiled world
    reach: ClassVar[float] = math.inf  # m from reach_center: where goals and hazards make sense
    reach_center: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m
    hand: Array | None = None  # places of an arm's end effector, [n, 3] m; None: all within reach
    # parameters of tasks, constraints and the arena that suit its size, by keyword; a scenario's
    # come first
    defaults: Mapping[str, Mapping[str, Any]] = {}
    altitude: float = 0.0  # m, z of its position when an episode begins
    bounds: ClassVar[dict[str, str]] = {"clearance": "thickness"}
    thickness: float = math.inf  # m, greatest depth of a point inside it; 0: the robot is a point
    action_size: int
    action_range: tuple[Array | float, Array | float] = (-1.0, 1.0)  # lowest and highest actions

    def world(self) -> mujoco.MjSpec | None:
        """A world of its own, with floor, light and options; None: the arena's.

        The robot is in it: :meth:`build` has nothing to attach.
        """
        return None

    @property
    def roots(self) -> tuple[str, ...]:
        return (self.root,)

    def bodies(self, model: mujoco.MjModel) -> list[int]:
        """Its bodies in a compiled world: the outermost and all that hangs on it."""
        return below(model, [self.root])

    def within(self, planar: bool) -> dict[str, Any]:
        """Where things can be reached, as arguments of a footprint, by (x, y) alone if planar."""
        x, y, z = self.reach_center
        return {"reach": self.reach, "reach_center": (x, y, 0.0 if planar else z)}

    @property
    def position(self) -> Array:
        """Where the robot is, [N, 3] m: its ``robot`` body, or an arm's end effector."""
        raise NotImplementedError

    @property
    def velocity(self) -> Array:
        """How fast the body at :attr:`position` moves, [N, 3] m/s, along the world's axes."""
        raise NotImplementedError

    @property
    def frames(self) -> tuple[Array, Array]:
        """Positions [N, B, 3] m and rotations [N, B, 3, 3] (body to world) of the lidar bodies."""
        raise NotImplementedError

    def clearance(self, points: Array, planar: bool) -> Array:
        """Distance from the robot to [N, K, 3] points: [N, K] m, negative inside its links.

        :param points: [N, K, 3] m
        :param planar: whether to measure in the plane
        """
        raise NotImplementedError

    def act(self, actions: Array) -> None:
        """Apply [N, action_size] actions within ``action_range`` for the next control step."""
        raise NotImplementedError

    def to_controls(self, actions: Array | float) -> Array | None:
        """The controls that actions set, linear in each, without noise and delay.

        None: they are not linear. Exported policies give controls, too.

        :param actions: [N, action_size], or one number for all
        """
        return None


class Task(Part):
    """What the robot is rewarded for."""

    interactive: bool  # the taxonomy of the paper's task table
    contact: bool
    targets: str  # "one" or "many"
    reward_limit: float | None = None  # dense rewards are cut off at ± this; None: they are not
    bonus: float = 0.0  # reward for success, added to the dense reward after that
    ends: bool = False  # whether success ends the episode instead of drawing a new goal
    bounds: ClassVar[dict[str, str]] = {"mistakes": "most_mistakes"}
    most_mistakes: float = 0.0  # the most that there can be at a time
    camera: ClassVar[str] = "fixed"  # of pictures that are not asked to have another one
    invalid_reason: ClassVar[str] = "its goal is reached immediately"  # why it is drawn again

    def measure(self) -> Array:
        """The distances that the reward is made of, [N, M] m."""
        return np.zeros((self.sim.num_envs, 0))

    def reward(self, before: Array, now: Array) -> Array:
        """The dense reward, [N], of a step that changed :meth:`measure` from before to now."""
        raise NotImplementedError

    def succeeded(self, now: Array) -> Array:
        """Whether the goal is met, [N] bool."""
        return np.zeros(len(now), dtype=bool)

    def invalid_start(self) -> Array:
        """Whether an episode that begins now is drawn again, [N] bool."""
        return self.succeeded(self.measure())

    def advance(self, ids: Array) -> Array:
        """Set the next goal in rows ``ids``; returns the rows, [n], where none could be placed."""
        return ids[:0]

    def mistakes(self) -> Array:
        """How many objects of the task are touched that should not be, [N]."""
        return np.zeros(self.sim.num_envs)


class Constraint(Part):
    """Base class of constraints: assigns the cost of each step."""

    trespassable: bool  # the taxonomy of the paper's constraint table
    movable: str  # "no", "passive" or "active"
    bounds: ClassVar[dict[str, str]] = {"cost": "most_cost", "costs": "most_cost"}
    #: highest cost of a step; inf of a class that has a cost of its own and does not state it
    most_cost: float = math.inf

    def cost(self) -> Array:
        """The cost of this step, [N], at least 0."""
        raise NotImplementedError

    def per_step(self) -> str:
        """The cost of a step: the docstring from "Cost" on, with the values of its parameters."""
        said = "".join(re.findall(r"\bCost\b.*", self.__doc__ or "", re.DOTALL))
        values = {name: str(value) for name, value in vars(self).items() if value is not None}
        return re.sub("``(.*?)``", lambda it: values.get(it[1], it[1]), " ".join(said.split()))

    def costs(self) -> dict[str, Array]:
        """What is reported as ``cost_<name>``, by name, [N] each; together they are the cost."""
        return {self.name: self.cost()}

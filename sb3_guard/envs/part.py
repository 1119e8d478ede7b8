"""What an environment is made of: parts, and the few verbs they share.

A world is a robot, a task and any number of constraints. Each is a :class:`Part`, a dataclass whose
fields are its parameters, written once for N simulations at a time: every array leads with N. The
engine calls the verbs in this order::

    build(world)        once    add bodies and sensors to the MjSpec
    bind(sim)           once    take live [N, ...] views of what was added
    reset(ids, rngs)            an episode begins in rows ids, at the places just drawn
    moving()                    what moves by a law: the engine moves it
    before_step()               move what else moves itself
    sights()                    name -> what lidar and compass see
    observe()                   name -> [N, d], whatever else is observed

``moving``, ``sights``, ``channels`` and ``measure`` are also called before the first ``reset``.

A task adds ``measure``, ``reward``, ``succeeded`` and ``advance``; a constraint adds ``cost``.
``sights``, ``observe``, ``measure``, ``reward`` and ``cost`` only read. A part keeps no arrays of
its own between steps: it takes them by name from the engine (:meth:`Simulation.array`), so that an
engine's state can be saved and restored whole.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, ClassVar, Protocol, Self

import mujoco
import numpy as np

from sb3_guard.envs.layout import Footprint
from sb3_guard.envs.motion import Moving
from sb3_guard.envs.parameters import Parameters
from sb3_guard.envs.sensors import Channel, Compass, Scan

Array = np.ndarray
Generators = Sequence[np.random.Generator]

# Contact bits. A robot's geoms collide with bit ROBOT, the floor with bit FLOOR: a robot that
# hovers or slides at a fixed height leaves FLOOR out and saves the pair.
ROBOT, FLOOR = 1, 2


class World(Protocol):
    """A world under construction, as :meth:`Part.build` sees it."""

    spec: mujoco.MjSpec
    robot: Robot

    def feel(self, name: str, body: str) -> None:
        """Add a sensor ``name`` of the robot's contacts with ``body``, 0 if there are none."""


class Simulation(Protocol):
    """N running simulations, as a part sees them after :meth:`Part.bind`."""

    batch: mujoco.batch.Batch
    model: mujoco.MjModel
    num_envs: int
    robot: Robot
    task: Task
    constraints: tuple[Constraint, ...]
    rngs: list[np.random.Generator]  # one per row
    steps: Array  # [N] control steps since the episode began

    def array(self, name: str, shape: tuple[int, ...] = (), dtype: Any = float) -> Array:
        """The engine's array ``name``, ``[N, *shape]``, zero at first; part of the state."""

    def places(self, name: str) -> Array:
        """The live places of footprint ``name``, [N, num, 3] m, redrawn at every reset."""

    def farthest(self, one: str, other: str) -> float:
        """Greatest distance in the plane at which two footprints may begin, m."""

    def redraw(self, name: str, row: int) -> bool:
        """Draw footprint ``name`` anew in one row, clear of everything's current place."""


class Painter(Protocol):
    """Draws what is not a body, such as zones and goals."""

    def zone(
        self, center: Array, radius: float, half_height: float, color: tuple[float, ...]
    ) -> None:
        """A see-through cylinder, or a sphere if ``half_height`` is 0, at ``center``, [3] m."""


class Part(Parameters):
    """A robot, a task or a constraint: see the module's text for the verbs."""

    sim: Simulation
    space: str | None = None  # "planar" or "spatial"; None: the robot's workspace
    spaces: ClassVar[tuple[str, ...]] = ("planar", "spatial")
    planar: bool
    height: tuple[float, float]  # m, range of z in space
    solid: bool = False  # whether its objects are bodies that the robot bumps into
    color: ClassVar[tuple[float, float, float]] = (0.5, 0.5, 0.5)

    @classmethod
    def from_params(cls, params: Mapping[str, Any], name: str | None = None) -> Self:
        known = {f.name for f in fields(cls)}  # type: ignore[arg-type]
        if isinstance(params, Mapping) and "space" in params and "space" not in known:
            if len(cls.spaces) == 1:
                raise ValueError(
                    f"{name or cls.name}.space = {params['space']!r} cannot be set: its space is "
                    f"always {cls.spaces[0]}, whatever the robot's workspace; leave it out"
                )
        return super().from_params(params, name)

    def footprints(self) -> tuple[Footprint, ...]:
        """What has to be placed when an episode begins."""
        return ()

    def positions(self, footprint: str) -> Array:
        """Where the objects of a footprint are now, [N, num, 3] m."""
        return self.sim.places(footprint)

    def build(self, world: World) -> None:
        """Settle the part's space and add bodies and sensors to ``world.spec``.

        :raises ValueError: the part does not exist in this space
        """
        space = self.space or world.robot.workspace
        if space not in self.spaces:
            raise ValueError(
                f"{self.name} exists in {' and '.join(self.spaces)} space, not in {space} space; "
                f"set {self.name}={{'space': {self.spaces[0]!r}}}"
            )
        self.planar = space == "planar"

    def bind(self, sim: Simulation) -> None:
        """Take live views of the running simulations."""
        self.sim = sim

    def reset(self, ids: Array, rngs: Generators) -> None:
        """Begin an episode in rows ``ids``; ``rngs`` holds one generator per row of the batch."""

    def moving(self) -> tuple[Moving, ...]:
        """What moves by a law before the next step, from the positions last observed.

        Cheapest where ``points`` is the same array every time, such as that of ``sim.places``.
        """
        return ()

    def before_step(self) -> None:
        """Move what else moves itself, after what :meth:`moving` says; set controls."""

    def sights(self) -> dict[str, Scan | Compass]:
        """Named observations from the robot's lidar bodies, always the same ones."""
        return {}

    def observe(self) -> dict[str, Array]:
        """Other named observations, each [N, d]."""
        return {}

    def channels(self) -> dict[str, Channel]:
        """What :meth:`observe` returns, by name."""
        return {}

    def draw(self, painter: Painter, row: int) -> None:
        """Draw one row's share of what is not a body."""


class Robot(Part):
    """What a robot answers to the other parts, none of which may ask its name."""

    name = "robot"
    workspace: ClassVar[str]  # "planar" or "spatial": the default space of every other part
    timestep: ClassVar[float]  # s, of one physics step
    root: ClassVar[str]  # name of the outermost body in the compiled world
    reach: ClassVar[float] = math.inf  # m from its base: where goals and hazards make sense
    altitude: float = 0.0  # m, z of its position when an episode begins
    aside: float = 0.0  # m, distance of that position from its place in the plane
    extent: float = math.inf  # m, how far from its position its body may reach in any pose
    action_size: int

    @property
    def base(self) -> tuple[float, float]:
        """What ``reach`` is measured from, (x, y) m."""
        return (0.0, 0.0)

    @property
    def position(self) -> Array:
        """Where the robot is, [N, 3] m: its ``robot`` body, or an arm's end effector."""
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
        """Apply [N, action_size] actions within [−1, 1] for the next control step."""
        raise NotImplementedError


class Task(Part):
    """What the robot is rewarded for."""

    interactive: bool  # the taxonomy of the paper's task table
    contact: bool
    targets: str  # "one" or "many"
    bonus: float = 0.0  # reward for success, added after the dense reward is clipped
    ends: bool = False  # whether success ends the episode instead of drawing a new goal
    spoils: ClassVar[str] = "its goal is reached at once"  # why an episode is drawn again

    def measure(self) -> Array:
        """The distances that the reward is made of, [N, M] m."""
        return np.zeros((self.sim.num_envs, 0))

    def reward(self, before: Array, now: Array) -> Array:
        """The dense reward, [N], of a step that changed :meth:`measure` from before to now."""
        raise NotImplementedError

    def succeeded(self, now: Array) -> Array:
        """Whether the goal is met, [N] bool."""
        return np.zeros(len(now), dtype=bool)

    def blemished(self) -> Array:
        """Whether an episode that begins now is drawn again, [N] bool."""
        return self.succeeded(self.measure())

    def advance(self, ids: Array) -> Array:
        """Set the next goal in rows ``ids``; returns the rows, [n], where none could be placed."""
        return ids[:0]

    def mistakes(self) -> Array:
        """How many objects of the task are touched that should not be, [N]."""
        return np.zeros(self.sim.num_envs)


class Constraint(Part):
    """What the robot pays for."""

    trespassable: bool  # the taxonomy of the paper's constraint table
    movable: str  # "no", "passive" or "active"

    def cost(self) -> Array:
        """The cost of this step, [N], at least 0."""
        raise NotImplementedError

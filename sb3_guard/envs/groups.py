"""Groups of like objects: placed together, seen by one lidar, felt if solid.

A part *has* groups (:attr:`~sb3_guard.envs.part.Part.groups`). What the robot can pass through is
plain places, no bodies: it costs the physics nothing. Solid objects are bodies, mocap ones where
only their part moves them, free ones where the robot may, and free ones welded to a mocap body
where both do.
"""

import math
import weakref
from collections.abc import Callable

import mujoco
import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.layout import AWAY, Footprint
from sb3_guard.envs.observation import Scan
from sb3_guard.envs.parameters import Range
from sb3_guard.envs.part import Painter, Part, Simulation, World
from sb3_guard.envs.types import FLOOR, ROBOT, Array, Generators

Shape = Callable[[mujoco.MjsBody], None]  # adds the geoms of one object to its body
BOX = mujoco.mjtGeom.mjGEOM_BOX
CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE
WELD = [0.02, 1.5]  # solref, s and damping ratio, of welded bodies
# How strongly a weld turns a box, 1/m times half of its edge: √(mass · edge² / 4 / inertia), as if
# MuJoCo weighed a turn by the mass, which it did until 2.3.3, and Safety-Gymnasium relies on.
TURN = math.sqrt(1.5)
GRIPS = 33  # factors on friction at which heights are computed: within 0.3 µm between 0.2 and 2


class Group:
    """Like objects of a part: discs on the floor, spheres in the air, or solid bodies.

    Each body has a sensor for the robot's touch.

    :param part: whose they are; its ``planar`` and ``color`` are theirs, and the ``size`` of those
        that are not solid
    :param world: the world under construction
    :param footprint: how many, what they are called and where they are placed
    :param shape: adds the geoms of a solid object, whose frame is its place; None: not solid
    :param free: half height of solid objects that can be pushed, m; None: they stay
    :param weld: whether those that can be pushed are welded, softly, to a mocap body below them
    :param sink: how deep those that can be pushed begin in the floor, m; None: as they rest
    :param grip: the part's parameter that is a factor on their friction with the floor
    :raises ValueError: another part's bodies have this name
    """

    def __init__(
        self,
        part: Part,
        world: World,
        footprint: Footprint,
        shape: Shape | None = None,
        free: float | None = None,
        weld: bool = False,
        sink: float | None = None,
        grip: str | None = None,
    ) -> None:
        self.part: Part = weakref.proxy(part)  # which has this group
        self.name, self.footprint = footprint.name, footprint
        self.solid, self._grip, self._free = shape is not None, grip, free is not None
        name, self._num = self.name, footprint.num if shape else 0  # of bodies
        if self._num and world.spec.body(f"{name}/0") is not None:
            raise ValueError(
                f"two parts have bodies called {name!r}; give the constraint another name"
            )
        # how high bodies are set down, m, at some factors on their friction
        grips = part.span(grip) if grip else Range(1.0, 1.0)
        self._grips = np.linspace(*grips, 1 if grips.low == grips.high else GRIPS)
        self._heights = np.full(len(self._grips), 0.0 if free is None else free - (sink or 0.0))
        if shape and free is not None and sink is None:
            timestep = world.spec.option.timestep
            self._heights[:] = [resting_height(shape, free, timestep, g) for g in self._grips]
        for i in range(self._num):
            body = world.spec.worldbody.add_body(name=f"{name}/{i}", mocap=not self._free)
            if self._free:
                body.add_freejoint()
            if shape:
                shape(body)
            world.feel(f"{name}/{i}", body=f"{name}/{i}")
        self._welded = weld and self._num > 0
        self._lift = free if weld and free else 0.0
        for i in range(self._num if weld else 0):
            world.spec.worldbody.add_body(name=f"{name}/{i}/mover", mocap=True)
            world.spec.add_equality(
                type=mujoco.mjtEq.mjEQ_WELD,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
                name1=f"{name}/{i}/mover",
                name2=f"{name}/{i}",
                solref=WELD,
                # anchor, offset, turn, torque
                data=[0, 0, 0, 0, 0, self._lift, 1, 0, 0, 0, TURN / self._lift, 0],
            )

    @property
    def movable(self) -> list[str]:
        """Names of the bodies that can be pushed."""
        return [f"{self.name}/{i}" for i in range(self._num)] if self._free else []

    def bind(self, sim: Simulation) -> None:
        """Take live views: ``places``, where they were put, and ``centers``, [N, num, 3] m; of free
        bodies ``velocities``, m/s.
        """
        self.places = self.centers = sim.places(self.name)
        model, batch, k = sim.model, sim.batch, self._num
        if k == 0:
            self._found = np.zeros((sim.num_envs, 0))
            return
        body = model.body(f"{self.name}/0")
        self.centers = batch.bind("xpos")[:, body.id : body.id + k]
        first = int(model.sensor(f"{self.name}/0").adr[0])
        self._found = batch.bind("sensordata")[:, first : first + k]
        if self._free:
            first = int(body.jntadr[0])
            q, v = int(model.jnt_qposadr[first]), int(model.jnt_dofadr[first])
            pose = batch.bind("qpos")[:, q : q + 7 * k].reshape(-1, k, 7)
            self._set, self._turns = pose[..., :3], pose[..., 3:]
            self.velocities = batch.bind("qvel")[:, v : v + 6 * k].reshape(-1, k, 6)[..., :3]
        else:
            self._set, self._turns = self._mocap(sim, f"{self.name}/0")
        self._movers = self._set
        if self._welded:
            self._movers, self._mover_turns = self._mocap(sim, f"{self.name}/0/mover")

    def _mocap(self, sim: Simulation, name: str) -> tuple[Array, Array]:
        """Places and quaternions of the mocap bodies from this one on."""
        first = int(sim.model.body_mocapid[sim.model.body(name).id])
        rows = slice(first, first + self._num)
        return sim.batch.bind("mocap_pos")[:, rows], sim.batch.bind("mocap_quat")[:, rows]

    @property
    def touched(self) -> Array:
        """Which bodies the robot touches, [N, num] bool; [N, 0] of what is not solid."""
        return self._found > 0

    def reset(self, ids: Array, rngs: Generators) -> None:
        """Set bodies down at their places in rows ``ids``, each with a random heading."""
        if not self._num:
            return
        places = self.places[ids]
        grips = self.part.current(self._grip)[ids] if self._grip else np.ones(len(ids))
        self._set[ids] = places
        self._set[ids, :, 2] += np.interp(grips, self._grips, self._heights)[:, None]
        for i in ids.tolist():
            heading = rngs[i].uniform(0, 2 * math.pi, self._num)
            self._turns[i] = geometry.yaw_quaternion(heading)
        if self._welded:
            self._mover_turns[ids] = self._turns[ids]
            self.move(places, ids)

    def move(self, places: Array, rows: Array | slice = slice(None)) -> None:
        """Move bodies, those that cannot be pushed or what they are welded to, in these rows.

        :param places: [n, num, 3] m
        """
        self._movers[rows] = places
        self._movers[rows, :, 2] += self._lift

    def scan(self, visible: Array | None = None) -> Scan:
        """What lidar sees of them, in all rows or in the ``visible`` ones, [N] bool."""
        return Scan(self.centers, self.part.planar, visible=visible)

    def draw(self, painter: Painter, row: int) -> None:
        """Draw one row's objects that are not bodies."""
        if not self.solid:
            half_height, size = 0.01 if self.part.planar else 0.0, self.part.current("size")[row]
            for center in self.centers[row]:
                if center[0] < AWAY[0]:
                    painter.zone(center, size, half_height, self.part.color)


def resting_height(shape: Shape, half_height: float, timestep: float, grip: float = 1.0) -> float:
    """Height at which a free body lies still on the floor, m.

    Contacts are soft, the softer the more friction they have: set down anywhere else it would
    bounce when an episode begins.

    :param shape: adds the geoms of the body
    :param half_height: of the body, m
    :param timestep: s; how soft depends on it
    :param grip: factor on the friction of the body and the floor
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=FLOOR, conaffinity=FLOOR
    )
    body = spec.worldbody.add_body(pos=[0, 0, half_height])
    body.add_freejoint()
    shape(body)
    model = spec.compile()
    model.geom_friction *= grip
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=1000)
    return float(data.qpos[2])


def add_geom(
    body: mujoco.MjsBody,
    kind: mujoco.mjtGeom,
    size: tuple[float, ...],
    color: tuple[float, float, float],
    lift: float = 0.0,
    free: bool = False,
) -> mujoco.MjsGeom:
    """Add a geom that robots bump into.

    :param body: whose geom
    :param kind: its shape
    :param size: MuJoCo's sizes of this shape, m
    :param color: red, green, blue
    :param lift: height over the frame of ``body``, m
    :param free: whether it lies on the floor, too
    """
    bits = ROBOT | FLOOR if free else ROBOT
    return body.add_geom(
        type=kind,
        size=[*size, 0.0, 0.0][:3],
        pos=[0.0, 0.0, lift],
        rgba=[*color, 1.0],
        contype=bits,
        conaffinity=bits,
    )


def check_reachable(part: Part, everywhere: bool) -> None:
    """Refuse to hang what a robot on the floor cannot get to: within their size.

    :param part: whose ``height`` and ``size`` it is
    :param everywhere: whether this has to be so at every height of the range, not only at one
    :raises ValueError: names the heights that are near enough
    """
    if part.planar or part.sim.robot.workspace != "planar":
        return
    z, near, (low, high) = part.sim.robot.altitude, part.span("size").low, part.height
    gap = max(z - low, high - z) if everywhere else max(z - high, low - z)
    if gap >= near:
        raise ValueError(
            f"{part.name}.height = {part.height!r} is out of reach: the robot's position is "
            f"{z:.2f} m above the floor, and only heights between {max(z - near, 0.0):.2f} and "
            f"{z + near:.2f} m count; set {part.name}={{'height': [low, high]}} within these, "
            "or {'space': 'planar'}"
        )

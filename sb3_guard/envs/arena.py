"""Where everything happens: the floor, what lights and shows it, and the physics options."""

import importlib.resources
from dataclasses import dataclass

import mujoco
import numpy as np

from sb3_guard.envs.layout import Rectangle
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Part, Robot, Simulation, World
from sb3_guard.envs.types import ROBOT

INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
LONGEST = 0.05  # s of a physics step: contacts of robots are lost in longer ones
PLANE = mujoco.mjtGeom.mjGEOM_PLANE
STILL = 1e-8  # m/s: 2e-10 m in a control step, less than what any test tells from rest
WALL = 0.3  # m, height of walls as they are drawn around robots in the plane


@dataclass
class WorldSpec:
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


@dataclass
class Arena(Part):
    """The square in which things are placed; nothing ends at its edge unless it has walls."""

    name = "arena"

    size: float = param(2.0, "half of its edge, m", above=0)
    walls: str = param(
        "none",
        "solid: walls at its edge, which no robot passes; in space with a lid, an edge high",
        choices=("none", "solid"),
    )
    timestep: float | None = param(
        None, "of a physics step, s; null: the robot's, as for the next two", above=0
    )
    frame_skip: int | None = param(None, "physics steps in a control step", low=1)
    integrator: str | None = param(
        None, "how MuJoCo integrates a physics step", choices=(None, *INTEGRATORS)
    )
    sleep: bool = param(
        False,
        "whether free objects at rest, slower than 1e-8 m/s, cost no time until they are touched",
    )
    condim: int = param(
        3, "dimensions of friction of the floor and of objects", choices=(1, 3, 4, 6)
    )

    @property
    def placements(self) -> tuple[Rectangle, ...]:
        """Where what has no placements of its own is drawn, m."""
        return ((-self.size, -self.size, self.size, self.size),)

    def world(self, robot: Robot) -> WorldSpec:
        """A world without parts yet: the robot's own, or a floor under the sky."""
        spec = robot.world()
        return WorldSpec(robot, _empty() if spec is None else spec)

    def build(self, world: World) -> None:
        super().build(world)
        spec, robot = world.spec, world.robot
        timestep, integrator = self.timestep or robot.timestep, self.integrator or robot.integrator
        if timestep is not None:
            spec.option.timestep = timestep  # attach() keeps the parent's options
        timestep = float(spec.option.timestep)
        if not 0.0 < timestep <= LONGEST:
            raise ValueError(
                f"robot {robot.name!r} has a physics step of {timestep:g} s; allowed: above 0, at "
                f"most {LONGEST:g} s, as in <option timestep='0.002'/>"
            )
        if integrator is not None:
            spec.option.integrator = INTEGRATORS[integrator]
        if self.sleep:
            spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
            spec.option.sleep_tolerance = STILL
        spec.default.geom.condim = self.condim
        if self.walls == "none":
            return
        half, height = self.size, WALL / 2 if self.planar else self.size
        # planes, which nothing tunnels through: they are drawn as large as said but have no end
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            _add_wall(spec, (half * x, half * y, height), (y, -x, 0), (0, 0, 1), (half, height))
        if not self.planar:
            _add_wall(spec, (0, 0, 2 * height), (1, 0, 0), (0, -1, 0), (half, half))

    def bind(self, sim: Simulation) -> None:
        """Refuse places beyond solid walls.

        :raises ValueError: names the part and the place
        """
        super().bind(sim)
        if self.walls == "none":
            return
        for name, footprint in sim.footprints.items():
            for place in footprint.corners:
                if abs(place).max() > self.size:
                    raise ValueError(
                        f"{name} may begin at {tuple(place.tolist())}, beyond the walls at "
                        f"±{self.size} m: set arena={{'size': ...}}, or placements within"
                    )


def _empty() -> mujoco.MjSpec:
    """The world of ``arena.xml``."""
    file = importlib.resources.files("sb3_guard.envs") / "arena.xml"
    return mujoco.MjSpec.from_string(file.read_text(encoding="utf-8"))


def furnish(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Give a world that has a floor the arena's sky, light and look of the floor.

    :param spec: changed, and returned; its physics stays
    """
    skies = [t for t in spec.textures if t.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX]
    for thing in (*spec.lights, *skies):
        spec.delete(thing)
    arena = _empty()
    arena.delete(arena.geom("floor"))
    # what the two state differently would be a warning
    for name in ("integrator", "jacobian"):
        setattr(arena.option, name, getattr(spec.option, name))
    spec.visual.map.znear = arena.visual.map.znear
    spec.visual.headlight.ambient = arena.visual.headlight.ambient
    spec.visual.headlight.diffuse = arena.visual.headlight.diffuse
    spec.attach(arena, prefix="arena/", frame=spec.worldbody.add_frame())
    for geom in spec.worldbody.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geom.material, geom.rgba, geom.size = "arena/floor", [1, 1, 1, 1], [0, 0, 1]
    return spec


def _add_wall(
    spec: mujoco.MjSpec,
    place: tuple[float, float, float],
    right: tuple[float, float, float],
    up: tuple[float, float, float],
    half: tuple[float, float],
) -> None:
    """Add a wall that faces ``right`` × ``up`` and is drawn ``half`` as wide and high, m."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.column_stack([right, up, np.cross(right, up)]).ravel())
    spec.worldbody.add_geom(
        type=PLANE,
        pos=place,
        quat=quat,
        size=[*half, 1.0],
        contype=ROBOT,
        conaffinity=ROBOT,
        condim=3,
        rgba=[0.4, 0.45, 0.5, 0.4],
    )

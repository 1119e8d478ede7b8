"""Where everything happens: the floor, what lights and shows it, and the physics options."""

import importlib.resources
from dataclasses import dataclass

import mujoco
import numpy as np

from sb3_guard.envs.layout import Rectangle
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import PLANE, Part, Robot, World
from sb3_guard.envs.types import ROBOT

INTEGRATORS = {
    "Euler": mujoco.mjtIntegrator.mjINT_EULER,
    "RK4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
LONGEST = 0.05  # s of a physics step: contacts of robots are lost in longer ones
STILL = 1e-8  # m/s: 2e-10 m in a control step, less than what any test tells from rest
WALL = 0.3  # m, height of walls as they are drawn around robots in the plane


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

    def world(self, robot: Robot) -> World:
        """A world without parts yet: the robot's own, or a floor under the sky."""
        spec = robot.world()
        return World(robot, _empty() if spec is None else spec)

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

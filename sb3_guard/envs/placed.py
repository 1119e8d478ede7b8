"""Parts with like objects that are placed when an episode begins."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco

from sb3_guard.envs.groups import Group
from sb3_guard.envs.layout import Footprint, Rectangle
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Part, Robot, World

MOST = 1000  # objects in a group: layouts compare every pair


@dataclass
class Placed(Part):
    """A part with one group of like objects: how many, how large and where.

    What they are otherwise, a subclass says in its class attributes. Solid ones have a
    :meth:`shape`.
    """

    num: int = param(8, "number of objects", low=0, high=MOST, drawn=True)
    size: float = param(0.3, "radius of an object, m", above=0, drawn=True)
    keepout: float | None = param(
        None, "radius kept clear around an object, m; null: 0.4, or what covers a solid one", low=0
    )
    locations: tuple[tuple[float, float], ...] = param((), "fixed places (x, y), m")
    placements: tuple[Rectangle, ...] = param((), "rectangles to draw from, m; empty: the arena")
    margin: float = param(0.0, "extra distance to every other object, m", low=0)

    objects: ClassVar[str] = ""  # what they are called; empty: as the part is
    usual_keepout: ClassVar[float] = 0.4  # m, of objects that it covers
    free: ClassVar[bool] = False  # whether solid objects can be pushed
    welded = False  # whether they can be pushed but are pulled back
    moves: ClassVar[bool] = False  # whether they leave their places by themselves
    reachable: ClassVar[bool] = False  # whether they lie within the robot's reach

    @property
    def cover(self) -> float:
        """Radius around its place that a solid object never leaves, m."""
        return self.size

    @property
    def begins(self) -> float | None:
        """How deep objects that can be pushed begin in the floor, m; None: as they rest."""
        return None

    def shape(self, body: mujoco.MjsBody) -> None:
        """Add the geoms of a solid object, whose frame is its place."""
        raise NotImplementedError(f"{self.name} cannot be solid")

    def build(self, world: World) -> None:
        super().build(world)
        self.group = Group(
            self,
            world,
            self.footprint(world.robot),
            shape=self.shape if self.solid else None,
            free=self.size if self.free or self.welded else None,
            weld=self.welded,
            sink=self.begins,
            grip="friction" if self.free else None,
        )
        self.groups = (self.group,)

    def footprint(self, robot: Robot) -> Footprint:
        """What they need of the floor."""
        cover = self.cover if self.solid else 0.0
        return Footprint(
            self.objects or self.name,
            self.num,
            max(self.usual_keepout, cover) if self.keepout is None else self.keepout,
            self.placements,
            self.locations,
            self.margin,
            height=0.0 if self.planar else self.height,
            **(robot.within(self.planar) if self.reachable else {}),
            mover=self.moves,
            cover=cover,
            label=f"{self.name}.keepout",
        )

"""Push: bring a ball, or a box, to a place."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from sb3_guard.envs import geometry
from sb3_guard.envs.groups import BOX, SPHERE, Group, add_geom
from sb3_guard.envs.layout import Footprint, Rectangle
from sb3_guard.envs.observation import Compass, Observations, Scan
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation, World
from sb3_guard.envs.tasks.destination import Destination
from sb3_guard.envs.types import Array

YELLOW = (0.95, 0.8, 0.1)


@dataclass
class Push(Destination):
    """Push an object to a place on the floor (Zhao et al. 2024, §4.2).

    Reward, with distances in the plane: what the robot gains on the object, while it is more than
    ``null_distance`` object sizes away, and what the object gains on the goal; plus ``bonus`` when
    the object's centre is within ``size`` of the goal.

    The ball soon comes to rest, or rolls on with a lower ``object_rolling``. The box
    slides; posts at its corners keep the robot from slipping off its sides.
    """

    name = "push"
    interactive = True
    contact = True
    spaces = ("planar",)

    object: str = param(
        "ball", "a ball that rolls, or a box with posts to catch it by", choices=("ball", "box")
    )
    object_size: float = param(0.2, "radius of the ball, half an edge of the box, m", above=0)
    object_density: float = param(1e-3, "density of the object, kg/m³", above=0)
    object_mass: float = param(
        1.0, "factor on the object's mass and inertia", above=0, drawn="mass"
    )
    object_friction: float = param(
        1.0, "factor on the object's friction with the floor", low=0, drawn="friction"
    )
    object_rolling: float = param(
        0.05, "rolling friction of the ball, m; with 0.005 it rolls on for metres", low=0
    )
    posts: float = param(0.25, "half width of the box's posts, in sizes", above=0)
    sink: float | None = param(
        None, "how deep the object begins in the floor, m; null: as deep as it rests", low=0
    )
    goal_height: float | None = param(
        None, "m, of a goal that distances in space are measured to; null: in the plane", low=0
    )
    object_keepout: float | None = param(
        None, "radius kept clear around the object, m; null: what covers it", low=0
    )
    object_locations: tuple[tuple[float, float], ...] = param((), "fixed place, one (x, y), m")
    object_placements: tuple[Rectangle, ...] = param(
        (), "rectangles to draw the object from, m; empty: placements"
    )
    object_margin: float | None = param(
        None, "extra distance of the object to every other one, m; null: margin", low=0
    )
    null_distance: float = param(
        2.0, "distance, in object sizes, within which approaching the object has no reward", low=0
    )
    reward_approach: float = param(1.0, "reward per metre gained on the object")
    object_lidar: bool = param(False, "whether the object is also seen by a lidar")

    @property
    def object_radius(self) -> float:
        """Distance of the object's axis from its outermost point, m: a post's edge of a box."""
        box = (1.0 + self.posts) * math.sqrt(2.0)
        return self.object_size * (1.0 if self.object == "ball" else box)

    def build(self, world: World) -> None:
        super().build(world)
        self._flat = world.robot.workspace == "planar"
        footprint = Footprint(
            self.object,
            1,
            self.object_radius if self.object_keepout is None else self.object_keepout,
            self.object_placements or self.placements,
            self.object_locations,
            self.margin if self.object_margin is None else self.object_margin,
            **world.robot.within(planar=False),
            cover=self.object_radius,
            label=f"{self.name}.object_keepout",
        )
        self.group = Group(
            self,
            world,
            footprint,
            self.shape,
            free=self.object_size,
            sink=self.sink,
            grip="object_friction",
        )
        self.groups = (self.group,)

    def shape(self, body: mujoco.MjsBody) -> None:
        """The geoms of the object."""
        r = self.object_size
        if self.object == "ball":
            ball = add_geom(body, SPHERE, (r,), YELLOW, free=True)
            ball.density = self.object_density
            ball.condim, ball.friction = 6, [1.0, 0.005, self.object_rolling]
            return
        add_geom(body, BOX, (r, r, r), YELLOW, free=True).density = self.object_density
        for x, y in ((r, r), (r, -r), (-r, r), (-r, -r)):
            post = add_geom(body, BOX, (self.posts * r, self.posts * r, r), YELLOW)
            post.pos = [x, y, 0.0]
            post.density = self.object_density

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self.center = self.group.centers[:, 0]  # [N, 3] m

    def measure(self) -> Array:
        """Distances robot to object and object to goal, [N, 2] m."""
        distances = np.empty((self.sim.num_envs, 2))
        planar, goal = self.goal_height is None, self.place
        if self.goal_height is not None:
            goal = self.place + np.array([0.0, 0.0, self.goal_height])
        flat = self._flat and planar
        distances[:, 0] = geometry.distance(self.sim.robot.position, self.center, flat)
        distances[:, 1] = geometry.distance(self.center, goal, planar)
        return distances

    def reward(self, before: Array, now: Array) -> Array:
        gain = before - now
        far = before[:, 0] > self.null_distance * self.object_size
        return self.reward_approach * gain[:, 0] * far + self.reward_distance * gain[:, 1]

    def succeeded(self, now: Array) -> Array:
        return now[:, 1] <= self.sizes

    def observations(self) -> Observations:
        out = {**super().observations(), "box_compass": Compass(self.center, self.planar)}
        if self.object_lidar:
            out["box_lidar"] = Scan(self.center[:, None], self.planar, YELLOW)
        return out

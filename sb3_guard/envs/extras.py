"""Observations that belong to no robot, task or constraint, all off by default."""

from dataclasses import dataclass

import numpy as np

from sb3_guard.envs.observation import Observations, Values
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Part, Simulation, World

EYE = "eye"


@dataclass
class Extras(Part):
    """What else can be observed: the clock, the simulator's state, an image.

    The time limit is not the engine's: :func:`gymnasium.make` puts it around a lone environment,
    which is not told. ``remaining`` therefore states the length of an episode itself, and a lone
    environment and a row of a batch observe the same. Where it contradicts the limit, the vector
    environment and ``sb3_guard.make`` refuse it.
    """

    name = "observe"

    remaining: int | None = param(
        None,
        "steps of an episode, the same as max_episode_steps: the share that is left is observed",
        low=1,
    )
    qpos: bool = param(False, "positions of all joints of the world")
    qvel: bool = param(False, "velocities of all joints of the world")
    ctrl: bool = param(False, "controls of all actuators")
    com: bool = param(False, "centre of mass of the robot, m")
    drawn: bool = param(
        False,
        "whether info has the parameters that were drawn for the episode, such as 'hazards.size'",
    )
    components: tuple[str, ...] | None = param(
        None,
        "names of what is observed, in this order, as sb3-guard show prints them; null: "
        "everything, in alphabetical order; constraints that are added or removed join or leave it",
    )
    camera: tuple[int, int] | None = param(
        None,
        "width and height, pixels, of an image from the robot; needs flatten=False",
        low=1,
        high=10_000,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        names = self.components
        if names is not None and (not names or len(set(names)) < len(names)):
            raise ValueError(
                f"observe.components = {names!r} must name at least one component, none twice; "
                "or be null for everything"
            )

    def check_limit(self, steps: int) -> None:
        """
        :param steps: control steps after which episodes are cut
        :raises ValueError: ``remaining`` counts to another number
        """
        if self.remaining is not None and self.remaining != steps:
            raise ValueError(
                f"observe.remaining = {self.remaining}, but episodes are cut after {steps} steps: "
                "give remaining and max_episode_steps the same value"
            )

    def build(self, world: World) -> None:
        """Give the robot the camera that is observed."""
        super().build(world)
        if self.camera is not None:
            # a user's robot that is made without a file need not say where its eye is
            default = (world.robot.root, (0.0, 0.0, 0.1), (1.0, 0.0, 0.0))
            name, place, ahead = getattr(world.robot, "eye", default)
            right = np.cross(ahead, [0.0, 0.0, 1.0])
            axes = [*right, *np.cross(right, ahead)]
            world.spec.body(name).add_camera(name=EYE, pos=place, xyaxes=axes, fovy=90)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        batch, body = sim.batch, sim.model.body(sim.robot.root).id
        units = {"qpos": "m, rad", "qvel": "m/s, rad/s", "ctrl": "control"}
        wanted = [name for name in units if getattr(self, name)]
        self._state = {name: Values(batch.bind(name), unit=units[name]) for name in wanted}
        if self.com:
            self._state["com"] = Values(batch.bind("subtree_com")[:, body], unit="m")

    def observations(self) -> Observations:
        if self.remaining is None:
            return self._state
        left = np.maximum(1 - self.sim.steps / self.remaining, 0.0)[:, None]
        return {**self._state, "remaining": Values(left, 0.0, 1.0, "share")}

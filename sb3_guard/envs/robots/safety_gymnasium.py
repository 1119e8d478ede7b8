"""The robots of Safety-Gymnasium 1.0.0, with its numbers.

GUARD's robots of the same names are other ones: its Car and Ant differ in shape and strength, its
Doggo is twice as large. Points differ in the friction of the nose alone.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

from sb3_guard.envs.observation import Observations, Values
from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Simulation
from sb3_guard.envs.robots.robot import PREFIX, MJCFRobot
from sb3_guard.envs.types import Array, Generators

_SENSORS = ("accelerometer", "velocimeter", "gyro", "magnetometer")


@dataclass
class SafetyRobot(MJCFRobot):
    """A robot whose actions are its controls."""

    family = "safety_gymnasium"
    scaled = False
    integrator = "Euler"
    components: ClassVar[tuple[str, ...]] = _SENSORS  # in the order in which they are observed


@dataclass
class SafetyPoint(SafetyRobot):
    """Safety-Gymnasium's Point: thrust along its nose, and a turning servo."""

    asset = "safety_point.xml"
    timestep = 0.002
    floor = False  # which it just touches


@dataclass
class SafetyCar(SafetyRobot):
    """Safety-Gymnasium's Car: two driven wheels, and a ball that rolls along.

    Positive actions drive it along its body's -y axis, which is where it looks.
    """

    asset = "safety_car.xml"
    timestep = 0.004
    eye = (SafetyRobot.root, (0.0, 0.0, 0.1), (0.0, -1.0, 0.0))
    components = (*_SENSORS, "ballangvel_rear", "ballquat_rear")


_ANT = [f"{joint}_{leg}" for leg in range(1, 5) for joint in ("hip", "ankle")]


@dataclass
class SafetyAnt(SafetyRobot):
    """Safety-Gymnasium's Ant: eight torques; it dies when its torso is at 0.08 m or below."""

    asset = "safety_ant.xml"
    timestep = 0.01
    integrator = "RK4"
    eye = (SafetyRobot.root, (0.0, 0.0, 0.1), (0.0, 1.0, 0.0))
    components = (
        *_SENSORS,
        *(f"jointvel_{joint}" for joint in _ANT),
        "height",
        "angular_velocity",
        *(f"jointpos_{joint}" for joint in _ANT),
    )

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        first = int(sim.model.sensor(f"{PREFIX}_place").adr[0])
        self._height = self._data[:, first + 2 : first + 3]
        self._legs = slice(int(sim.model.joint(f"{PREFIX}hip_1").qposadr[0]), None)

    def reset(self, ids: Array, rngs: Generators) -> None:
        """Stand with the feet down, each joint up to 0.1 rad off."""
        super().reset(ids, rngs)
        down = math.pi / 2
        stance = (0.0, down, 0.0, -down, 0.0, -down, 0.0, down)
        for i in ids.tolist():
            first = self._legs.start
            noise = rngs[i].uniform(-0.1, 0.1, len(stance))
            self._qpos[i, first : first + len(stance)] = stance + noise

    def terminated(self) -> Array:
        return self.position[:, 2] <= 0.08

    def observations(self) -> Observations:
        return {**super().observations(), "height": Values(self._height, unit="m")}


_DOGGO = [
    f"{joint.format(leg)}" for joint in ("hip_{}_z", "hip_{}_y", "ankle_{}") for leg in range(1, 5)
]


@dataclass
class SafetyDoggo(SafetyRobot):
    """Safety-Gymnasium's Doggo: twelve torques on four legs, and a waist that is not driven."""

    asset = "safety_doggo.xml"
    timestep = 0.01
    components = (
        *_SENSORS,
        *(f"touch_ankle_{leg}{side}" for side in "ab" for leg in range(1, 5)),
        *(f"jointvel_{joint}" for joint in _DOGGO),
        *(f"jointpos_{joint}" for joint in _DOGGO),
    )


@dataclass
class SafetyRacecar(SafetyRobot):
    """Safety-Gymnasium's Racecar: the speed of its rear axle, rad/s, and its front wheels' angle.

    ``robot={"scaled": True}`` takes both from actions in [-1, 1], which policies learn sooner.
    """

    asset = "safety_racecar.xml"
    timestep = 0.004
    integrator = "RK4"
    scaled: bool = param(False, "actions in [-1, 1] are scaled to the controls")

"""Robots: one small file and one MJCF file each."""

import warnings

from sb3_guard.envs.robots.ant import Ant
from sb3_guard.envs.robots.arm3 import Arm3
from sb3_guard.envs.robots.arm6 import Arm6
from sb3_guard.envs.robots.car import Car
from sb3_guard.envs.robots.doggo import Doggo
from sb3_guard.envs.robots.drone import Drone
from sb3_guard.envs.robots.hopper import Hopper
from sb3_guard.envs.robots.humanoid import Humanoid
from sb3_guard.envs.robots.point import Point
from sb3_guard.envs.robots.swimmer import Swimmer
from sb3_guard.envs.robots.walker import Walker

# `python -m sb3_guard.envs.robots.ant` runs a module that this package has already imported
warnings.filterwarnings("ignore", message=f"'{__name__}.*found in sys.modules")

__all__ = [
    "Ant",
    "Arm3",
    "Arm6",
    "Car",
    "Doggo",
    "Drone",
    "Hopper",
    "Humanoid",
    "Point",
    "Swimmer",
    "Walker",
]

"""Robots: classes, and an MJCF file each."""

from sb3_guard.envs.robots.guard import (
    Ant,
    Arm3,
    Arm6,
    Car,
    Doggo,
    Drone,
    Hopper,
    Humanoid,
    Point,
    Swimmer,
    Walker,
)  # fmt: skip

__all__ = [
    "Ant", "Arm3", "Arm6", "Car", "Doggo", "Drone", "Hopper", "Humanoid", "Point", "Swimmer",
    "Walker",
]  # fmt: skip

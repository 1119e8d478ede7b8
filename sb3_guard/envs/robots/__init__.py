"""Robots: one small file and one MJCF file each."""

from sb3_guard.envs.robots.point import Point

__all__ = ["Point"]

"""Constraints: what the robot pays for, one file each."""

from sb3_guard.envs.constraints.hazards import Hazards

__all__ = ["Hazards"]

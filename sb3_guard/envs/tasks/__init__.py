"""Tasks: what the robot is rewarded for, one file each."""

from sb3_guard.envs.tasks.goal import Goal

__all__ = ["Goal"]

"""Tasks: what the robot is rewarded for, one file each."""

from sb3_guard.envs.tasks.button import Button
from sb3_guard.envs.tasks.chase import Chase
from sb3_guard.envs.tasks.defense import Defense
from sb3_guard.envs.tasks.destination import Destination
from sb3_guard.envs.tasks.goal import Goal
from sb3_guard.envs.tasks.push import Push
from sb3_guard.envs.tasks.targets import Targets

__all__ = ["Button", "Chase", "Defense", "Destination", "Goal", "Push", "Targets"]

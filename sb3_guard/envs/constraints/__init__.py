"""Constraints, which assign costs, one file each."""

from sb3_guard.envs.constraints.buttons import Buttons
from sb3_guard.envs.constraints.ghosts import Ghosts
from sb3_guard.envs.constraints.gremlins import Gremlins
from sb3_guard.envs.constraints.hazards import Hazards
from sb3_guard.envs.constraints.obstacles import Obstacles
from sb3_guard.envs.constraints.pillars import Pillars
from sb3_guard.envs.constraints.vases import Vases

__all__ = ["Buttons", "Ghosts", "Gremlins", "Hazards", "Obstacles", "Pillars", "Vases"]

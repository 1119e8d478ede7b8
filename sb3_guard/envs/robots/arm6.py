"""Arm6: an arm of six hinges, each turned at a commanded speed."""

from dataclasses import dataclass

from sb3_guard.envs.robots.arm import Arm
from sb3_guard.envs.robots.robot import PREFIX


@dataclass
class Arm6(Arm):
    """An arm that reaches 3 m from its shoulder, with an elbow and a wrist.

    Actions: the speeds of joints 1 to 6 (turn, shoulder, elbow, roll, wrist, roll), ±0.4 rad/s. The
    end effector starts at (0, 1.5, 1.8) m before the heading turns it. Lidar and compass are in the
    frames of links 1, 3, 5 and 7. All else is as in Arm3.
    """

    asset = "arm6.xml"
    links = tuple(f"link_{k}" for k in range(1, 8))
    lidar_bodies = links[::2]
    center = links[-1]
    eye = (PREFIX + links[-1], (0.0, 0.11, 0.0), (0.0, 1.0, 0.0))


if __name__ == "__main__":
    Arm6.show()

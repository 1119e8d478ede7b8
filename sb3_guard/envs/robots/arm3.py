"""Arm3: an arm of three hinges, each turned at a commanded speed."""

from dataclasses import dataclass

from sb3_guard.envs.robots.arm import Arm
from sb3_guard.envs.robots.robot import PREFIX


@dataclass
class Arm3(Arm):
    """An arm that reaches 2.5 m above its base.

    Actions: the speeds of joints 1 to 3 (turn, shoulder, elbow), ±0.6 rad/s: torques of 3000 N·m
    against the joints' damping. The position is the end effector's origin, at the start (0, 1, 1.8)
    m before the heading turns it; goals and hazards lie within 2 m of the base. The clearance is
    the distance from the surface of the nearest link. Links are gravity-compensated: at rest,
    accelerometers read 9.81 m/s². Lidar and compass are in the frames of links 1, 3 and 5.
    """

    asset = "arm3.xml"
    links = tuple(f"link_{k}" for k in range(1, 6))
    lidar_bodies = links[::2]
    center = links[-1]
    eye = (PREFIX + links[-1], (0.0, 0.16, 0.0), (0.0, 1.0, 0.0))


if __name__ == "__main__":
    Arm3.show()

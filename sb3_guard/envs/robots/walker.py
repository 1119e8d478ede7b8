"""Walker: two legs of five hinges each under a bar at a fixed height."""

from dataclasses import dataclass

from sb3_guard.envs.robots.robot import MJCFRobot


@dataclass
class Walker(MJCFRobot):
    """A two-legged robot that cannot fall; the legs push it along the floor.

    Actions: hip x, z and y, knee and ankle of the right leg (at +y), then of the left one. The legs
    are mirror images of each other.
    """

    asset = "walker.xml"
    timestep = 0.005
    integrator = "Euler"


if __name__ == "__main__":
    Walker.show()

"""Point: two actions, thrust along its nose and turn; the easiest robot to train."""

from dataclasses import dataclass

from sb3_guard.envs.robots.robot import MJCFRobot


@dataclass
class Point(MJCFRobot):
    """A ball with a nose at a fixed height, with thrust and a turning servo.

    The thrust is 0.3 N per unit of its actuator's force, which is limited to 0.05: it saturates at
    |action| = 0.05, 0.015 N, and ends at 1.5 m/s. The servo turns at up to 3 rad/s and brakes
    at action 0.
    """

    asset = "point.xml"
    floor = False
    timestep = 0.002
    integrator = "Euler"


if __name__ == "__main__":
    Point.show()

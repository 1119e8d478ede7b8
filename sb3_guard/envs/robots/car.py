"""Car: two driven wheels and a ball; the simplest robot with a free root."""

from dataclasses import dataclass

from sb3_guard.envs.robots.robot import MJCFRobot


@dataclass
class Car(MJCFRobot):
    """A cart that steers by driving its two front wheels differently.

    The torque of a wheel is limited to 0.02 N·m: it saturates at |action| = 0.02, where the wheel
    turns at up to 20 rad/s, 1 m/s. The nose points along the body's y axis. The rear ball is
    observed as a rotation matrix and an angular velocity.
    """

    asset = "car.xml"
    timestep = 0.004
    integrator = "Euler"
    eye = (MJCFRobot.root, (0.0, 0.0, 0.1), (0.0, 1.0, 0.0))


if __name__ == "__main__":
    Car.show()

"""Drone: four propellers, the robot that moves freely in space."""

from dataclasses import dataclass

from sb3_guard.envs.robots.robot import MJCFRobot


@dataclass
class Drone(MJCFRobot):
    """A quadrotor whose weight is balanced at every height: action 0 hovers.

    Actions: the lift of propellers 1 to 4 (at +x, +y, −x, −y), a quarter of the weight ± 0.1 N
    each, along the body's z axis. Drag limits the climb to 2 m/s and tilting to 0.3 rad/s.
    Nothing turns it about its own axis and nothing rights it.
    """

    asset = "drone.xml"
    timestep = 0.008
    integrator = "Euler"
    workspace = "spatial"
    eye = (MJCFRobot.root, (0.35, 0.0, 0.0), (1.0, 0.0, 0.0))  # before the front propeller


if __name__ == "__main__":
    Drone.show()

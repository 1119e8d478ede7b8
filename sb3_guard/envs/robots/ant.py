"""Ant: four legs of two hinges each, eight torques."""

from dataclasses import dataclass

from sb3_guard.envs.robots.robot import MJCFRobot


@dataclass
class Ant(MJCFRobot):
    """A small four-legged robot that starts on its feet.

    Actions: hip and ankle of legs 1 to 4 in turn; legs are numbered front left, rear left, rear
    right, front right.
    """

    asset = "ant.xml"
    timestep = 0.02
    integrator = "Euler"


if __name__ == "__main__":
    Ant.show()

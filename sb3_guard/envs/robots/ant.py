"""Ant: four legs of two hinges each, eight torques."""

from dataclasses import dataclass

from sb3_guard.envs.robots.robot import MJCFRobot


@dataclass
class Ant(MJCFRobot):
    """A small four-legged robot that starts on its feet.

    Actions: hip and ankle of legs 1 to 4 in turn; legs are numbered front left, rear left, rear
    right, front right. It starts with the ankles at ±50°, where only damping holds them: undriven
    it sinks by 4 cm in ten seconds or more. The touch sensors feel the whole lower legs.
    """

    asset = "ant.xml"
    timestep = 0.02
    integrator = "Euler"


if __name__ == "__main__":
    Ant.show()

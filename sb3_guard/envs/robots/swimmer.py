"""Swimmer: three links that crawl by a wave along the body."""

from dataclasses import dataclass

from sb3_guard.envs.robots.robot import MJCFRobot


@dataclass
class Swimmer(MJCFRobot):
    """A chain of three links at a fixed height, driven at its two joints.

    There is no fluid: the links graze the floor, whose friction is the propulsion. A sine of period
    6 control steps and amplitude 0.7, the rear joint a quarter of a period behind, covers 3 m in
    500 control steps. The position is the body's origin, the rear joint, 15 cm behind the front
    link.
    """

    asset = "swimmer.xml"
    timestep = 0.02
    integrator = "Euler"


if __name__ == "__main__":
    Swimmer.show()

"""Humanoid: the proportions of a person, two legs of three hinges each."""

from dataclasses import dataclass

from sb3_guard.envs.robots.robot import MJCFRobot


@dataclass
class Humanoid(MJCFRobot):
    """A person of 42 kg at a fixed height, whose legs push it along the floor.

    Actions: hip z, hip y and knee of the right leg, then of the left one. Hip x, waist and arms are
    rigid, which gives the six torques of the paper. It starts with knees bent by 16°, feet on the
    floor.
    """

    asset = "humanoid.xml"
    timestep = 0.003
    integrator = "implicitfast"  # GUARD's, RK4, takes almost three times as long


if __name__ == "__main__":
    Humanoid.show()

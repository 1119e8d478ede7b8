"""Hopper: a torso on one leg at a fixed height."""

from dataclasses import dataclass

from sb3_guard.envs.robots.robot import MJCFRobot


@dataclass
class Hopper(MJCFRobot):
    """A one-legged robot of 12 kg that cannot fall; its leg pushes it along the floor.

    Actions: hip x and z (±20°, actuators ±0.4), thigh, knee and foot: the five torques of the
    paper, with hip y and thigh as one hinge. It starts with the knee bent by 18°.
    """

    asset = "hopper.xml"
    timestep = 0.005
    integrator = "Euler"


if __name__ == "__main__":
    Hopper.show()

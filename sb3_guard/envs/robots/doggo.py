"""Doggo: four legs of three hinges each under a loose waist."""

from dataclasses import dataclass

from sb3_guard.envs.robots.robot import MJCFRobot


@dataclass
class Doggo(MJCFRobot):
    """A four-legged robot that has to hold itself up: its springs alone let it sink.

    Actions: the hips' turn (z) of legs 1 to 4, the hips' swing (y), then the ankles. Legs are
    numbered front left, rear left, rear right, front right. The waist is neither driven nor
    observed. Springs pull the front hips to −10°, the ankles to −20° and the rest to 0°. They do
    not bear the weight: it starts, and ends when undriven, with its ankles folded.
    """

    asset = "doggo.xml"
    timestep = 0.01
    integrator = "Euler"


if __name__ == "__main__":
    Doggo.show()

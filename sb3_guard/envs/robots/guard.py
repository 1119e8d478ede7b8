"""GUARD's robots: a class and an MJCF file each."""

from dataclasses import dataclass

from sb3_guard.envs.robots.arm import Arm
from sb3_guard.envs.robots.robot import PREFIX, MJCFRobot


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


@dataclass
class Walker(MJCFRobot):
    """A two-legged robot that cannot fall; the legs push it along the floor.

    Actions: hip x, z and y, knee and ankle of the right leg (at +y), then of the left one. The legs
    are mirror images of each other.
    """

    asset = "walker.xml"
    timestep = 0.005
    integrator = "Euler"


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


@dataclass
class Hopper(MJCFRobot):
    """A one-legged robot of 12 kg that cannot fall; its leg pushes it along the floor.

    Actions: hip x and z (±20°, actuators ±0.4), thigh, knee and foot: the five torques of the
    paper, with hip y and thigh as one hinge. It starts with the knee bent by 18°.
    """

    asset = "hopper.xml"
    timestep = 0.005
    integrator = "Euler"


@dataclass
class Arm3(Arm):
    """An arm that reaches 2.5 m above its base.

    Actions: the speeds of joints 1 to 3 (turn, shoulder, elbow), ±0.6 rad/s: torques of 3000 N·m
    against the joints' damping. The position is the end effector's origin, at the start (0, 1, 1.8)
    m before the heading turns it; goals and hazards lie within 2 m of the base. The clearance is
    the distance from the surface of the nearest link. Links are gravity-compensated: at rest,
    accelerometers read 9.81 m/s². Lidar and compass are in the frames of links 1, 3 and 5.
    """

    asset = "arm3.xml"
    links = tuple(f"link_{k}" for k in range(1, 6))
    lidar_bodies = links[::2]
    center = links[-1]
    eye = (PREFIX + links[-1], (0.0, 0.16, 0.0), (0.0, 1.0, 0.0))


@dataclass
class Arm6(Arm):
    """An arm that reaches 3 m from its shoulder, with an elbow and a wrist.

    Actions: the speeds of joints 1 to 6 (turn, shoulder, elbow, roll, wrist, roll), ±0.4 rad/s. The
    end effector starts at (0, 1.5, 1.8) m before the heading turns it. Lidar and compass are in the
    frames of links 1, 3, 5 and 7. All else is as in Arm3.
    """

    asset = "arm6.xml"
    links = tuple(f"link_{k}" for k in range(1, 8))
    lidar_bodies = links[::2]
    center = links[-1]
    eye = (PREFIX + links[-1], (0.0, 0.11, 0.0), (0.0, 1.0, 0.0))


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

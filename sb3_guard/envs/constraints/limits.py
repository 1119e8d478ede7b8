"""Limits of the robot itself: a cost in each step at whose end one of its quantities is beyond."""

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from sb3_guard.envs.parameters import param
from sb3_guard.envs.part import Constraint, Robot, Simulation, World
from sb3_guard.envs.types import Array
from sb3_guard.fields import matching

SLIDE, HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)


def prefix(robot: Robot) -> str:
    """What the names of a robot's elements begin with in the compiled world."""
    return robot.root[: robot.root.rfind("/") + 1]


@dataclass
class Limit(Constraint):
    """Cost ``weight`` in each step at whose end something of the robot is beyond its limits."""

    family = "robot"
    trespassable = True
    movable = "no"
    color = (0.9, 0.2, 0.1)

    weight: float = param(1.0, "cost of a step beyond the limit", low=0)
    ends: bool = param(False, "whether the episode ends beyond the limit")

    def beyond(self) -> Array:
        """Whether it is beyond, [N] bool."""
        raise NotImplementedError

    @property
    def most_cost(self) -> float:  # type: ignore[override]
        return self.weight

    def cost(self) -> Array:
        return self.weight * self.beyond()

    def terminated(self) -> Array:
        return self.beyond() if self.ends else super().terminated()


@dataclass
class BaseHeight(Limit):
    """The robot neither falls nor jumps.

    Cost ``weight`` in each step at whose end its position is below ``low`` or above ``high`` m.
    """

    name = "baseheight"

    low: float | None = param(
        None, "least height that is free, m; null: half of the height at the start"
    )
    high: float | None = param(None, "greatest height that is free, m; null: any")

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._low = 0.5 * sim.robot.altitude if self.low is None else self.low
        self._high = np.inf if self.high is None else self.high
        if self._low >= self._high:
            raise ValueError(
                f"{self.name}.low = {self._low:g} must be less than high = {self._high:g}, m"
            )

    def beyond(self) -> Array:
        height = self.sim.robot.position[:, 2]
        beyond: Array = (height < self._low) | (height > self._high)
        return beyond

    def words(self, row: int) -> dict[str, str]:
        height = self.sim.robot.position[row, 2]
        return {"height": f"{height:.2f} m, free from {self._low:.2f} to {self._high:.2f}"}


@dataclass
class RobotLimit(Limit):
    """Cost ``weight`` in each step at whose end an amount is above ``limit``."""

    unit: ClassVar[str]

    limit: float = param(0.0, "greatest amount that is free", low=0)

    def amount(self) -> Array:
        """What is limited, [N]."""
        raise NotImplementedError

    def beyond(self) -> Array:
        return self.amount() > self.limit

    def words(self, row: int) -> dict[str, str]:
        return {self.name: f"{self.amount()[row]:.2f} {self.unit}, limit {self.limit:g}"}


@dataclass
class JointLimit(RobotLimit):
    """Cost ``weight`` in each step at whose end a joint is beyond ``limit``."""

    joints: tuple[str, ...] = param(
        (),
        "names or patterns of the hinges and slides that count, such as *_knee; empty: all hinges "
        "but those of the outermost body",
    )
    quantity: ClassVar[str]  # of joints, in MuJoCo's data
    ranged: ClassVar[bool] = False  # whether only joints with a range count

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        model, start, bodies = sim.model, prefix(sim.robot), sim.robot.bodies(sim.model)
        names = {
            model.joint(j).name.removeprefix(start): j
            for j in range(model.njnt)
            if model.jnt_bodyid[j] in bodies and model.jnt_type[j] in (SLIDE, HINGE)
            and (model.jnt_limited[j] or not self.ranged)
        }  # fmt: skip
        label = f"{self.name}.joints"
        chosen = {names[name] for p in self.joints for name in matching(label, p, names)}
        if not self.joints:
            own = [j for j in names.values() if model.jnt_bodyid[j] != bodies[0]]
            chosen = {j for j in own if model.jnt_type[j] == HINGE}
        if not chosen:
            others = ", ".join(names) or "none"
            raise ValueError(
                f"{label}: the robot has no hinges{' with a range' * self.ranged} except those of "
                f"its outermost body; allowed: {others}"
            )
        self._ids = sorted(chosen)
        self._dofs = model.jnt_dofadr[self._ids].tolist()
        self._values = sim.batch.bind(self.quantity)

    def amounts(self) -> Array:
        """What is limited of each joint, [N, J]."""
        return self._values[:, self._dofs]

    def amount(self) -> Array:
        most: Array = np.abs(self.amounts()).max(axis=1)
        return most


@dataclass
class JointSpeed(JointLimit):
    """Joints turn slowly.

    Cost ``weight`` in each step at whose end a joint is faster than ``limit`` rad/s.
    """

    name = "jointspeed"
    quantity = "qvel"
    unit = "rad/s"

    limit: float = param(3.0, "highest speed that is free, rad/s; of slides m/s", low=0)


@dataclass
class JointTorque(JointLimit):
    """Actuators are not strained.

    Cost ``weight`` in each step at whose end actuators exert over ``limit`` N m on a joint.
    """

    name = "jointtorque"
    quantity = "qfrc_actuator"
    unit = "N m"

    limit: float = param(10.0, "highest torque that is free, N m; of slides N", low=0)


@dataclass
class JointLimits(JointLimit):
    """Joints keep away from the ends of their ranges.

    Cost ``weight`` in each step at whose end a joint is farther from the middle of its range than
    ``limit`` times half the range.
    """

    name = "jointlimits"
    quantity = "qpos"
    unit = "of the range"
    ranged = True

    limit: float = param(0.9, "share of the range that is free", above=0, high=1)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        low, high = sim.model.jnt_range[self._ids].T
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        self._places = sim.model.jnt_qposadr[self._ids].tolist()

    def amounts(self) -> Array:
        """Distance from the middle of the range, as a share of half of it, [N, J]."""
        return (self._values[:, self._places] - self._middle) / self._half


@dataclass
class BaseTilt(RobotLimit):
    """The outermost body stays upright.

    Cost ``weight`` in each step at whose end it leans by more than ``limit`` rad from how it
    stands in the file.
    """

    name = "basetilt"
    unit = "rad"

    limit: float = param(0.5, "greatest tilt that is free, rad", low=0)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        root = sim.model.body(sim.robot.root).id
        upright = mujoco.MjData(sim.model)
        mujoco.mj_kinematics(sim.model, upright)
        self._up = upright.xmat[root].reshape(3, 3)[2].copy()  # the vertical, in the body's frame
        self._vertical = sim.batch.bind("xmat")[:, root, 6:9]  # the same now, [N, 3]

    def amount(self) -> Array:
        """Angle between the vertical and what it was in the body's frame, [N] rad."""
        cosine = (self._vertical * self._up).sum(axis=1)
        angle: Array = np.arccos(np.minimum(np.maximum(cosine, -1.0), 1.0))
        return angle


@dataclass
class FloorContact(RobotLimit):
    """Bodies of the robot do not lean on the floor.

    Cost ``weight`` in each step at whose end the floor pushes one of its bodies with more than
    ``limit`` N.
    """

    name = "floorcontact"
    unit = "N"

    limit: float = param(1.0, "greatest force that is free, N", low=0)
    bodies: tuple[str, ...] = param(
        (), "names or patterns of the bodies that count, such as *_thigh; empty: the outermost"
    )

    def build(self, world: World) -> None:
        super().build(world)
        robot, start = world.robot, prefix(world.robot)
        root = world.spec.body(robot.root)
        names = [body.name for body in (root, *root.find_all("body"))]
        names = [name.removeprefix(start) for name in names if name]
        patterns, label = self.bodies or (robot.root.removeprefix(start),), f"{self.name}.bodies"
        self._felt = list(dict.fromkeys(n for p in patterns for n in matching(label, p, names)))
        for name in self._felt:
            world.feel(f"{self.name}/{name}", "world", force=True, by=start + name)

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._forces = [sim.sensor(f"{self.name}/{name}") for name in self._felt]  # [N, 3] N each

    def amount(self) -> Array:
        """The greatest net force of the floor on a body, [N] N."""
        squares = np.array([(force**2).sum(axis=1) for force in self._forces])
        most: Array = np.sqrt(squares).max(axis=0)
        return most


@dataclass
class SelfCollision(RobotLimit):
    """The robot does not hit itself.

    Cost ``weight`` in each step at whose end two of its bodies press on each other with more than
    ``limit`` N.
    """

    name = "selfcollision"
    unit = "N"

    limit: float = param(1.0, "greatest force that is free, N", low=0)

    def build(self, world: World) -> None:
        super().build(world)
        of_largest_force, slots = 2, 1
        world.spec.add_sensor(
            name=f"{self.name}/force",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_XBODY,  # in contact sensors: the body's whole subtree
            objname=world.robot.root,
            reftype=mujoco.mjtObj.mjOBJ_XBODY,
            refname=world.robot.root,
            intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), of_largest_force, slots],
        )

    def bind(self, sim: Simulation) -> None:
        super().bind(sim)
        self._force = sim.sensor(f"{self.name}/force")  # [N, 3] N, in the frame of the contact

    def amount(self) -> Array:
        """The greatest force of a contact between two of its bodies, [N] N."""
        strength: Array = np.sqrt((self._force**2).sum(axis=1))
        return strength

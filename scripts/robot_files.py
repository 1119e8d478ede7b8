"""Write the table of other packages' robots into docs/robot_files.md.

Each file comes from a wheel on PyPI, downloaded without its dependencies into a cache, and is
registered as it is. The last column is measured here: steps per second of a goal among eight
hazards with 30 rows on one thread, by the time that the thread had, as a share of Point's.
"""

import contextlib
import io
import math
import re
import runpy
import time
from collections.abc import Mapping
from fnmatch import fnmatch
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import mujoco

from sb3_guard.common.native import GuardVecEnv
from sb3_guard.envs import register_robot
from sb3_guard.envs.engine import Engine
from sb3_guard.envs.registry import ROBOTS
from sb3_guard.zoo.cli.markdown import table

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "robot_files.md"
BLOCK = re.compile(r"(<!-- robots -->\n).*?(<!-- end -->)", re.DOTALL)
MJLAB, CONTROL, ROBOTICS = "mjlab==1.6.0", "dm_control==1.0.50", "gymnasium-robotics==1.4.2"
ZOO = "mjlab/asset_zoo/robots"
KINOVA = "dm_control/third_party/kinova"
HAND = "gymnasium_robotics/envs/assets/hand"
ANYWHERE, ARMS = "Goal, Push, Chase, Defense", "Goal"
LINE = "Forward, with `robot={'heading': 0.0}`"


class Source(NamedTuple):
    """A robot that somebody else made."""

    wheel: str | None  # what pip downloads; None: Gymnasium is installed
    file: str  # in the wheel
    needed: Mapping[str, Any]  # what register_robot is told
    tasks: str  # which make sense
    gains: tuple[float, float] | None = None  # of servos that the file lacks: N m/rad, N m s/rad
    pose: Mapping[str, float] = {}  # of the keyframe that it lacks: joints by patterns, rad


LEGS = {"*_thigh_joint": 0.9, "*_calf_joint": -1.8}
SOURCES = {
    "Go1": Source(MJLAB, f"{ZOO}/unitree_go1/xmls/go1.xml", {}, ANYWHERE, (35, 1), LEGS),
    "G1": Source(MJLAB, f"{ZOO}/unitree_g1/xmls/g1.xml", {}, ANYWHERE, (75, 2)),
    "Yam": Source(MJLAB, f"{ZOO}/i2rt_yam/xmls/yam.xml", {"center": "grasp_site"}, ARMS, (40, 10)),
    "Quadruped": Source(CONTROL, "dm_control/suite/quadruped.xml", {"root": "torso"}, ANYWHERE),
    "Jaco": Source(CONTROL, f"{KINOVA}/jaco_arm.xml", {"center": "wristsite"}, ARMS, (200, 40)),
    "ShadowHand": Source(ROBOTICS, f"{HAND}/reach.xml", {"center": "robot0:S_fftip"}, ARMS),
    "GymAnt": Source(None, "ant.xml", {}, ANYWHERE),
    "GymHalfCheetah": Source(None, "half_cheetah.xml", {}, LINE),
    "GymHopper": Source(None, "hopper.xml", {}, LINE),
    "GymWalker2d": Source(None, "walker2d.xml", {}, LINE),
    "GymSwimmer": Source(None, "swimmer.xml", {}, ANYWHERE),
    "GymHumanoid": Source(None, "humanoid.xml", {}, ANYWHERE),
}


def path(source: Source) -> Path:
    """The file, downloaded if need be.

    :raises subprocess.CalledProcessError: there is no index
    """
    if source.wheel is None:
        return Path(str(files("gymnasium.envs.mujoco") / "assets" / source.file))
    with contextlib.redirect_stdout(io.StringIO()):
        fetch = runpy.run_path(str(ROOT / "scripts" / "robots.py"))["fetch"]
    folder: Path = fetch(source.wheel)
    return folder / source.file


def robot(source: Source) -> Path | mujoco.MjSpec:
    """The file, or its MjSpec with servos and a keyframe where it lacks them."""
    if source.gains is None:
        return path(source)
    spec = mujoco.MjSpec.from_file(str(path(source)))
    # the files leave it at Euler, with which servos on light links diverge
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    kinds, (kp, kv) = mujoco.mjtJoint, source.gains
    for joint in spec.joints:
        if joint.type in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE):
            servo = spec.add_actuator(
                name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
            )
            limited = joint.range[0] < joint.range[1]
            servo.set_to_position(kp=kp, kv=kv, inheritrange=limited)
            if not limited:
                servo.ctrlrange = [-math.pi, math.pi]
    if source.pose:
        data = mujoco.MjData(spec.compile())
        data.qpos[2] = 0.0
        for joint in spec.joints:
            for pattern, position in source.pose.items():
                if fnmatch(joint.name, pattern):
                    data.joint(joint.name).qpos = position
        spec.add_key(name="home", qpos=data.qpos)
    return spec


def observed(engine: Engine) -> str:
    """How many numbers of the robot are observed."""
    names = [n for n in engine.observation_layout if n not in ("goal_compass", "hazards_lidar")]
    return str(sum(engine.channels[n].size for n in names))


def main() -> None:
    """Write the table."""
    import bench_engine  # beside this file, which tests run for its SOURCES

    rows = []
    for name, source in SOURCES.items():
        register_robot(name, xml=robot(source), **source.needed)
        envs = {r: GuardVecEnv(f"Goal_{r}_8Hazards", 30, num_threads=1) for r in ("Point", name)}
        engine = envs[name].envs.engine
        steps = {robot: bench_engine.stepper(env) for robot, env in envs.items()}
        speed = bench_engine.best(steps, seconds=2.0, slices=10, clock=time.thread_time)
        stated = ", ".join([
            *(["servos, kp {:g}, kv {:g}".format(*source.gains)] if source.gains else []),
            *(["a keyframe"] if source.pose else []),
            *(f"`{key}={value!r}`" for key, value in source.needed.items()),
        ])  # fmt: skip
        where = (source.wheel or "gymnasium").partition("==")[0]
        rows.append(
            [f"`{Path(source.file).name}` of {where}", stated or "nothing", source.tasks,
             str(engine.robot.action_size), observed(engine),
             f"{speed[name] / speed['Point']:.2f}"]
        )  # fmt: skip
        ROBOTS.pop(name)
    head = ["file", "what was needed", "tasks that make sense", "actions", "numbers observed",
            "speed"]  # fmt: skip
    text = PAGE.read_text()
    PAGE.write_text(BLOCK.sub(lambda m: m[1] + table(head, rows) + "\n" + m[2], text))


if __name__ == "__main__":
    main()

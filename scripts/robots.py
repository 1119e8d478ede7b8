"""Robots of other packages, from their files as they are, for ``--gym-packages robots``."""

import subprocess
import sys
import zipfile
from fnmatch import fnmatch
from pathlib import Path

import mujoco

from sb3_guard import Scenario, register, register_robot

CACHE = Path.home() / ".cache" / "sb3_guard"


def fetch(requirement: str) -> Path:
    """The folder of an unpacked wheel from PyPI, without the packages that it depends on."""
    folder = CACHE / requirement
    if not folder.is_dir():
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", requirement]
        subprocess.run([*pip, "--dest", str(CACHE)], check=True)
        name, version = requirement.split("==")
        (wheel,) = CACHE.glob(f"{name.replace('-', '_')}-{version}-*.whl")
        zipfile.ZipFile(wheel).extractall(folder.with_name("unpacking"))
        folder.with_name("unpacking").rename(folder)
    return folder


def add_servos(spec: mujoco.MjSpec, gains: dict[str, tuple[float, float, float]]) -> None:
    """Position servos of the joints that a pattern matches: N m/rad, N m s/rad, limit N m."""
    for joint in spec.joints:
        for pattern, (kp, kv, force) in gains.items():
            if fnmatch(joint.name, pattern):
                servo = spec.add_actuator(name=joint.name, target=joint.name)
                servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
                servo.set_to_position(kp=kp, kv=kv, inheritrange=True)
                servo.forcerange = [-force, force]  # 0: without a limit


def add_pose(spec: mujoco.MjSpec, pose: dict[str, float]) -> mujoco.MjData:
    """A keyframe with these positions of joints, rad; a robot in the floor is put onto it."""
    data = mujoco.MjData(spec.compile())
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            data.qpos[2] = 0.0
        for pattern, position in pose.items():
            if fnmatch(joint.name, pattern):
                data.joint(joint.name).qpos = position
    spec.add_key(name="home", qpos=data.qpos)
    return data


zoo = fetch("mjlab==1.6.0") / "mjlab" / "asset_zoo" / "robots"
go1 = mujoco.MjSpec.from_file(str(zoo / "unitree_go1" / "xmls" / "go1.xml"))
go1.option.timestep, go1.option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
add_servos(go1, {"*_hip_joint": (16, 1, 23.7), "*_thigh_joint": (16, 1, 23.7),
                 "*_calf_joint": (36, 2.3, 35.6)})  # fmt: skip
stand = add_pose(go1, {"*_thigh_joint": 0.9, "*_calf_joint": -1.8})
for servo in go1.actuators:  # actions are offsets from the stand, up to 0.5 rad
    rest = stand.joint(servo.name).qpos[0]
    servo.inheritrange, servo.ctrlrange = 0, [rest - 0.5, rest + 0.5]
register_robot("Go1", xml=go1, frame_skip=8)  # 25 actions a second
limits = {"basetilt": {"limit": 0.3}, "floorcontact": {"ends": True}}
register("WalkingGo1-v0", Scenario(robot="Go1", constraints=limits))

yam = mujoco.MjSpec.from_file(str(zoo / "i2rt_yam" / "xmls" / "yam.xml"))
yam.option.timestep, yam.option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
add_servos(yam, {"joint[123]": (40, 20, 28), "joint[456]": (5, 5, 0)})
add_pose(yam, {"joint[23]": 1.0})
register_robot("Yam", xml=yam, center="grasp_site", frame_skip=8)
register("ReachingYam-v0", Scenario(robot="Yam", constraints={"jointspeed": {"limit": 3.0}}))
print("registered WalkingGo1-v0 and ReachingYam-v0")

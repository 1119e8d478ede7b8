"""Robots of other packages, from their files as they are, for ``--gym-packages robots``."""

import subprocess
import sys
import zipfile
from pathlib import Path

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


zoo = fetch("mjlab==1.6.0") / "mjlab" / "asset_zoo" / "robots"
legs = {"kp": 16, "kd": 1, "force": 23.7}  # N m/rad, N m s/rad, N m
go1 = {"actuators": {"*": legs, "*_calf_joint": {"kp": 36, "kd": 2.3, "force": 35.6}}}
go1 |= {"timestep": 0.005, "frame_skip": 8, "action_scale": 0.5}  # 25 actions a second
go1 |= {"pose": {"*_thigh_joint": 0.9, "*_calf_joint": -1.8}, "action": "offset"}
register_robot("Go1", xml=zoo / "unitree_go1" / "xmls" / "go1.xml", **go1)
limits = {"basetilt": {"limit": 0.3}, "floorcontact": {"ends": True}}
register("WalkingGo1-v0", Scenario(robot="Go1", constraints=limits))

joints = {"joint[123]": {"kp": 40, "kd": 20, "force": 28}, "joint[456]": {"kp": 5, "kd": 5}}
yam = {"actuators": joints, "pose": {"joint[23]": 1.0}, "center": "grasp_site"}
yam |= {"timestep": 0.005, "frame_skip": 8}
register_robot("Yam", xml=zoo / "i2rt_yam" / "xmls" / "yam.xml", **yam)
register("ReachingYam-v0", Scenario(robot="Yam", constraints={"jointspeed": {"limit": 3.0}}))
print("registered WalkingGo1-v0 and ReachingYam-v0")

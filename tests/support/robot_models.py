"""MJCF files of robots as others might have written them, and what MjSpec adds to them."""

import math

import mujoco


def add_servos(spec, kp=40.0, kv=2.0, joints=None):
    """Position servos of hinges and slides, within their ranges or half a turn either way."""
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # they diverge with Euler
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE or joint.name not in (joints or [joint.name]):
            continue
        servo = spec.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        limited = joint.range[0] < joint.range[1]
        servo.set_to_position(kp=kp, kv=kv, inheritrange=limited)
        if not limited:
            servo.ctrlrange = [-math.pi, math.pi]
    return spec


def add_pose(spec, **joints):
    """A keyframe with these positions, rad or m; a free robot is on the floor."""
    data = mujoco.MjData(spec.compile())
    for name, value in joints.items():
        data.joint(name).qpos = value
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            data.joint(joint.id).qpos[2] = 0.0
    spec.add_key(name="home", qpos=data.qpos)
    return spec


# a dog of two legs whose file is in degrees, beside a ball on a floor of its own
DOG = """
<mujoco>
  <option timestep="0.004"/>
  <default><geom density="200"/><general dyntype="filter" gainprm="3"/></default>
  <worldbody>
    <light pos="0 0 5"/>
    <geom name="ground" type="plane" size="5 5 1"/>
    <body name="ball" pos="2 0 1"><freejoint name="ball"/><geom name="ball" size="0.1"/></body>
    <body name="trunk" pos="3 1 2">
      <freejoint/>
      <light pos="0 0 1"/>
      <geom name="trunk" type="box" size="0.3 0.2 0.05"/>
      <site name="imu"/>
      <body name="front" pos="0.25 0 0">
        <joint name="front_thigh" axis="0 1 0" range="-45 90" limited="true"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.2"/>
        <body name="front_calf" pos="0 0 -0.2">
          <joint name="front_calf" axis="0 1 0" range="-150 -30" limited="true"/>
          <geom name="front_foot" type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2"/>
        </body>
      </body>
      <body name="back" pos="-0.25 0 0">
        <joint name="back_thigh" axis="0 1 0" range="-45 90" limited="true"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.2"/>
      </body>
      <body name="fan" pos="0 0 0.06">
        <joint name="fan"/>
        <geom type="box" size="0.1 0.01 0.01" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <sensor>
    <gyro name="imu_gyro" site="imu"/>
    <jointpos name="fan_angle" joint="fan"/>
    <framepos name="to_ball" objtype="body" objname="trunk" reftype="body" refname="ball"/>
  </sensor>
  <keyframe>{keys}</keyframe>
</mujoco>
"""

ARM = """
<mujoco>
  <worldbody>
    <body name="base" pos="4 5 0">
      <geom type="cylinder" size="0.05 0.05" pos="0 0 0.05"/>
      <body name="upper" pos="0 0 0.1">
        <joint name="turn" axis="0 0 1"/>
        <joint name="lift" axis="0 1 0" range="-90 90" limited="true"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3" density="500"/>
        <body name="lower" pos="0 0 0.3">
          <joint name="elbow" axis="0 1 0" range="-120 120" limited="true"/>
          <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.2" density="500"/>
          <site name="hand" pos="0 0 0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

"""A robot of a file behaves as its file does in MuJoCo: files, options, floor, keyframe."""

import struct
import zlib

import mujoco
import numpy as np
import pytest
from worlds import own_parts

from sb3_guard.envs import Scenario, register_robot
from sb3_guard.envs.registry import ROBOTS

ROW = np.zeros(1, dtype=int)
WEDGE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3"


def png():
    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", 2, 2, 8, 2, 0, 0, 0)
    rows = zlib.compress((b"\0" + b"\x80" * 6) * 2)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def robot(inner='<geom type="mesh" mesh="m"/>', outer="", compiler=""):
    return f"""<mujoco>{compiler}{outer}<worldbody><body name="robot"><freejoint/>
      <geom size="0.1"/><body><joint name="j"/>{inner}</body></body></worldbody>
      <actuator><motor joint="j" ctrlrange="-1 1"/></actuator></mujoco>"""


def arm(folder="", inner="", outer="", mesh="m.obj"):
    return f"""<mujoco model="arm"><compiler meshdir="{folder}"/><asset>{outer}
      <mesh name="m" file="{mesh}"/></asset><worldbody><body name="link">
      <geom type="mesh" mesh="m"/>{inner}</body></worldbody></mujoco>"""


MESH = '<asset><mesh name="m" file="m.obj"/></asset>'
PAINTED = """<asset><mesh name="m" file="m.obj"/><texture name="t" type="2d" file="t.png"/>
    <material name="t" texture="t"/></asset>"""
SIDES = " ".join(
    f'file{side}="/x/t.png"' for side in ("right", "left", "up", "down", "front", "back")
)
CUBE = f'<asset><texture name="t" type="cube" {SIDES}/><material name="t" texture="t"/></asset>'
MODEL = '<asset><model name="arm" file="arm/arm.xml"/></asset>'
ATTACH = '<attach model="arm" body="link" prefix="a_"/>'
HAND = '<model name="hand" file="hand/hand.xml"/>'
HELD = '<attach model="hand" body="link" prefix="h_"/>'
LAYOUTS = {
    "beside": {"r.xml": robot(outer=MESH), "m.obj": WEDGE},
    "meshdir": {"r.xml": robot(outer=MESH, compiler='<compiler meshdir="s"/>'), "s/m.obj": WEDGE},
    "assetdir": {
        "r.xml": robot(outer=PAINTED, compiler='<compiler assetdir="s"/>'),
        "s/m.obj": WEDGE,
        "s/t.png": png(),
    },
    "two folders": {
        "r.xml": robot(outer=PAINTED, compiler='<compiler meshdir="s" texturedir="../t"/>'),
        "s/m.obj": WEDGE,
        "../t/t.png": png(),
    },
    "strippath": {
        "r.xml": robot(
            outer=MESH.replace("m.obj", "/x/m.obj"),
            compiler='<compiler strippath="true" meshdir="s"/>',
        ),
        "s/m.obj": WEDGE,
    },
    "strippath of a cube": {
        "r.xml": robot(
            '<geom size="0.1" material="t"/>', CUBE, '<compiler strippath="true" texturedir="s"/>'
        ),
        "s/t.png": png(),
    },
    "include": {
        "r.xml": robot(outer='<include file="sub/i.xml"/>'),
        "sub/i.xml": f"<mujocoinclude>{MESH}</mujocoinclude>",
        "m.obj": WEDGE,
    },
    "included beside": {
        "r.xml": robot(outer='<include file="sub/i.xml"/>'),
        "sub/i.xml": f"<mujocoinclude>{MESH}</mujocoinclude>",
        "sub/m.obj": WEDGE,
    },
    "attach": {"r.xml": robot(ATTACH, MODEL), "arm/arm.xml": arm(), "arm/m.obj": WEDGE},
    "attach, meshdir in both": {
        "r.xml": robot(ATTACH, MODEL, '<compiler meshdir="q"/>'),
        "arm/arm.xml": arm("v"),
        "arm/v/m.obj": WEDGE,
    },
    "attach, strippath": {
        "r.xml": robot(ATTACH, MODEL, '<compiler strippath="true"/>'),
        "arm/arm.xml": arm("v"),
        "arm/v/m.obj": WEDGE,
    },
    "attach in what is attached": {
        "r.xml": robot(ATTACH, MODEL, '<compiler meshdir="q"/>'),
        "arm/arm.xml": arm("v", HELD, HAND),
        "arm/v/m.obj": WEDGE,
        "arm/hand/hand.xml": arm("w"),
        "arm/hand/w/m.obj": WEDGE,
    },
    "include in what is attached": {
        "r.xml": robot(ATTACH, MODEL),
        "arm/arm.xml": """<mujoco><include file="i.xml"/><worldbody><body name="link">
          <geom type="mesh" mesh="m"/></body></worldbody></mujoco>""",
        "arm/i.xml": f"<mujocoinclude>{MESH}</mujocoinclude>",
        "arm/m.obj": WEDGE,
    },
    "attach in an include": {
        "r.xml": robot(ATTACH, '<include file="sub/i.xml"/>'),
        "sub/i.xml": f"<mujocoinclude>{MODEL}</mujocoinclude>",
        "sub/arm/arm.xml": arm(),
        "sub/arm/m.obj": WEDGE,
    },
}  # fmt: skip


@pytest.mark.parametrize(
    ("layout", "given"),
    [
        *((layout, "a path") for layout in LAYOUTS),
        *((layout, "an MjSpec") for layout in ("strippath", "attach in what is attached")),
    ],
)
def test_what_mujoco_finds_is_found(layout, given, tmp_path):
    for name, content in LAYOUTS[layout].items():
        path = tmp_path / "here" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    path = tmp_path / "here" / "r.xml"
    theirs = mujoco.MjSpec.from_file(str(path)).compile()
    with own_parts():
        xml = path if given == "a path" else mujoco.MjSpec.from_file(str(path))
        register_robot("Finder", xml=xml)
        engine = Scenario(robot="Finder").build()
        model = engine.model
        if layout != "strippath of a cube":  # whose sides MuJoCo does not tell
            again = mujoco.MjModel.from_xml_string(engine.spec.to_xml())
            assert again.nmeshvert == model.nmeshvert
    assert theirs.nmesh == model.nmesh and theirs.nmesh + theirs.ntex > 0
    np.testing.assert_array_equal(theirs.mesh_vert, model.mesh_vert)
    assert model.ntex - theirs.ntex == 2  # the arena's


OPTIONS = {
    "none": "",
    "defaults": '<option integrator="Euler" jacobian="auto" gravity="0 0 -9.81"/>',
    "others": """<option timestep="0.003" impratio="10" gravity="0 0.1 -3" wind="1 0 0"
      density="1.2" magnetic="0 0.1 0" viscosity="1e-5" integrator="RK4" cone="elliptic"
      jacobian="sparse" solver="CG" iterations="17" tolerance="1e-9" ls_iterations="12"
      ls_tolerance="0.02" noslip_iterations="3" noslip_tolerance="1e-5" ccd_iterations="20"
      ccd_tolerance="1e-5"
      sdf_iterations="11" sdf_initpoints="41" o_margin="0.01" o_solref="0.03 1"
      o_friction="1 1 0.01 0.001 0.001" actuatorgroupdisable="5">
        <flag eulerdamp="disable" filterparent="disable" energy="enable" override="enable"/>
    </option>""",
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("complete", [False, True])
def test_every_option_of_a_file_holds(options, complete, tmp_path, capfd):
    text = robot('<geom size="0.1"/>', options)
    text = text.replace("<worldbody>", '<worldbody><geom type="plane" size="1 1 1"/>')
    (tmp_path / "r.xml").write_text(text)
    theirs = mujoco.MjModel.from_xml_path(str(tmp_path / "r.xml")).opt
    with own_parts():
        register_robot("Optional", xml=tmp_path / "r.xml", complete=complete)
        ours = Scenario(robot="Optional").build().model.opt
        arena = {"integrator": "implicit", "timestep": 0.001}
        stated = Scenario(robot="Optional", arena=arena).build().model.opt
    names = [n for n in dir(theirs) if not n.startswith("_") and not callable(getattr(theirs, n))]
    assert len(names) >= 28
    for name in names:
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    assert (stated.integrator, stated.timestep) == (mujoco.mjtIntegrator.mjINT_IMPLICIT, 0.001)
    assert capfd.readouterr().err == ""


# a monopod whose foot meets the floor by a pair, on a floor with a part in every contact
HOPPER = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <worldbody>
    {floor}
    <body name="wall" pos="3 0 0.3"><geom name="wall" size="0.01"/></body>
    <body name="robot" pos="0 0 0.5">
      <freejoint name="root"/>
      <geom name="trunk" type="box" size="0.2 0.2 0.05" contype="{bits}" conaffinity="{bits}"/>
      <body name="leg" pos="0 0 -0.05">
        <joint name="knee" axis="0 1 0" range="{knee}" limited="true" damping="1"/>
        <geom name="foot" type="box" size="0.15 0.15 0.02" pos="0 0 -0.2" {foot}/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="knee" joint="knee" kp="300" kv="5" timeconst="0.2" ctrlrange="-1 1"/>
  </actuator>
  {more}
</mujoco>
"""
FLOOR = '<geom name="ground" type="plane" size="5 5 1" {}/>'
PLAIN = FLOOR.format("")
NO_BITS = 'contype="0" conaffinity="0"'
PAIR = """<contact>
  <pair name="sole" geom1="foot" geom2="ground" condim="6" friction="0.3 0.4 0.01 0.002 0.003"
    solref="0.01 0.9" solimp="0.8 0.9 0.002 0.4 3" margin="0.003" gap="0.001"
    solreffriction="0.03 1.1"/>
  <pair name="bump" geom1="foot" geom2="wall"/>
</contact>
<sensor>
  <contact name="felt" geom1="foot" geom2="ground" data="found"/>
  <distance name="gap" geom1="ground" geom2="foot" cutoff="1"/>
</sensor>"""


@pytest.fixture
def monopod(tmp_path):
    def write(floor=PLAIN, foot="", more="", bits=0, knee="-1 1"):
        path = tmp_path / "monopod.xml"
        path.write_text(HOPPER.format(floor=floor, foot=foot, more=more, bits=bits, knee=knee))
        ROBOTS.pop("Monopod", None)
        register_robot("Monopod", xml=path, lidar_bodies=["robot"])
        place = {"heading": 0.0, "locations": [[0.0, 0.0]]}
        engine = Scenario(robot="Monopod", robot_params=place).build()
        engine.reset(ROW)
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        return engine, model, data

    with own_parts():
        yield write


def moves_alike(engine, model, data, steps=100, atol=1e-6):
    """Step both from our start, with the first control of MuJoCo's."""
    data.qpos[:], data.qvel[:] = engine.batch.bind("qpos")[0], engine.batch.bind("qvel")[0]
    data.act[:] = engine.batch.bind("act")[0]
    for _ in range(steps):
        engine.step(np.atleast_2d(data.ctrl))
        mujoco.mj_step(model, data, engine.batch.frame_skip)
    np.testing.assert_allclose(engine.batch.bind("qpos")[0], data.qpos, atol=atol)


def test_a_pair_with_the_files_floor_becomes_one_with_the_arenas(monopod):
    engine, model, data = monopod(foot=NO_BITS, more=PAIR)
    ours, pair = engine.model, model.pair("sole")
    assert ours.npair == 1 and "pair foot wall" in ROBOTS["Monopod"].model_file().left_out
    ends = {ours.geom(int(g)).name for g in (ours.pair_geom1[0], ours.pair_geom2[0])}
    assert ends == {"floor", "robot/foot"}
    for name in ("dim", "friction", "solref", "solimp", "margin", "gap", "solreffriction"):
        np.testing.assert_array_equal(
            getattr(ours, f"pair_{name}")[0], getattr(model, f"pair_{name}")[pair.id], err_msg=name
        )
    moves_alike(engine, model, data)
    assert engine.robot.position[0, 2] > 0.2
    felt = engine.observe(np.float64)[0, engine.observation_layout["felt"]]
    gap = engine.observe(np.float64)[0, engine.observation_layout["gap"]]
    assert felt[0] > 0 and abs(gap[0]) < 0.01


@pytest.mark.parametrize(
    "part",
    [
        'friction="0.2 0.01 0.001" priority="1"',
        'margin="0.02" gap="0.01" solmix="9" solref="0.1 1"',
        'pos="0 0 0.3"',
        'pos="0 0 -0.3" contype="2" conaffinity="2"',
    ],
)
def test_the_arenas_floor_has_the_files_part_in_contacts(part, monopod):
    bits = 'contype="2" conaffinity="0"' if "contype" in part else ""
    key = '<keyframe><key name="home" qpos="0 0 {} 1 0 0 0 0" qvel="0.5 0 0 0 0 0 0"/></keyframe>'
    height = {"0.3": 0.6, "-0.3": 0.0}.get(part.split('"')[1].split(" ")[-1], 0.3)
    engine, model, data = monopod(
        FLOOR.format(part), bits or 'friction="0.5"', key.format(height), bits=1
    )
    ours, foot = engine.model, engine.model.geom("robot/foot")
    floor, ground = ours.geom("floor"), model.geom("ground")
    for name in ("friction", "priority", "condim", "solref", "solimp", "solmix", "margin", "gap"):
        np.testing.assert_array_equal(getattr(floor, name), getattr(ground, name), err_msg=name)
    assert foot.conaffinity & floor.contype or foot.contype & floor.conaffinity
    trunk = ours.geom("robot/trunk")
    meets = bool(trunk.conaffinity & floor.contype or trunk.contype & floor.conaffinity)
    assert meets == ("contype" not in part)  # as in the file
    shift = ground.pos[2]
    data.qpos[:] = model.key("home").qpos
    data.qvel[:] = model.key("home").qvel
    assert engine.batch.bind("qpos")[0, 2] == pytest.approx(data.qpos[2] - shift, abs=1e-12)
    for _ in range(60):
        engine.step(np.zeros((1, 1)))
        mujoco.mj_step(model, data, engine.batch.frame_skip)
    expected = data.qpos - [0, 0, shift, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(engine.batch.bind("qpos")[0], expected, atol=1e-5)


def test_a_robot_that_meets_no_floor_of_its_file_is_refused(monopod):
    with pytest.raises(ValueError, match="no geom that meets the floor"):
        monopod(FLOOR.format(NO_BITS), NO_BITS)


def test_friction_that_is_drawn_scales_pairs_with_the_floor(monopod):
    monopod(foot=NO_BITS, more=PAIR)
    params = {"heading": 0.0, "locations": [[0.0, 0.0]], "friction": 0.5}
    engine = Scenario(robot="Monopod", robot_params=params).build()
    assert engine.model.npair == 1
    np.testing.assert_allclose(
        engine.batch.expand("pair_friction")[0, 0], 0.5 * engine.model.pair_friction[0]
    )


KEY = """<keyframe><key name="home" qpos="0 0 0.6 1 0 0 0 0.3" qvel="0.4 0 0 0 0 0.2 0.1"
    ctrl="0.3" act="0.25"/></keyframe>"""


@pytest.mark.parametrize("height", [0.6, 0.295])  # in the air, and 1 cm in the floor
def test_a_keyframe_is_the_whole_state(height, monopod):
    engine, model, data = monopod(more=KEY.replace("0.6", str(height)), bits=1)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for name in ("qpos", "qvel", "act", "ctrl"):
        np.testing.assert_array_equal(engine.batch.bind(name)[0], getattr(data, name), err_msg=name)
    moves_alike(engine, model, data)


def test_velocities_of_a_keyframe_turn_with_the_heading(monopod):
    monopod(more=KEY, bits=1)
    engine = Scenario(robot="Monopod", robot_params={"heading": np.pi / 2}).build()
    engine.reset(ROW)
    np.testing.assert_allclose(engine.batch.bind("qvel")[0, :6], [0, 0.4, 0, 0, 0, 0.2], atol=1e-12)


def test_a_filtered_servo_holds_the_first_pose_without_a_keyframe(monopod):
    engine, *_ = monopod(bits=1, knee="0.3 1")
    middle = engine.batch.bind("qpos")[0, 7]
    assert middle == pytest.approx(0.65)
    assert engine.batch.bind("act")[0, 0] == engine.batch.bind("ctrl")[0, 0] == middle
    for _ in range(50):
        engine.step(np.full((1, 1), middle))
    assert engine.batch.bind("qpos")[0, 7] == pytest.approx(middle, abs=0.05)

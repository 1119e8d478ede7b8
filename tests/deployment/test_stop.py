"""What stops a robot whose connection is lost, in contract.json and in the example's loop."""

import json
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from cost_envs import CostPoint
from robot_models import ARM, add_servos
from worlds import own_parts

import sb3_guard
from sb3_guard.deployment.contract import stops

EXAMPLE = Path(__file__).parents[2] / "examples" / "deploy.py"
LOST = 60  # the step after which no message arrives


def arm(path: Path, *, keys: str = "") -> mujoco.MjSpec:
    path.write_text(ARM.replace("</mujoco>", f"<keyframe>{keys}</keyframe></mujoco>"))
    return mujoco.MjSpec.from_file(str(path))


def exported(spec: mujoco.MjSpec, path: Path, **kwargs: Any) -> dict[str, Any]:
    """The contract of an untrained agent of a robot; the robot is registered as Arm."""
    sb3_guard.register_robot("Arm", xml=spec, center="hand")
    parts: Any = {"env_kwargs": {"hazards": None}, "n_envs": 2, "n_steps": 20, "seed": 0}
    model = sb3_guard.make_model("cpo", "Goal_Arm_1Hazards", **parts)
    return sb3_guard.export(model, path, **kwargs)


class Watched(gymnasium.Wrapper):
    """Notes controls and joints after each step."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.controls: list[np.ndarray] = []
        self.joints: list[np.ndarray] = []

    def step(self, action: np.ndarray) -> Any:
        out, batch = self.env.step(action), self.env.unwrapped.engine.batch  # type: ignore
        self.controls.append(batch.bind("ctrl")[0].copy())
        self.joints.append(batch.bind("qpos")[0, :3].copy())
        return out


class Reaching:
    """Stands in for a trained policy: it always asks for one pose."""

    def run(self, outputs: list[str], inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        return [np.array([[0.4, -0.7, 0.6]], np.float32)]


def test_a_lost_connection_does_not_move_an_arm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["deploy.py"])
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    make = sb3_guard.make
    monkeypatch.setattr(sb3_guard, "make", lambda *args, **kwargs: Watched(make(*args, **kwargs)))
    code = EXAMPLE.read_text().replace("rng.random() < 0.05", f"len(costs) >= {LOST}")
    with own_parts():
        exported(add_servos(arm(tmp_path / "arm.xml")), tmp_path / "policy.onnx")
        monkeypatch.setattr("onnxruntime.InferenceSession", lambda path: Reaching())
        loop: dict[str, Any] = {}
        exec(compile(code, str(EXAMPLE), "exec"), loop)
    controls, joints = np.array(loop["robot"].controls), np.array(loop["robot"].joints)
    assert loop["stops"] > 100 and np.abs(controls[LOST - 1]).min() > 0.1
    np.testing.assert_allclose(controls[LOST:], np.tile(controls[LOST - 1], (500 - LOST, 1)))
    assert np.abs(joints[LOST:] - joints[LOST - 1]).max() < 0.05  # rad


KINDS = """
<mujoco>
  <worldbody>
    <body name="robot">
      <joint name="x" type="slide" axis="1 0 0"/>
      <geom size="0.1" pos="0 0 0.1"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="x" kp="5" ctrlrange="-2 2"/>
    <position name="filtered" joint="x" kp="5" timeconst="0.2" ctrlrange="-2 2"/>
    <general name="gripper" joint="x" ctrlrange="0 255" gainprm="0.01" biastype="affine"
      biasprm="0 -100 -10"/>
    <motor name="motor" joint="x" ctrlrange="-1 3"/>
    <velocity name="velocity" joint="x" kv="2" ctrlrange="-1 1"/>
    <intvelocity name="rate" joint="x" kp="5" ctrlrange="-1 1" actrange="-2 2"/>
    <motor name="pump" joint="x" ctrlrange="1 3"/>
  </actuator>
  <keyframe>KEYS</keyframe>
</mujoco>
"""
NAMES = ("servo", "filtered", "gripper", "motor", "velocity", "rate", "pump")
KINDS_STOP = ["hold", "hold", "hold", 0.0, 0.0, 0.0, 1.0]
STATED = '<key name="stop" ctrl="0.5 0.5 51 1 0 0 2"/>'


@pytest.mark.parametrize(
    ("keys", "stop", "expected"),
    [
        ("", {}, KINDS_STOP),
        ('<key name="home" ctrl="1 1 51 1 1 1 2"/>', {}, KINDS_STOP),  # where episodes begin
        (STATED, {}, [0.5, 0.5, 51.0, 1.0, 0.0, 0.0, 2.0]),
        (STATED, {"servo": "hold", "motor": -1}, ["hold", 0.5, 51.0, -1, 0.0, 0.0, 2.0]),
    ],
)
def test_the_stop_of_each_actuator(keys: str, stop: dict[str, Any], expected: list[Any]) -> None:
    spec = mujoco.MjSpec.from_string(KINDS.replace("KEYS", keys))
    with own_parts():
        sb3_guard.register_robot("Kinds", xml=spec)
        model = sb3_guard.make_model("cpo", "Goal_Kinds_1Hazards", n_envs=1, seed=0)
        env: Any = model.get_env()
        sent = stops(model, env, stop)
        assert [part.name for part in env.unwrapped.envs.actuators] == [*NAMES]
        assert sent["control"] == expected
        held = [value == "hold" for value in expected]
        assert [value == "hold" for value in sent["action"]] == held
        values = [0.0 if hold else value for value, hold in zip(sent["action"], held, strict=True)]
        engine = env.unwrapped.envs.engine
        controls = engine.robot.to_controls(np.array([values]))[0]
        np.testing.assert_allclose(controls[~np.array(held)], [v for v in expected if v != "hold"])
        if keys == STATED:  # it is not where episodes begin
            assert not engine.robot._start["ctrl"].any()
        for bad, words in (
            ({"moter": 0.0}, "no actuator 'moter'.*'motor'"),
            ({"motor": 4.0}, "stop of 'motor' is 4.0: it must be from -1 to 3, or 'hold'"),
            ({"motor": "stay"}, "'stay'"),
            ({"motor": float("nan")}, "nan"),
        ):
            with pytest.raises(ValueError, match=words):
                stops(model, env, bad)


def test_of_other_environments_the_user_says_what_stops_them(tmp_path: Path) -> None:
    model = sb3_guard.CPO("MlpPolicy", CostPoint(), n_steps=20, cost_limit=1.0, device="cpu")
    path = tmp_path / "policy.onnx"
    assert stops(model, model.env, {})["action"] == [None, None]
    stop: dict[str, Any] = {"0": 0.0, "1": "hold"}
    contract = sb3_guard.export(model, path, stop=stop)
    assert contract["outputs"][0]["stop"] == [0.0, "hold"]
    assert json.loads((tmp_path / "contract.json").read_text()) == contract

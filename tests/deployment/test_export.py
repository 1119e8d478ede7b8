"""Exported agents act as ``predict`` does, also where there is no torch; others are refused."""

import hashlib
import json
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import onnx
import onnxruntime
import pytest
import torch as th
from cost_envs import CostPoint, RandomCostEnv
from gymnasium import spaces
from gymnasium.wrappers import NormalizeObservation, NormalizeReward
from robot_models import DOG, add_pose, add_servos
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize
from worlds import own_parts

import sb3_guard
from sb3_guard import CPO, PPOLag, SACLag, TD3Lag, TQCLag
from sb3_guard.algorithms import ALGORITHMS, TRPOSL
from sb3_guard.deployment.onnx_file import agreement, check, predicted

#: The operators of a plain multilayer perceptron, as docs/deploying.md lists them.
PLAIN = {"Cast", "Sub", "Div", "Clip", "Gemm", "Tanh", "Max", "Min", "Add", "Mul"}
ON_POLICY: dict[str, Any] = {"n_steps": 40, "seed": 0, "device": "cpu", "cost_limit": 1.0}
OFF_POLICY: dict[str, Any] = {
    "learning_starts": 60, "seed": 0, "device": "cpu", "cost_limit": 1.0, "batch_size": 16
}  # fmt: skip
LOPSIDED = spaces.Box(np.array([-2.0, 0.0]), np.array([0.5, 3.0]), dtype=np.float32)


def points(n_envs: int = 10, normalize: bool = True, **kwargs: Any) -> VecEnv:
    """A point that walks near a hazard, with observation statistics."""
    options = {"episode_length": 30, "hazard": (-1.0, 0.0), **kwargs}
    env = make_vec_env(lambda: CostPoint(**options), n_envs, seed=0)
    return VecNormalize(env, norm_reward=False) if normalize else env


def noisy(observations: spaces.Space, actions: spaces.Space, n_envs: int = 2) -> VecEnv:
    return make_vec_env(lambda: RandomCostEnv(observations, actions), n_envs, seed=0)


def walked(model: Any, n: int = 2_000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States that the agent meets: raw, and normalised as in training; and their last costs."""
    env, normalize = model.get_env(), model.get_vec_normalize_env()
    normalize.training = False
    raw, seen, costs = [], [env.reset()], [np.zeros(env.num_envs)]
    for _ in range(n // env.num_envs):
        raw.append(normalize.get_original_obs())
        observations, _, _, infos = env.step(model.predict(seen[-1])[0])
        seen.append(observations.copy())
        costs.append(np.array([info["cost"] for info in infos]))
    last_cost = np.concatenate(costs[:-1])[:, None].astype(np.float32)
    return np.concatenate(raw), np.concatenate(seen[:-1]), last_cost


def run(path: Path, inputs: dict[str, np.ndarray], output: str = "action") -> np.ndarray:
    return onnxruntime.InferenceSession(path).run([output], inputs)[0]


def parity(model: Any, path: Path) -> tuple[float, float]:
    """Share of 2,000 states of the agent on which the file agrees, and largest difference."""
    raw, normalized, last_cost = walked(model)
    inputs = {"observation": raw}
    acts_on_cost = getattr(model.policy, "acts_on_cost", False)
    if acts_on_cost:
        last_cost[::3] = np.nan
        inputs["last_cost"] = last_cost
    expected = predicted(model, normalized, last_cost if acts_on_cost else None)
    assert expected.std(axis=0).min() > 1e-5  # no constant
    return agreement(run(path, inputs), expected, model.action_space)


def trained(key: str, **kwargs: Any) -> Any:
    """An agent of an algorithm, after a few updates."""
    cls: Any = ALGORITHMS[key]
    arguments: dict[str, Any] = ON_POLICY
    if issubclass(cls, SACLag | TD3Lag | TQCLag):
        arguments = OFF_POLICY
    if key in ("trpo_sl", "trpo_usl"):
        # Some actions are corrected, some are not, although the models have hardly learnt.
        arguments = {**arguments, "warmup": 1, "threshold": 0.02}
    if key == "trpo_sl":
        arguments = {**arguments, "tolerance": 0.05}
    if not cls.constrained:
        arguments = {k: v for k, v in arguments.items() if k != "cost_limit"}
    model = cls("MlpPolicy", points(), **{**arguments, **kwargs})
    model.learn(400)
    if key == "trpo_usl":
        _, seen, _ = walked(model, 1000)
        observations, actions = map(th.as_tensor, (seen, model.predict(seen)[0]))
        layer = model.policy.action_filter
        layer.threshold.fill_(layer.values(observations, actions).median())
    return model


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """An agent of CPO and its file."""
    model, path = trained("cpo"), tmp_path_factory.mktemp("plain") / "policy.onnx"
    sb3_guard.export(model, path)
    return model, path


def test_the_file_acts_as_predict_does(plain: tuple[Any, Path]) -> None:
    share, largest = parity(*plain)
    assert share == 1.0, largest


OTHERS = [key for key in ALGORITHMS if key not in ("cpo", "trpo_sl", "trpo_usl")]


@pytest.mark.parametrize(
    "key", [pytest.param(k, marks=() if k == "sac_lag" else pytest.mark.slow) for k in OTHERS]
)
def test_so_do_those_of_other_algorithms(key: str, tmp_path: Path) -> None:
    model = trained(key)
    sb3_guard.export(model, tmp_path / "policy.onnx")
    share, largest = parity(model, tmp_path / "policy.onnx")
    assert share == 1.0, largest


@pytest.mark.parametrize(
    ("key", "kwargs", "least"),
    [
        ("trpo_sl", {}, 0.999),
        pytest.param("trpo_usl", {"steps": 1}, 0.999, marks=pytest.mark.slow),
        pytest.param("trpo_sl", {"drift": True}, 0.999, marks=pytest.mark.slow),
        pytest.param("trpo_usl", {"steps": 20}, 0.95, marks=pytest.mark.slow),
    ],
)
def test_the_safety_filter_is_in_the_file(
    key: str, kwargs: Any, least: float, tmp_path: Path
) -> None:
    model, path = trained(key, **kwargs), tmp_path / "policy.onnx"
    sb3_guard.export(model, path)
    share, largest = parity(model, path)
    assert share >= least, largest
    raw, normalized, last_cost = walked(model, 1000)
    inputs = {"observation": raw} | ({"last_cost": last_cost} if key == "trpo_sl" else {})
    filtered = run(path, inputs)
    alone = ActorCriticPolicy.predict(model.policy, normalized, deterministic=True)[0]
    corrected = (np.abs(filtered - alone) > 1e-3).any(axis=1).mean()
    assert 0.05 < corrected < 0.999
    if key == "trpo_sl":  # what it acts on changes with the last cost
        unknown = run(path, {**inputs, "last_cost": np.full_like(last_cost, np.nan)})
        infinite, huge = (
            run(path, {**inputs, "last_cost": np.full_like(last_cost, cost)})
            for cost in (np.inf, 1e30)
        )
        np.testing.assert_array_equal(infinite, huge)
        assert (np.abs(filtered - unknown) > 1e-3).any()


# Spaces


def test_images_and_dictionaries_are_inputs_by_name(tmp_path: Path) -> None:
    space = spaces.Dict(
        camera=spaces.Box(0, 255, (36, 36, 3), np.uint8),
        speed=spaces.Box(-np.inf, np.inf, (3,), np.float64),
        gear=spaces.Discrete(4),
    )
    env = VecNormalize(noisy(space, LOPSIDED), norm_obs_keys=["speed"])
    model = CPO("MultiInputPolicy", env, **ON_POLICY)
    env.reset()
    contract = sb3_guard.export(model, tmp_path / "policy.onnx")
    shapes = {each["name"]: (each["dtype"], each["shape"]) for each in contract["inputs"]}
    assert shapes == {
        "camera": ("uint8", ["batch", 3, 36, 36]),  # as SB3 transposes it
        "gear": ("int64", ["batch"]),
        "speed": ("float64", ["batch", 3]),
    }
    rng = np.random.default_rng(0)
    inputs: dict[str, Any] = {
        "camera": rng.integers(0, 256, (500, 3, 36, 36), np.uint8),
        "gear": rng.integers(0, 4, 500),
        "speed": 3.0 * rng.normal(size=(500, 3)),
    }
    moments = env.obs_rms["speed"]
    z = (inputs["speed"] - moments.mean) / np.sqrt(moments.var + env.epsilon)
    normalized = {**inputs, "speed": np.clip(z, -10, 10).astype(np.float32)}
    expected = model.predict(normalized, deterministic=True)[0]
    assert agreement(run(tmp_path / "policy.onnx", inputs), expected, LOPSIDED)[0] == 1.0


@pytest.mark.parametrize("cls", [CPO, pytest.param(SACLag, marks=pytest.mark.slow)])
def test_sampled_actions_are_those_of_their_noise(cls: Any, tmp_path: Path) -> None:
    box = spaces.Box(-1.0, 1.0, (3,), np.float32)
    model = cls("MlpPolicy", noisy(box, LOPSIDED), **(ON_POLICY if cls is CPO else OFF_POLICY))
    sb3_guard.export(model, tmp_path / "policy.onnx", sampled=True)
    rng = np.random.default_rng(0)
    observations = rng.uniform(-1, 1, (1000, 3)).astype(np.float32)
    noise = rng.normal(size=(1000, 2)).astype(np.float32)
    tensor = th.as_tensor(observations)
    with th.no_grad():
        if cls is CPO:
            normal: Any = model.policy.get_distribution(tensor).distribution
            mean, std = normal.mean.numpy(), normal.stddev.numpy()
            expected = np.clip(mean + std * noise, LOPSIDED.low, LOPSIDED.high)
        else:
            mean, log_std, _ = model.actor.get_action_dist_params(tensor)
            squashed = np.tanh(mean.numpy() + np.exp(log_std.numpy()) * noise)
            expected = model.policy.unscale_action(squashed)
    actions = run(tmp_path / "policy.onnx", {"observation": observations, "noise": noise})
    assert agreement(actions, expected, LOPSIDED)[0] == 1.0


def test_frames_are_stacked_before_they_are_normalised(tmp_path: Path) -> None:
    env = points(2)
    model = CPO("MlpPolicy", VecFrameStack(env, 3), **ON_POLICY).learn(160)
    env.training = False
    contract = sb3_guard.export(model, tmp_path / "policy.onnx")
    assert contract["frame_stack"] == {"frames": 3, "order": "oldest first"}
    assert contract["inputs"][0]["components"] == [{"name": "observation", "start": 0, "stop": 4}]
    raw, stacked = [], [model.get_env().reset()]
    for _ in range(3):
        raw.append(env.get_original_obs())
        stacked.append(model.get_env().step(model.predict(stacked[-1])[0])[0])
    inputs = {"observation": np.concatenate(raw, axis=1)}
    expected = model.predict(stacked[2], deterministic=True)[0]
    assert agreement(run(tmp_path / "policy.onnx", inputs), expected, model.action_space)[0] == 1.0
    with pytest.raises(ValueError, match=r"contract.json is that of .*policy.onnx: choose another"):
        sb3_guard.export(model, tmp_path / "other.onnx")
    (tmp_path / "contract.json").write_text('{"file": []}')  # of another program
    with pytest.raises(ValueError, match=r"contract.json is that of something else: choose"):
        check(model, False, tmp_path / "policy.onnx")


# Our robots, and the contract


def test_the_contract_of_a_robot(tmp_path: Path) -> None:
    model = sb3_guard.make_model("scpo", "Goal_Ant_8Hazards", n_envs=2, n_steps=50, seed=0)
    path = tmp_path / "ant" / "policy.onnx"
    contract = sb3_guard.export(model, path)
    assert contract == json.loads((tmp_path / "ant" / "contract.json").read_text())
    assert contract["file"]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    engine = model.get_env().unwrapped.envs.engine
    *parts, highest = contract["inputs"][0]["components"]
    layout = {part["name"]: slice(part["start"], part["stop"]) for part in parts}
    assert layout == engine.observation_layout
    assert parts[0] == {
        "name": "accelerometer", "start": 0, "stop": 3, "low": None, "high": None, "unit": "m/s²",
        "sensor": "accelerometer", "on": "robot", "axes": "robot",
    }  # fmt: skip
    assert next(part for part in parts if part["name"] == "hazards_lidar") == {
        "name": "hazards_lidar", "start": layout["hazards_lidar"].start,
        "stop": layout["hazards_lidar"].stop, "low": 0.0, "high": 1.0, "unit": "closeness",
        "frames": ["robot"], "axes": "xy", "closeness": "exp(-1 d)", "alias": True,
        "bins": "azimuths from 22.5 i to 22.5 (i + 1) degrees, from x towards y",
    }  # fmt: skip
    assert (highest["name"], highest["start"], highest["first"]) == (
        "max_cost",
        parts[-1]["stop"],
        0.0,
    )
    assert "highest cost of a step so far" in highest["computed"]
    assert contract["costs"] == [{"name": "cost", "limit": 0.1, "per": "step"}]
    assert contract["control_rate"] == 5.0
    assert contract["trained"]["env"] == "Goal_Ant_8Hazards-v0"
    observations = model.get_env().reset()
    actions = run(path, {"observation": observations})
    control = run(path, {"observation": observations}, "control")
    assert (
        contract["outputs"][1]["actuators"][0] == contract["outputs"][0]["actuators"][0] == "hip_1"
    )
    model.get_env().step(actions)
    np.testing.assert_allclose(control, engine.batch.bind("ctrl"), atol=1e-6)


def test_the_contract_of_a_file_names_joints_units_and_delay(tmp_path: Path) -> None:
    (tmp_path / "dog.xml").write_text(
        DOG.format(keys="").replace('<joint name="fan"/>', '<joint name="fan" type="slide"/>')
    )
    spec = mujoco.MjSpec.from_file(str(tmp_path / "dog.xml"))
    add_servos(spec, joints=["front_thigh", "front_calf", "back_thigh"])
    add_pose(spec, front_thigh=0.5, front_calf=-1, back_thigh=0.5)
    with own_parts():
        sb3_guard.register_robot("Dog", xml=spec, root="trunk")
        kwargs = {"robot": {"delay": 2}, "hazards": None}
        model = sb3_guard.make_model("cpo", "Goal_Dog_1Hazards", env_kwargs=kwargs, n_envs=2)
        contract = sb3_guard.export(model, tmp_path / "policy.onnx")
        drawn = {"robot": {"delay": {"low": 0, "high": 3}}, "hazards": None}
        model = sb3_guard.make_model("cpo", "Goal_Dog_1Hazards", env_kwargs=drawn, n_envs=2)
        assert sb3_guard.export(model, tmp_path / "policy.onnx")["delay"] == [0, 3]
        trained_in = contract["trained"]
        env = sb3_guard.make(trained_in["env"], **trained_in["env_kwargs"])
        assert env.unwrapped.scenario.robot_params == {"delay": 2}
    assert contract["delay"] == 2
    parts = {part["name"]: part for part in contract["inputs"][0]["components"]}
    joints = ["front_thigh", "front_calf", "back_thigh"]
    assert parts["joint_pos"]["joints"] == joints
    assert (parts["joint_pos"]["first_pose"], parts["joint_pos"]["unit"]) == ([0.5, -1, 0.5], "rad")
    assert parts["joint_vel"]["joints"] == [*joints, "fan"]
    assert parts["joint_vel"]["unit"] == ["rad/s", "rad/s", "rad/s", "m/s"]


def test_operators_of_a_plain_policy_are_few(plain: tuple[Any, Path]) -> None:
    contract = json.loads(plain[1].with_name("contract.json").read_text())
    operators = {node.op_type for node in onnx.load(plain[1]).graph.node}
    assert operators == set(contract["file"]["operators"]) <= PLAIN


WITHOUT_TORCH = """
import sys
sys.modules["torch"] = sys.modules["stable_baselines3"] = sys.modules["sb3_guard"] = None
import numpy, onnxruntime
session = onnxruntime.InferenceSession(sys.argv[1])
observation = numpy.full((1, 4), 0.3, numpy.float32)
print(session.run(["action"], {"observation": observation})[0].tolist())
"""


def test_the_file_runs_without_torch(plain: tuple[Any, Path]) -> None:
    path = plain[1]
    command = [sys.executable, "-c", WITHOUT_TORCH, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    here = run(path, {"observation": np.full((1, 4), 0.3, np.float32)})
    np.testing.assert_array_equal(np.float32(json.loads(done.stdout)), here)


# What can't be exported


class Timid(ActorCriticPolicy):
    """Does half of what its networks say."""

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        return 0.5 * super()._predict(observation, deterministic)


def test_a_policy_that_acts_otherwise_is_noticed(tmp_path: Path) -> None:
    model = CPO(Timid, points(2), **ON_POLICY)
    with pytest.raises(ValueError, match=r"would act otherwise than predict on .*: a Timid"):
        sb3_guard.export(model, tmp_path / "policy.onnx")
    assert not any(tmp_path.iterdir())


def refused_models() -> dict[str, Any]:
    box = spaces.Box(-1.0, 1.0, (3,), np.float32)
    two = {"cost_keys": ("cost", "cost_1"), "cost_limit": (1.0, 1.0), "warmup": 1}
    several = TRPOSL("MlpPolicy", points(2, cost_keys=two["cost_keys"]), **{**ON_POLICY, **two})
    several.policy.action_filter.active.fill_(1.0)
    alone = CPO("MlpPolicy", points(2), **ON_POLICY)
    alone.env = None
    choices = spaces.MultiDiscrete([2, 3])
    return {
        "TRPO-SL with 2 costs can't be exported": several,
        "the agent has no environment": alone,
        "its noise is gSDE's": CPO("MlpPolicy", points(2), use_sde=True, **ON_POLICY),
        "Box and Discrete can be": CPO("MlpPolicy", noisy(box, choices), **ON_POLICY),
        "its policy is a DQNPolicy": DQN("MlpPolicy", noisy(box, spaces.Discrete(2))),
    }


def test_what_can_not_be_exported_is_refused_in_a_line(tmp_path: Path) -> None:
    for words, model in refused_models().items():
        with pytest.raises(ValueError, match=words) as error:
            sb3_guard.export(model, tmp_path / "policy.onnx")
        assert "\n" not in str(error.value)
    box = spaces.Box(-1.0, 1.0, (3,), np.float32)
    td3 = TD3Lag("MlpPolicy", points(2), **OFF_POLICY)
    for model in td3, PPOLag("MlpPolicy", noisy(box, spaces.Discrete(4)), **ON_POLICY):
        with pytest.raises(ValueError, match="with sampled actions: leave out sampled"):
            sb3_guard.export(model, tmp_path / "policy.onnx", sampled=True)
    with pytest.raises(ValueError, match=r"must end in \.onnx"):
        sb3_guard.export(td3, tmp_path / "policy.pt")
    normalised = CPO("MlpPolicy", points(2), **ON_POLICY).learn(1)
    with pytest.raises(ValueError, match="or one without its observation statistics: pass env="):
        sb3_guard.export(normalised, tmp_path / "policy.onnx", env=points(2, normalize=False))
    assert not any(tmp_path.iterdir())


def test_an_extractor_for_the_actor_alone_is_exported(tmp_path: Path) -> None:
    model = trained("ppo_lag", policy_kwargs={"share_features_extractor": False})
    sb3_guard.export(model, tmp_path / "policy.onnx")
    share, largest = parity(model, tmp_path / "policy.onnx")
    assert share == 1.0, largest


def test_statistics_that_the_file_would_not_have_are_refused(tmp_path: Path) -> None:
    model = CPO("MlpPolicy", points(2, normalize=False), **ON_POLICY)
    for wrapper, fits in ((NormalizeReward, True), (NormalizeObservation, False)):
        env = make_vec_env(lambda wrapper=wrapper: wrapper(CostPoint(30)), 2)
        with nullcontext() if fits else pytest.raises(ValueError, match=r"^NormalizeObservation"):
            sb3_guard.export(model, tmp_path / "policy.onnx", env=env)
    with pytest.raises(ValueError, match="two VecNormalize"):
        sb3_guard.export(model, tmp_path / "policy.onnx", env=VecNormalize(points(2)))


def test_the_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"needs onnxruntime: pip install 'sb3-guard\[export\]'"):
        sb3_guard.export(CPO("MlpPolicy", points(2), **ON_POLICY), tmp_path / "policy.onnx")

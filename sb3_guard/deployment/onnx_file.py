"""``sb3_guard.export``: an agent as one ONNX file, with its contract next to it."""

import hashlib
import importlib.util
import json
import logging
import re
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.common.evaluation import check_agent
from sb3_guard.common.files import replacing
from sb3_guard.deployment.contract import contract, stops
from sb3_guard.deployment.deployed import Deployed
from sb3_guard.deployment.observations import inputs_of, joined
from sb3_guard.deployment.policies import Acting
from sb3_guard.vector import lacks_statistics, own_statistics

if TYPE_CHECKING:
    import onnx

#: The version of ONNX's operators, of 2022.
OPSET = 18
CONTRACT = "contract.json"
#: Largest difference of two actions that counts as none, as a share of half the action range.
TOLERANCE = 1e-5
_STATES = 256  # observations that a file is checked on before it is written
_AGREE = 0.95  # least share of them on which the file and ``predict`` agree


def export(
    model: BaseAlgorithm,
    path: str | Path = "policy.onnx",
    *,
    env: VecEnv | None = None,
    sampled: bool = False,
    stop: Mapping[str, float | str] | None = None,
    trained: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write an agent as one ONNX file, with normalisation, safety filter and controls in it.

    ::

        model = sb3_guard.make_model("cpo", "Goal_Point_8Hazards", cost_limit=5)
        model.learn(1_000_000)
        sb3_guard.export(model, "policy.onnx")

    ``contract.json`` next to it holds what the file expects and gives: names, shapes, units and
    order of observations and actions, the control rate, cost limits. onnxruntime and most robots'
    software run the file without torch and without this package. It is compared with ``predict``
    before it is written.

    :param model: an agent with a Box or Discrete action space
    :param path: of the file, ``.onnx``; it is replaced
    :param env: environments wrapped as in training, ``VecNormalize`` included; None: the model's
    :param sampled: sample actions, with the random numbers as an input; False: the most likely ones
    :param stop: by actuator the control that stops it, or ``"hold"`` for the last one; in an
        environment of another package by the number of the action, ``{"0": 0.0}``. Others have that
        of the keyframe ``stop``, else position servos hold and motors and velocity servos have 0
    :param trained: what the contract shall say of the training, plain data
    :return: the contract
    :raises ValueError: the agent is of a kind that can't be exported, or has no environment with
        its observation statistics, or another agent is in the folder
    :raises ImportError: the extra ``export`` is not installed
    """
    path = Path(path)
    check(model, sampled, path)
    env = env or model.get_env()
    if env is None or lacks_statistics(model, env):
        raise ValueError(
            "the agent has no environment, or one without its observation statistics: pass env=, "
            "environments wrapped as in training (with VecNormalize.load(file, env), if it had any)"
        )
    if (fault := own_statistics(env)).startswith("NormalizeObservation"):
        raise ValueError(fault)
    check_agent(model, env)
    stops(model, env, stop or {})
    deployed = Deployed(model, env, sampled)
    file = _converted(deployed)
    share, largest = _parity(deployed, file, model)
    if share < _AGREE:
        raise ValueError(
            f"the file would act otherwise than predict on {1 - share:.1%} of random observations, "
            f"by up to {largest:.2g} of half the action range: a {type(model.policy).__name__} "
            "computes its actions in a way that is not known here"
        )
    content = file.SerializeToString()
    operators = sorted({node.op_type for node in file.graph.node})
    about_file = {
        "name": path.name,
        "sha256": hashlib.sha256(content).hexdigest(),
        "opset": OPSET,
        "operators": operators,
    }
    described = {"file": about_file, **contract(model, env, deployed, trained or {}, stop or {})}
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as out:
        out.write(content)
    with replacing(path.with_name(CONTRACT)) as out:
        out.write(_json(described))
    return described


def check(model: BaseAlgorithm, sampled: bool, path: Path) -> None:
    """
    Find out whether an agent can be exported.

    :param model: the agent
    :param sampled: whether its actions are sampled
    :param path: of the file
    :raises ValueError: it is of a kind that can't be exported, or another agent is in the folder
    :raises ImportError: the extra ``export`` is not installed
    """
    for name in ("onnx", "onnxscript", "onnxruntime"):
        if importlib.util.find_spec(name) is None:
            raise ImportError(f"export needs {name}: pip install 'sb3-guard[export]'")
    Acting(model, sampled)
    if path.suffix != ".onnx":
        raise ValueError(f"path={str(path)!r}: must end in .onnx")
    beside, name = path.with_name(CONTRACT), ""
    with suppress(OSError, ValueError, KeyError, TypeError):  # absent, or not one of ours
        name = str(json.loads(beside.read_bytes())["file"]["name"])
    if beside.exists() and name != path.name and (not name or (path.parent / name).is_file()):
        raise ValueError(f"{beside} is that of {name or 'something else'}: choose another folder")


def _json(data: Mapping[str, Any]) -> bytes:
    """JSON with lists and mappings of plain values on a line."""
    text = json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False)
    for inner in (r"\[[^\[\]{}]*\]", r"\{[^\[\]{}]*\}"):
        text = re.sub(inner, lambda match: re.sub(r"\s*\n\s*", " ", match[0]), text)
    return f"{text}\n".encode()


def _converted(deployed: Deployed) -> "onnx.ModelProto":
    """The agent in ONNX's operators."""
    deployed.acting.actor.policy.set_training_mode(False)
    deployed.eval()
    device = next(deployed.parameters()).device
    drawn = deployed.draw(2, np.random.default_rng(0))
    example = tuple(th.as_tensor(value, device=device) for value in drawn.values())
    batch = {0: th.export.Dim("batch")}
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # torchvision, which is not needed
    with warnings.catch_warnings(), th.no_grad():
        warnings.simplefilter("ignore")
        program = th.onnx.export(
            deployed,
            example,
            dynamo=True,
            input_names=deployed.inputs,
            output_names=deployed.outputs,
            dynamic_shapes=(tuple(batch for _ in example),),
            opset_version=OPSET,
            verbose=False,
        )
    assert program is not None
    model: onnx.ModelProto = program.model_proto
    for node in model.graph.node:  # paths of this machine's Python files
        del node.metadata_props[:]
        node.doc_string = ""
    return model


def _parity(
    deployed: Deployed, file: "onnx.ModelProto", model: BaseAlgorithm
) -> tuple[float, float]:
    """The agreement of the file with ``predict`` on random states."""
    import onnxruntime

    session = onnxruntime.InferenceSession(
        file.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    inputs = deployed.draw(_STATES, np.random.default_rng(1))
    if "noise" in inputs:
        inputs["noise"][:] = 0.0  # the mean
    tensors = {name: th.as_tensor(value) for name, value in inputs.items()}
    observed = {n: v for n, v in tensors.items() if n in inputs_of(deployed.space)}
    observations: Any = joined(deployed.normalizer.cpu()(observed), deployed.space)
    if isinstance(observations, dict):
        observations = {name: value.numpy() for name, value in observations.items()}
    else:
        observations = observations.numpy()
    expected = predicted(model, observations, inputs.get("last_cost"))
    return agreement(session.run(["action"], inputs)[0], expected, model.action_space)


def predicted(model: BaseAlgorithm, observations: Any, last_cost: np.ndarray | None) -> np.ndarray:
    """The likeliest actions as ``predict`` gives them.

    :param observations: normalised ones, a batch of B
    :param last_cost: what the last step cost, [B, 1], NaN where that is not known; None: of none
    """
    actions, _ = model.predict(observations, deterministic=True)
    if last_cost is None:
        return actions
    state = (np.nan_to_num(last_cost),)
    given, _ = model.predict(observations, state=state, deterministic=True)
    unknown = np.isnan(last_cost).reshape(-1, *[1] * (actions.ndim - 1))
    return np.where(unknown, actions, given)


def agreement(
    actions: np.ndarray, expected: np.ndarray, space: spaces.Space
) -> tuple[float, float]:
    """
    The share of actions that agree, and the largest difference.

    :param actions: [B, …]
    :param expected: [B, …]
    :param space: the action space; differences are in units of half its range, and agree if they
        are at most ``TOLERANCE``, those of a Discrete space if they are equal
    """
    half: Any = 1.0
    if isinstance(space, spaces.Box):
        half = (space.high.astype(np.float64) - space.low) / 2.0
        half = np.where(np.isfinite(half) & (half > 0.0), half, 1.0)
    differences = np.abs(actions.astype(np.float64) - expected) / half
    worst = differences.reshape(len(differences), -1).max(axis=1)
    return float((worst <= TOLERANCE).mean()), float(worst.max())

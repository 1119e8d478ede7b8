"""``contract.json``: inputs, outputs and rate of an exported policy, for the loop around it."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, cast

import numpy as np
import stable_baselines3
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.algorithms.common.constrained import Constrained
from sb3_guard.common.vec_budgets import Counted, VecMaxCost
from sb3_guard.deployment.deployed import Deployed
from sb3_guard.deployment.environment import (
    all_wrappers,
    changing,
    drive,
    frames_of,
    lone_of,
    ours_of,
)
from sb3_guard.deployment.observations import OBSERVATION, inputs_of
from sb3_guard.fields import did_you_mean, is_number

FORMAT = 4  # increased when the content changes
HOLD = "hold"  # the last value is sent again
_NOISE = "independent standard normal numbers, drawn anew in each step"
_LAST_COST = "cost of the step before, 0 when an episode begins, NaN if it is not known"


def contract(
    model: BaseAlgorithm,
    env: VecEnv,
    deployed: Deployed,
    trained: Mapping[str, Any],
    stop: Mapping[str, Any],
) -> dict[str, Any]:
    """
    The contract of an exported agent, as plain data without infinities.

    :param model: the agent
    :param env: environments with the wrappers of training
    :param deployed: what is exported
    :param trained: what else there is to say of the training
    :param stop: what stops the robot, see :func:`stops`
    """
    from sb3_guard import __version__

    ours, inner, frames = ours_of(env), lone_of(env), frames_of(env)
    step = ours.engine.control_step if ours else getattr(inner and inner.unwrapped, "dt", None)
    spec = getattr(inner, "spec", None) or getattr(env.unwrapped, "spec", None)
    versions = {
        "sb3_guard": __version__, "stable_baselines3": stable_baselines3.__version__,
        "torch": th.__version__,
    }  # fmt: skip
    return {
        "format": FORMAT,
        "inputs": [_input(name, model, env, deployed) for name in deployed.inputs],
        "outputs": [
            {**_output(name, model, env), "stop": values}
            for name, values in stops(model, env, stop).items()
        ],
        "actions": "sampled" if deployed.acting.actor.sampled else "mean",
        "control_step": step,
        "control_rate": None if step is None else round(1.0 / step, 6),
        "delay": None if ours is None else _delay(ours.engine.robot),
        "costs": list(_costs(model)),
        "filter": _filter(deployed),
        "frame_stack": None if frames == 1 else {"frames": frames, "order": "oldest first"},
        "wrappers": [type(wrapper).__name__ for wrapper in changing(env)],
        "trained": {
            "algorithm": type(model).__name__,
            "env": None if spec is None else spec.id,
            **({} if ours is None else {"env_kwargs": {"scenario": ours.scenario.to_dict()}}),
            "timesteps": model.num_timesteps,
            "versions": versions,
            **trained,
        },
    }


def _delay(robot: Any) -> Any:
    """Control steps that pass until an action has effect, or the range that they are drawn from."""
    low, high = robot.ranges.get("delay", 2 * (getattr(robot, "delay", 0),))
    return low if low == high else [low, high]


def _input(name: str, model: BaseAlgorithm, env: VecEnv, deployed: Deployed) -> dict[str, Any]:
    observed = inputs_of(model.observation_space)
    if name not in observed:
        size = int(np.prod(deployed.shape)) if name == "noise" else 1
        meaning = _NOISE if name == "noise" else _LAST_COST
        return {"name": name, "dtype": "float32", "shape": ["batch", size], "meaning": meaning}
    space = observed[name]
    described = {**_space(name, space), "normalized": name in deployed.normalizer.names}
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        described["components"] = list(_components(name, space, env))
        if "low" in described["components"][0]:  # those of the whole say no more
            del described["low"], described["high"]
    return described


def _output(name: str, model: BaseAlgorithm, env: VecEnv) -> dict[str, Any]:
    driven = drive(env)
    if name == "control":
        assert driven is not None
        ranges = [(part.name, *part.control) for part in driven.actuators]
        described: dict[str, Any] = {
            "name": name, "dtype": "float32", "shape": ["batch", len(ranges)],
            "low": [low for _, low, _ in ranges], "high": [high for _, _, high in ranges],
        }  # fmt: skip
    else:
        # exported actions are float32 whatever the space says
        dtype = "float32" if isinstance(model.action_space, spaces.Box) else "int64"
        described = {**_space(name, model.action_space), "dtype": dtype}
        ranges = [] if driven is None else [(part.name,) for part in driven.actuators]
    if ranges:
        described["actuators"] = [names[0] for names in ranges]
    return described


def stops(model: BaseAlgorithm, env: VecEnv, stated: Mapping[str, Any]) -> dict[str, list[Any]]:
    """
    What the loop around the policy sends to stop the robot, by output.

    :param stated: by actuator, in units of its control, or by the action's number (``"0"``) where
        the environment is not of this package, in units of the action; a number, or ``"hold"``
    :return: of each number of the output a value, ``"hold"`` (the last value sent), or None: the
        environment does not tell
    :raises ValueError: a name or value is not possible
    """
    driven, space = drive(env), cast(spaces.Box | spaces.Discrete, model.action_space)
    if driven is not None:
        known = {part.name: HOLD if part.stop is None else part.stop for part in driven.actuators}
        bounds = [part.control for part in driven.actuators]
    else:
        low, high = (space.low, space.high) if isinstance(space, spaces.Box) else (0, space.n - 1)
        bounds = list(zip(np.ravel(low).tolist(), np.ravel(high).tolist(), strict=True))
        known = dict.fromkeys(map(str, range(len(bounds))))
    ranges = dict(zip(known, bounds, strict=True))
    for name, value in stated.items():
        if name not in known:
            raise ValueError(f"stop names no actuator {name!r}: {did_you_mean(name, known)}")
        low, high = ranges[name]
        if value != HOLD and not (is_number(value) and low <= value <= high):
            raise ValueError(
                f"stop of {name!r} is {value!r}: it must be from {low:g} to {high:g}, or 'hold'"
            )
    values = list({**known, **stated}.values())
    if driven is None:
        return {"action": values}
    actions = [
        value
        if value == HOLD
        else float(np.clip((value - offset) / (scale or 1.0), part.low, part.high))
        for value, offset, scale, part in zip(
            values, driven.offset, driven.scale, driven.actuators, strict=True
        )
    ]
    return {"action": actions, "control": values}


def _space(name: str, space: spaces.Space) -> dict[str, Any]:
    """Name, type, shape and bounds of an observation or action; a bound is null if infinite."""
    shape = ["batch", *(space.shape or ())]
    described: dict[str, Any] = {"name": name, "dtype": str(space.dtype), "shape": shape}
    if isinstance(space, spaces.Box):
        described |= {"low": _bounds(space.low), "high": _bounds(space.high)}
    elif isinstance(space, spaces.Discrete):
        described |= {"low": 0, "high": int(space.n) - 1}
    return described


def _bounds(values: np.ndarray) -> Any:
    """Bounds, or one number where all are equal."""
    numbers = [_finite(value) for value in values.ravel().tolist()]
    return numbers[0] if len(set(numbers)) == 1 else numbers


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _components(name: str, space: spaces.Box, env: VecEnv) -> Iterator[dict[str, Any]]:
    """What the numbers of one frame are, in their order; of a frame nobody describes, nothing."""
    size, ours = space.shape[0] // frames_of(env), ours_of(env)
    counted = {w.name: w for w in all_wrappers(env) if isinstance(w, Counted)}
    counted = {k: w for k, w in counted.items() if name in (OBSERVATION, k)}
    parts = [p for p in (ours.components if ours else ())
             if name in (OBSERVATION, p.name.split(" ")[0])]  # fmt: skip
    first = parts[0].start if parts else 0
    rest = size - sum(wrapper.numbers.shape[1] for wrapper in counted.values())
    if parts and parts[-1].stop - first == rest:  # else a wrapper has changed them
        described = ours.engine.observer.described()
        for part in parts:
            yield {
                "name": part.name,
                "start": part.start - first,
                "stop": part.stop - first,
                "low": _finite(part.low),
                "high": _finite(part.high),
                "unit": part.unit,
                **described.get(part.name, {}),
            }
    elif rest:
        yield {"name": name, "start": 0, "stop": rest}
    for wrapper in counted.values():
        stop = rest + wrapper.numbers.shape[1]
        yield {"name": wrapper.name, "start": rest, "stop": stop, **_rule(wrapper)}
        rest = stop


def _rule(wrapper: Any) -> dict[str, Any]:
    """What the caller counts, as a wrapper did in training."""
    if isinstance(wrapper, VecMaxCost):
        rule = f"the highest {', '.join(wrapper.cost_keys)} of a step so far in the episode"
    else:
        rule = (
            f"(its value before - {wrapper.cost_key} / {wrapper.budget:g}) / {wrapper.discount:g}"
        )
    return {"first": wrapper.first, "computed": rule}


def _costs(model: BaseAlgorithm) -> Iterator[dict[str, Any]]:
    """The costs that were limited in training, and their limits."""
    if not isinstance(model, Constrained):
        return
    per = "step" if model.limit_on == "max" else "episode"
    for i, key in enumerate(model.cost_keys):
        limit = float(model.final_cost_limits[i]) if model.constrained else None
        yield {"name": key, "limit": limit, "per": per}


def _filter(deployed: Deployed) -> dict[str, Any] | None:
    """The safety filter that is part of the file."""
    layer: Any = deployed.acting.layer
    if layer is None:
        return None
    described = {"kind": type(layer).__name__, "thresholds": layer.threshold.tolist()}
    steps = getattr(layer, "steps", None)
    return described if steps is None else {**described, "steps": steps, "rate": layer.rate}

"""What an exported policy has to know of the environments that its agent was trained in."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

from sb3_guard.vector import layers


class Drive(NamedTuple):
    """How actions become controls of the actuators: ``offset + scale · action``, clipped.

    :param actuators: name, range of the action and of the control, of each
    """

    actuators: list[Any]
    offset: np.ndarray
    scale: np.ndarray


def drive(env: VecEnv) -> Drive | None:
    """How a robot of this package drives its actuators; None: of other environments."""
    ours = ours_of(env)
    if ours is None:
        return None
    robot = ours.engine.robot
    offset, at_one = (robot.to_controls(np.full((1, robot.action_size), a)) for a in (0.0, 1.0))
    if offset is None:
        return None
    return Drive(ours.actuators, offset[0], (at_one - offset)[0])


def ours_of(env: VecEnv) -> Any:
    """The environments if they are this package's: who knows the engine and its components."""
    base = lone_of(env) or getattr(env.unwrapped, "envs", None)
    base = getattr(base, "unwrapped", base)
    return base if hasattr(base, "components") and hasattr(base, "engine") else None


def lone_of(env: VecEnv) -> gymnasium.Env | None:
    """The first of single environments, with its wrappers, if they are in this process."""
    return env.unwrapped.envs[0] if isinstance(env.unwrapped, DummyVecEnv) else None


def all_wrappers(env: VecEnv) -> list[Any]:
    """All wrappers, from the innermost to the outermost."""
    *outer, _ = layers(env)
    *inner, _ = layers(lone_of(env))
    return [*outer, *inner][::-1]


def changing(env: VecEnv) -> Iterator[Any]:
    """The wrappers that change observations or actions and that the caller has to repeat."""
    kinds = gymnasium.ObservationWrapper | gymnasium.ActionWrapper
    for wrapper in all_wrappers(env):
        inner = getattr(wrapper, "venv", None) or wrapper.env
        changed = wrapper.observation_space != inner.observation_space
        if isinstance(wrapper, kinds) or (changed and not isinstance(wrapper, VecFrameStack)):
            yield wrapper


def frames_of(env: VecEnv) -> int:
    """How many frames an observation stacks."""
    stacks = [w for w in layers(env) if isinstance(w, VecFrameStack)]
    return int(np.prod([w.stacked_obs.n_stack for w in stacks]))

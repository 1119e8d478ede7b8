"""Environments of others, held to Gymnasium's contract in every step and not in the first alone."""

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import AtariPreprocessing, MaxAndSkipObservation, RepeatAction
from stable_baselines3.common.atari_wrappers import MaxAndSkipEnv
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_guard.checks import ContractError

REPEATING = (AtariPreprocessing, MaxAndSkipObservation, RepeatAction, MaxAndSkipEnv)


class CheckedEnv(gym.Wrapper, RecordConstructorArgs):
    """An environment whose every step is checked, so that nothing false is learnt from.

    It is the outermost wrapper and passes on what it is asked for or told to set. Stable-Baselines3
    broadcasts an observation of another shape, and takes every text for an end of the episode.

    A wrapper that takes several steps for one of the agent and gives the last one's info, as
    Gymnasium's ``MaxAndSkipObservation`` does, loses the costs of the others: it is refused.

    :param env: the environment, with its wrappers
    :param cost_keys: entries of info that are costs
    """

    def __init__(self, env: gym.Env, cost_keys: Sequence[str] = ("cost",)) -> None:
        RecordConstructorArgs.__init__(self, cost_keys=tuple(cost_keys))
        gym.Wrapper.__init__(self, env)
        self._cost_keys = {*cost_keys}
        self._space = env.observation_space
        self._steps = 0
        self._repeats = _repeats(env)

    def __getattr__(self, name: str) -> Any:
        if name == "env" or name.startswith("_"):
            raise AttributeError(name)
        return getattr(self.env, name)

    def __setattr__(self, name: str, value: Any) -> None:
        made = "_repeats" in vars(self)  # which is set last
        if name in vars(self) or hasattr(type(self), name) or not made:
            super().__setattr__(name, value)
        else:
            self.env.set_wrapper_attr(name, value)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """
        :raises ContractError: the observation is not of its space
        """
        self._steps = 0
        observation, info = self.env.reset(**kwargs)
        self._check(observation, self._space)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        :raises ContractError: there are not five values, the observation is not of its space, an
            end is neither true nor false, or costs were lost
        """
        self._steps += 1
        values: Any = self.env.step(action)
        if len(values) != 5:
            five = "(observation, reward, terminated, truncated, info)"
            self._refuse(
                f"step returns {len(values)} values", f"it must return {five}; CostFromStep takes 6"
            )
        observation, _, *ends, info = values
        self._check(observation, self._space)
        for name, end in zip(("terminated", "truncated"), ends, strict=True):
            if end not in (True, False):
                self._refuse(f"{name} is {_brief(end)}", "it must be True or False")
        if self._repeats and not self._cost_keys.isdisjoint(info):
            self._refuse(
                f"{self._repeats} takes several steps and tells the cost of the last one alone",
                "costs must add up, as rewards do: see docs/your_environment.md",
            )
        return values

    def _check(self, observation: Any, space: spaces.Space, name: str = "the observation") -> None:
        """Refuse an observation of another shape or kind; values may be out of bounds."""
        if isinstance(space, spaces.Dict) and isinstance(observation, Mapping):
            for key in space.spaces:
                self._check(observation.get(key), space[key], f"{name}'s {key!r}")
            return
        if isinstance(space, spaces.Box | spaces.MultiDiscrete | spaces.MultiBinary):
            values = np.asarray(observation)
            fits = values.shape == space.shape and values.dtype.kind in "biuf"
        else:
            fits = space.contains(observation)
        if not fits:
            shape = f", of shape {observation.shape}" if hasattr(observation, "shape") else ""
            self._refuse(f"{name} is {_brief(observation)}{shape}", f"it must fit {space}")

    def _refuse(self, fault: str, remedy: str) -> NoReturn:
        place = f"in step {self._steps} of an episode" if self._steps else "at reset"
        raise ContractError(f"{type(self.unwrapped).__name__}, {place}: {fault}; {remedy}")


def _repeats(env: Any) -> str | None:
    """
    The wrapper that takes several steps for one of the agent and tells the last one's costs.

    Of Gymnasium's and Stable-Baselines3's: what others do, and tell outside of them, is theirs.
    """
    while isinstance(env, gym.Wrapper):
        if type(env).__module__.partition(".")[0] not in ("gymnasium", "stable_baselines3"):
            return None
        if isinstance(env, REPEATING):
            return type(env).__name__
        env = env.env
    return None


def _brief(value: Any) -> str:
    """A value on one line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:80]} …"


def checked(env: Any, cost_keys: Sequence[str] = ("cost",)) -> Any:
    """The environment, with every step checked where that is possible.

    Those of a ``DummyVecEnv`` become :class:`CheckedEnv` in its place; those of other processes
    and batches are left alone.

    :param env: a single or a vectorised environment
    :param cost_keys: entries of info that are costs
    :raises TypeError: it is a vector environment of Gymnasium
    """
    refuse_vector_env(env)
    if isinstance(env, VecEnv):
        inner = env.unwrapped
        if isinstance(inner, DummyVecEnv):
            inner.envs = [checked(lone, cost_keys) for lone in inner.envs]
    elif isinstance(env, gym.Env):
        inside: Any = unwrap_wrapper(env, CheckedEnv)
        if inside is None:
            return CheckedEnv(env, cost_keys)
        inside._cost_keys |= {*cost_keys}
    return env


def refuse_vector_env(env: Any) -> None:
    """
    :raises TypeError: it is a vector environment of Gymnasium, which Stable-Baselines3 can't step
    """
    if isinstance(env, gym.vector.VectorEnv):
        spec = getattr(env, "spec", None)
        name = "MyEnv" if spec is None else repr(spec.id)
        raise TypeError(
            f"{type(env).__name__} is a vector environment of Gymnasium, and Stable-Baselines3 has "
            f"its own: use sb3_guard.make_vec_env({name}, n_envs={env.num_envs})"
        )

"""Environments of others, held to Gymnasium's contract in every step and not in the first alone."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, NoReturn
from unittest.mock import patch

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_guard.checks import ContractError
from sb3_guard.costs import number

BROKEN = "contract_error"  # entry of info


class CheckedEnv(gym.Wrapper, RecordConstructorArgs):
    """An environment whose every step is checked, so that nothing false is learnt from.

    It is the outermost wrapper and passes on what it is asked for or told to set. Stable-Baselines3
    broadcasts an observation of another shape, and takes every text for an end of the episode.

    A wrapper may take several steps for one of the agent and give the last one's info, as
    Gymnasium's ``MaxAndSkipObservation`` does: the costs of the others are lost. The infos of all
    layers in the first step of an episode tell; from then on every step of such an environment is
    compared.

    :param env: the environment, with its wrappers
    :param cost_keys: entries of info that are costs
    :param raises: whether a broken contract is raised; False, in another process: it is told as
        ``info["contract_error"]``, which a ``CostMonitor`` raises
    """

    def __init__(
        self, env: gym.Env, cost_keys: Sequence[str] = ("cost",), raises: bool = True
    ) -> None:
        RecordConstructorArgs.__init__(self, cost_keys=tuple(cost_keys), raises=raises)
        gym.Wrapper.__init__(self, env)
        self._raises = raises
        self._cost_keys = {"cost", *cost_keys}
        self._space = env.observation_space
        self._steps = 0
        self._repeats = False  # whether a wrapper has taken several steps for one

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
        :raises ContractError: there are not two values, or the observation is not of its space
        """
        self._steps = 0
        values: Any = self.env.reset(**kwargs)
        if not (isinstance(values, tuple) and len(values) == 2 and isinstance(values[1], Mapping)):
            self._refuse(f"reset returns {_brief(values)}", "it must return (observation, info)")
        self._check(values[0], self._space)
        return values

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        :raises ContractError: the five values are not what Gymnasium wants, or costs were lost
        """
        self._steps += 1
        try:
            return self._checked_step(action)
        except ContractError as error:
            if self._raises:
                raise
            return self._space.sample(), 0.0, False, False, {BROKEN: str(error)}

    def _checked_step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        listens = self._repeats or self._steps == 1
        values: Any = self._step_and_compare(action) if listens else self.env.step(action)
        if not (isinstance(values, tuple) and len(values) == 5 and isinstance(values[4], Mapping)):
            five = "(observation, reward, terminated, truncated, info)"
            self._refuse(f"step returns {_brief(values)}", f"it must return {five}")
        observation, reward, *ends, _ = values
        self._check(observation, self._space)
        if not _is_scalar(reward):
            self._refuse(f"the reward is {_brief(reward)}", "it must be one number")
        for name, end in zip(("terminated", "truncated"), ends, strict=True):
            if end is not True and end is not False and not (_is_scalar(end) and end in (0, 1)):
                self._refuse(f"{name} is {_brief(end)}", "it must be True or False")
        return values

    def _check(self, observation: Any, space: spaces.Space, name: str = "the observation") -> None:
        """Refuse an observation of another shape or kind; values may be out of bounds."""
        if isinstance(space, spaces.Dict) and isinstance(observation, Mapping):
            for key in space.spaces:
                self._check(observation.get(key), space[key], f"{name}'s {key!r}")
            return
        if isinstance(space, spaces.Box | spaces.MultiDiscrete | spaces.MultiBinary):
            try:
                values = np.asarray(observation)
            except ValueError:  # rows of several lengths
                values = np.array(None)
            fits = values.shape == space.shape and values.dtype.kind in "biuf"
        else:
            fits = space.contains(observation)
        if not fits:
            shape = f", of shape {observation.shape}" if hasattr(observation, "shape") else ""
            self._refuse(f"{name} is {_brief(observation)}{shape}", f"it must fit {space}")

    def _step_and_compare(self, action: Any) -> Any:
        """A step in which the infos of all layers are listened to.

        :raises ContractError: a wrapper took several steps and told the last one's cost
        """
        layers: list[Any] = [self.env]
        while isinstance(layers[-1], gym.Wrapper):
            layers.append(layers[-1].env)
        told: list[list[dict[str, Any]]] = [[] for _ in layers]
        with ExitStack() as stack:
            for layer, infos in zip(layers, told, strict=True):
                step = _listening(layer.step, infos)
                stack.enter_context(patch.object(layer, "step", step))
            values = self.env.step(action)
        for wrapper, outer, inner in zip(layers, told, told[1:], strict=False):
            if len(inner) <= len(outer) or not outer:
                continue
            self._repeats = True
            for key in sorted(self._cost_keys & outer[-1].keys() & inner[-1].keys()):
                costs = [number(info.get(key, 0.0), f"info[{key!r}]") for info in inner]
                total = sum(number(info.get(key, 0.0), f"info[{key!r}]") for info in outer)
                if outer[-1][key] == inner[-1][key] and not np.isclose(total, sum(costs)):
                    self._refuse(
                        f"info[{key!r}] is {costs[-1]:g}, but {type(wrapper).__name__} took "
                        f"{len(costs)} steps, which cost {sum(costs):g}",
                        "costs of repeated steps must add up, as rewards do: see "
                        "docs/your_environment.md",
                    )
        return values

    def _refuse(self, fault: str, remedy: str) -> NoReturn:
        place = f"in step {self._steps} of an episode" if self._steps else "at reset"
        raise ContractError(f"{type(self.unwrapped).__name__}, {place}: {fault}; {remedy}")


def _listening(step: Callable[[Any], Any], infos: list[dict[str, Any]]) -> Callable[[Any], Any]:
    def listening(action: Any) -> Any:
        values = step(action)
        info = values[-1] if isinstance(values, tuple) and values else None
        infos.append(dict(info) if isinstance(info, Mapping) else {})  # it may be written again
        return values

    return listening


def _is_scalar(value: Any) -> bool:
    """Whether a value is a number, as NumPy's and those of other libraries are."""
    return np.ndim(value) == 0 and np.asarray(value).dtype.kind in "biuf"


def _brief(value: Any) -> str:
    """A value on one line."""
    if isinstance(value, tuple):
        return f"{len(value)} values"
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

"""Environments of others, held to Gymnasium's contract in every step and not in the first alone."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

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
        values: Any
        if self._repeats or self._steps == 1:
            values = self._compared(action)
        else:
            values = self.env.step(action)
        if not (isinstance(values, tuple) and len(values) == 5 and isinstance(values[4], Mapping)):
            five = "(observation, reward, terminated, truncated, info)"
            self._refuse(f"step returns {_brief(values)}", f"it must return {five}")
        observation, reward, *ends, _ = values
        self._check(observation, self._space)
        if not isinstance(reward, float | int) and not _is_scalar(reward):
            self._refuse(f"the reward is {_brief(reward)}", "it must be one number")
        for name, end in zip(("terminated", "truncated"), ends, strict=True):
            if end is not True and end is not False and not _is_flag(end):
                self._refuse(f"{name} is {_brief(end)}", "it must be True or False")
        return values

    def _check(self, observation: Any, space: spaces.Space, name: str = "the observation") -> None:
        """Refuse an observation of another shape or kind; values may be out of bounds."""
        if isinstance(space, spaces.Dict):
            absent = (
                [*space] if not isinstance(observation, Mapping) else space.keys() - observation
            )
            if absent:
                have = "" if isinstance(observation, Mapping) else f" but {_brief(observation)}"
                self._refuse(f"{name} has no {sorted(absent)}{have}", f"it must fit {space}")
            for key, part in space.spaces.items():
                self._check(observation[key], part, f"{name}'s {key!r}")
        elif isinstance(space, spaces.Discrete):
            if not space.contains(observation):
                self._refuse(f"{name} is {_brief(observation)}", f"it must fit {space}")
        elif isinstance(space, spaces.Box | spaces.MultiDiscrete | spaces.MultiBinary):
            try:
                values = np.asarray(observation)
            except ValueError:  # rows of several lengths
                values = np.array(None)
            if values.shape != space.shape or values.dtype.kind not in "biuf":
                shown = f"has shape {values.shape}"
                if values.dtype.kind not in "biuf":
                    shown = f"is {_brief(observation)}"
                self._refuse(f"{name} {shown}", f"it must fit {space}")

    def _compared(self, action: Any) -> Any:
        """A step in which all layers are listened to.

        :raises ContractError: a wrapper has lost costs
        """
        layers: list[gym.Env] = [self.env]
        while isinstance(layers[-1], gym.Wrapper):
            layers.append(layers[-1].env)
        infos: list[list[dict[str, Any]]] = [[] for _ in layers]
        own = [vars(layer).get("step") for layer in layers]
        for layer, seen in zip(layers, infos, strict=True):
            layer.step = _listening(layer.step, seen)  # type: ignore[method-assign, assignment]
        try:
            values = self.env.step(action)
        finally:
            for layer, step in zip(layers, own, strict=True):
                if step is None:
                    del layer.step
                else:
                    layer.step = step  # type: ignore[method-assign]
        for wrapper, outer, inner in zip(layers, infos, infos[1:], strict=False):
            if len(inner) > len(outer) > 0:
                self._repeats = True
                self._compare(type(wrapper).__name__, outer, inner)
        return values

    def _compare(
        self, wrapper: str, outer: list[dict[str, Any]], inner: list[dict[str, Any]]
    ) -> None:
        for key in sorted(self._cost_keys & outer[-1].keys() & inner[-1].keys()):
            told, taken = (
                [number(info.get(key, 0.0), f"info[{key!r}]") for info in infos]
                for infos in (outer, inner)
            )
            if told[-1] == taken[-1] and not np.isclose(sum(told), sum(taken)):
                self._refuse(
                    f"info[{key!r}] is {told[-1]:g}, but {wrapper} took {len(taken)} steps, which "
                    f"cost {sum(taken):g}",
                    "costs of repeated steps must add up, as rewards do: see "
                    "docs/your_environment.md",
                )

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


def _is_flag(value: Any) -> bool:
    return _is_scalar(value) and value in (0, 1)


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

"""What an id means, said once: :func:`find` returns the source of environments that it stands for.

A :class:`Source` makes single environments, and batches of them where they are ours. Our
environments are imported where they are used: those of others work where MuJoCo is older than 4.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import DependencyNotInstalled

from sb3_guard.common.adapters import is_safety_gymnasium, make_safety_gymnasium
from sb3_guard.common.native import GuardVecEnv
from sb3_guard.fields import nearest
from sb3_guard.ids import ENTRY_POINT, IMPORT_FIRST, UnknownId, with_version

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

    from sb3_guard.envs.scenario import Scenario


class Source(NamedTuple):
    """Where environments come from.

    :param env_id: the id in full; of a class or function its name with its module
    :param make: makes one from its keyword arguments
    :param batch: makes n on one batch of simulations, ``batch(n, **kwargs)``; None where that is
        not possible: environments of others, and ours with wrappers in their registration
    :param scenario: what ours are; None: those of others
    :param spec: how those are registered with Gymnasium that may have a vector environment
    """

    env_id: str
    make: Callable[..., gymnasium.Env]
    batch: Callable[..., VecEnv] | None = None
    scenario: Scenario | None = None
    spec: EnvSpec | None = None

    def stepped(self, vec_env: str | None = None, wrapped: bool = False) -> Any:
        """How its environments are stepped: as ``vec_env`` says, if it says something possible.

        :param wrapped: whether single ones are wrapped
        """
        spec = self.spec
        if vec_env not in (None, "gymnasium"):
            return vec_env
        if self.batch is not None and not wrapped:
            return "native"
        if spec is None or spec.vector_entry_point is None or wrapped:
            return "dummy"
        return vec_env or ("dummy" if spec.entry_point else "gymnasium")


def find(env_id: Any) -> Source:
    """The environments that an id stands for.

    :param env_id: an id of sb3_guard or of Safety-Gymnasium, with or without its version, any id
        registered with Gymnasium, a scenario, its plain data or its YAML file, or a class or
        function that makes an environment
    :raises ValueError: nothing of that name exists, with the nearest match
    :raises TypeError: it is an environment, not what makes one
    :raises gymnasium.error.DependencyNotInstalled: the package that has it is absent or too old
    """
    if hasattr(env_id, "step") and not isinstance(env_id, type):
        kind = type(getattr(env_id, "unwrapped", env_id)).__name__
        name = repr(spec.id) if (spec := getattr(env_id, "spec", None)) else f"lambda: {kind}(...)"
        raise TypeError(
            f"this {kind} is made already: give its id or a function that makes it, such as {name}"
        )
    if callable(env_id):
        name = getattr(env_id, "__qualname__", type(env_id).__name__)
        return Source(f"{env_id.__module__}.{name}", partial(_make_and_cut, env_id))
    if not isinstance(env_id, str) or env_id.endswith((".yml", ".yaml")):
        return _ours(env_id)
    env_id = env_id.removeprefix("sb3_guard:")
    spec = gymnasium.registry.get(with_version(env_id))
    if spec is not None and spec.entry_point == ENTRY_POINT:
        return _ours(env_id)
    try:
        if is_safety_gymnasium(env_id):
            return Source(env_id, partial(make_safety_gymnasium, env_id))
    except DependencyNotInstalled:
        if ":" not in env_id:
            _our_envs(env_id).env_spec(env_id)  # says what there is without the package
        raise
    if spec is not None:
        # The description, not the id: other processes may not have registered it.
        return Source(spec.id, partial(gymnasium.make, spec), spec=spec)
    if ":" in env_id:
        return Source(env_id, partial(gymnasium.make, env_id))  # which imports the module
    return _ours(env_id)


def _make_and_cut(
    make: Callable[..., gymnasium.Env], max_episode_steps: int | None = None, **kwargs: Any
) -> gymnasium.Env:
    env = make(**kwargs)
    if max_episode_steps is None:
        return env
    return gymnasium.wrappers.TimeLimit(env, max_episode_steps)


def _our_envs(env_id: Any) -> ModuleType:
    """``sb3_guard.envs``, or an error that says why ``env_id`` can't be looked up in it."""
    try:
        import sb3_guard.envs
    except ImportError as error:
        raise DependencyNotInstalled(
            f"unknown environment {env_id!r}: it is not registered with Gymnasium, and sb3_guard's "
            f"own environments need MuJoCo 4 or newer ({error})"
        ) from error
    return sb3_guard.envs


def _ours(env_id: str | Path | Mapping[str, Any] | Scenario) -> Source:
    envs = _our_envs(env_id)
    try:
        spec: EnvSpec = envs.env_spec(env_id)
        scenario = envs.as_scenario(spec.kwargs["scenario"])
    except UnknownId:
        near = nearest(str(env_id), [*envs.env_ids(), *gymnasium.registry])
        hint = "" if near is None else f"did you mean {near!r}? "
        if str(env_id).endswith(".xml"):
            hint = f"register the robot with sb3_guard.register_robot(NAME, xml={env_id!r}); "
        raise UnknownId(
            f"unknown environment {env_id!r}: {hint}allowed: ids of the form "
            "Task_Robot_NConstraint-v0, such as 'Goal_Point_8Hazards-v0', and ids registered with "
            f"Gymnasium{IMPORT_FIRST}"
        ) from None

    def batch(n_envs: int, **kwargs: Any) -> VecEnv:
        registered = {name: value for name, value in spec.kwargs.items() if name != "scenario"}
        if spec.max_episode_steps is not None:
            registered["max_episode_steps"] = spec.max_episode_steps
        return GuardVecEnv(scenario, n_envs, spec, **{**registered, **kwargs})

    make = partial(gymnasium.make, spec)
    return Source(spec.id, make, None if spec.additional_wrappers else batch, scenario)

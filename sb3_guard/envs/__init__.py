"""GUARD's environments: robots, tasks and constraints as batched parts on MuJoCo.

Importing this package registers the named environments with Gymnasium.
"""

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
    # MuJoCo chooses its OpenGL backend when it is imported; without a display only EGL can work
    os.environ.setdefault("MUJOCO_GL", "egl")

try:
    import mujoco.batch  # noqa: F401  # before modules that name what an older MuJoCo lacks
except (RuntimeError, AttributeError) as error:  # what a backend that is not there raises
    raise ImportError(
        f"mujoco does not import with MUJOCO_GL={os.environ.get('MUJOCO_GL')!r} ({error}): "
        "unset MUJOCO_GL, or set it to one of egl, glfw, osmesa that is installed",
        name="mujoco",
    ) from error
import gymnasium
from gymnasium.envs.registration import EnvSpec, parse_env_id

from sb3_guard.envs.gym_env import GuardEnv, as_scenario
from sb3_guard.envs.registry import (
    register_constraint,
    register_robot,
    register_task,
)
from sb3_guard.envs.scenario import Scenario
from sb3_guard.envs.suites import env_ids, episode_steps
from sb3_guard.envs.vector_env import GuardVectorEnv
from sb3_guard.ids import ENTRY_POINT, with_version

__all__ = [
    "GuardEnv",
    "GuardVectorEnv",
    "Scenario",
    "env_ids",
    "env_spec",
    "make",
    "register",
    "register_constraint",
    "register_robot",
    "register_task",
]


def env_spec(name: str | Path | Mapping[str, Any] | Scenario) -> EnvSpec:
    """Gymnasium's description of an environment, registered or not.

    :param name: an id of sb3_guard, with or without its version, a scenario, its plain data, or its
        YAML file
    :raises ValueError: the id cannot be read, or it is none of these
    """
    what: str | dict[str, Any]
    if isinstance(name, str) and not name.endswith((".yml", ".yaml")):
        what = name.removeprefix("sb3_guard:")  # what gymnasium.make would have to import
        env_id = with_version(what)
        if env_id in gymnasium.registry:
            return gymnasium.registry[env_id]
        Scenario.parse(what)
    else:
        env_id, what = "Guard-v0", as_scenario(name).to_dict()
    return EnvSpec(
        env_id,
        entry_point=ENTRY_POINT,
        vector_entry_point="sb3_guard.envs.vector_env:GuardVectorEnv",
        max_episode_steps=episode_steps(env_id),
        kwargs={"scenario": what},
    )


def register(name: str, scenario: str | Path | Mapping[str, Any] | Scenario | None = None) -> str:
    """Make an environment known to :func:`gymnasium.make`.

    :param name: an id such as ``Goal_Point_3Hazards-v0``; with a scenario, any name that does not
        say something else
    :param scenario: what it is, if the name does not say it: a scenario, its plain data, its YAML
        file or an id
    :return: the id, with its version
    :raises ValueError: the name cannot be read, it says something else than the scenario, or it is
        the id of somebody else's environment
    """
    if scenario is None:
        spec = env_spec(name)
    else:
        scenario = as_scenario(scenario)
        spec = env_spec(scenario)
        spec.id = with_version(name.removeprefix("sb3_guard:"))
        spec.namespace, spec.name, spec.version = parse_env_id(spec.id)
        try:
            agrees = spec.namespace is not None or Scenario.parse(spec.name) == scenario
        except ValueError:
            agrees = True  # the name says nothing
        if not agrees:
            raise ValueError(
                f"{name!r} is the name of another environment than the one given: "
                "choose a name that is not of the form Task_Robot_NConstraint"
            )
    known = gymnasium.registry.get(spec.id)
    if known is not None and known.entry_point != ENTRY_POINT:
        raise ValueError(
            f"{spec.id!r} is registered with Gymnasium already, for an environment that is not "
            "sb3_guard's: use another name"
        )
    gymnasium.registry[spec.id] = spec
    return spec.id


def make(name: str | Path | Mapping[str, Any] | Scenario, **kwargs: Any) -> gymnasium.Env:
    """:func:`gymnasium.make` for any id of sb3_guard; it needs no registration and no version.

    :param name: as for :func:`env_spec`
    :raises ValueError: unknown names, bad values, or ``observe={"remaining": ...}`` is not the
        time limit
    """
    env = gymnasium.make(env_spec(name), **kwargs)
    limit = None if env.spec is None else env.spec.max_episode_steps
    ours = env.unwrapped
    if isinstance(ours, GuardEnv) and limit is not None:
        ours.engine.extras.check_limit(limit)
    return env


for _env_id in env_ids():
    if _env_id not in gymnasium.registry:  # another package may have registered its own
        register(_env_id)

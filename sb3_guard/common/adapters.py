"""Anyone's environment: wherever it keeps its cost, here it ends up in ``info["cost"]``.

:class:`CostFromStep` finds it in a sixth value of ``step`` (Safety-Gymnasium),
:class:`CostFromFunction` computes it with a function of yours. A cost that ``info`` has under
another key needs no wrapper: algorithms take ``cost_keys``. Both are Gymnasium wrappers of single
environments and need neither torch nor MuJoCo.
"""

import copy
import operator
import re
import sys
from collections.abc import Callable
from typing import Any, ClassVar, SupportsFloat

import gymnasium as gym
from gymnasium.error import DependencyNotInstalled
from gymnasium.utils import RecordConstructorArgs

from sb3_guard.costs import number
from sb3_guard.fields import nearest

#: ``cost(obs, action, next_obs, info)``, see :class:`CostFromFunction`
CostFunction = Callable[[Any, Any, Any, dict[str, Any]], Any]
Step = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]

_SAFETY_GYMNASIUM_ID = re.compile(r"(safety_gymnasium:)?Safety\w+-v\d+")


def is_safety_gymnasium(env_id: str) -> bool:
    """Whether an id is one of Safety-Gymnasium's, to be made by :func:`make_safety_gymnasium`.

    ``safety_gymnasium:`` before an id says so; without it, tasks that sb3_guard has itself are its
    own. Else who registered an id decides. Of one that nobody registered its form does, and if the
    package can be imported, it has the last word. ``Safety…Gymnasium-v0``, the package's own
    conversion to five values, belongs here too: adapting it twice changes nothing.

    :raises gymnasium.error.DependencyNotInstalled: the id has the form, and the package is absent
        or does not import
    """
    if env_id not in gym.registry and _SAFETY_GYMNASIUM_ID.fullmatch(env_id):
        _import_safety_gymnasium(env_id)
    spec = gym.registry.get(env_id.removeprefix("safety_gymnasium:"))
    return spec is not None and str(spec.entry_point).startswith("safety_gymnasium.")


def make_safety_gymnasium(env_id: str, **kwargs: Any) -> gym.Env:
    """Make an environment of Safety-Gymnasium (Ji et al. 2023) that steps as Gymnasium's do.

    Its registered ids can't go through :func:`gymnasium.make`, whose wrappers expect five values.

    :param env_id: such as ``SafetyPointGoal1-v0``
    :param kwargs: for ``safety_gymnasium.make``, such as ``render_mode`` or ``max_episode_steps``
    :return: the environment; ``info["cost"]`` is the cost, its ``cost_<kind>`` entries stay
    :raises gymnasium.error.DependencyNotInstalled: the package is absent or does not import
    :raises gymnasium.error.NameNotFound: it has no such environment
    """
    package = _import_safety_gymnasium(env_id)
    name = env_id.removeprefix("safety_gymnasium:")
    spec = gym.registry.get(name)
    if spec is None:
        known = [key for key in gym.registry if is_safety_gymnasium(key)]
        near = nearest(name, known)
        hint = "" if near is None else f": did you mean {near!r}?"
        raise gym.error.NameNotFound(f"Safety-Gymnasium has no environment {name!r}{hint}")
    if str(spec.entry_point).endswith(":make_gymnasium_environment"):
        return gym.make(name, **kwargs)
    return CostFromStep(package.make(name, **kwargs))


def _import_safety_gymnasium(env_id: str) -> Any:
    try:
        import safety_gymnasium  # type: ignore[import-not-found]
    except Exception as error:
        # Beside newer packages its import fails in many ways: attributes gone, dataclasses refused.
        absent = isinstance(error, ModuleNotFoundError) and error.name == "safety_gymnasium"
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise DependencyNotInstalled(
            f"{env_id!r} needs the package safety-gymnasium, which "
            + ("is not installed" if absent else f"can't be imported here ({reason})")
            + ". It wants MuJoCo 2.3, Gymnasium 0.29 and a mended source from Python 3.11 on: "
            "scripts/safety_gymnasium/check.py sets up an environment that works "
            "(docs/your_environment.md)"
        ) from error
    return safety_gymnasium


class CostFromStep(gym.Wrapper, RecordConstructorArgs):
    """Turn a ``step`` of six values, the cost third, into Gymnasium's five.

    That is Safety-Gymnasium's interface: ``obs, reward, cost, terminated, truncated, info``. The
    cost becomes ``info["cost"]``; the other entries, such as ``cost_hazards`` and ``cost_sum``,
    stay, so each of them can be limited by ``cost_keys``.

    :param env: an environment with the six values, made without Gymnasium's own wrappers
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(self, action: Any) -> Step:
        """
        :raises ValueError: the step does not have six values, or the cost is not a number
        """
        values: tuple[Any, ...] = self.env.step(action)
        if len(values) != 6:
            raise ValueError(
                f"step returned {len(values)} values, not six (obs, reward, cost, terminated, "
                "truncated, info): if the cost is in info, name it in cost_keys, without an adapter"
            )
        obs, reward, cost, terminated, truncated, info = values
        info = {**info, "cost": number(cost, "the cost")}
        return obs, reward, bool(terminated), bool(truncated), info


class CostAsThirdValue(gym.Wrapper, RecordConstructorArgs):
    """The other way round: ``step`` returns six values, as Safety-Gymnasium's environments do.

    For libraries that train on Safety-Gymnasium, such as OmniSafe and SafePO: ``obs, reward, cost,
    terminated, truncated, info``, the cost as a float. It must be the outermost wrapper, since
    Gymnasium's own expect five values.

    :param env: an environment whose ``info`` holds ``"cost"``
    :raises KeyError: it does not
    """

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def step(  # type: ignore[override]
        self, action: Any
    ) -> tuple[Any, SupportsFloat, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        if "cost" not in info:
            raise KeyError(f"info has no 'cost': {sorted(info)}; use CostFromFunction first")
        cost = float(info["cost"])
        return obs, reward, cost, terminated, truncated, {**info, "cost_sum": cost}


class CostFromFunction(gym.Wrapper, RecordConstructorArgs):
    """Charge what a function of yours says: any environment becomes a constrained one.

    A wrapper each, with keys of their own, makes several costs that ``cost_keys`` limit one by one.
    For vector environments there is :class:`~sb3_guard.vector.GymnasiumVecEnv`.

    :param env: the environment
    :param cost: ``cost(obs, action, next_obs, info)``, called after each step with the observation
        before it, the action, the observation after it and the step's ``info``. It returns a
        number. Its name, ``"package.module:function"``, will do, so that a hyperparameter file can
        say it; the module must have been imported, because a file may not run code
    :param key: entry of ``info`` that becomes the cost
    :raises ValueError: there is no function of that name, or its module is not imported
    """

    most_costs: ClassVar[dict[str, float]] = {}  # not those of the environment: nobody can say

    def __init__(self, env: gym.Env, cost: CostFunction | str, key: str = "cost") -> None:
        RecordConstructorArgs.__init__(self, cost=cost, key=key)
        gym.Wrapper.__init__(self, env)
        self.key = key
        if isinstance(cost, str):
            module, _, name = cost.rpartition(":" if ":" in cost else ".")
            if module not in sys.modules:
                raise ValueError(
                    f"cost={cost!r}: must be a function or the name 'package.module:function' of "
                    f"an imported one; import {module!r} first, or add --gym-packages {module}"
                )
            try:
                cost = operator.attrgetter(name)(sys.modules[module])
            except AttributeError as error:
                raise ValueError(f"cost={cost!r}: {error}") from error
        if not callable(cost):
            raise ValueError(f"cost={cost!r}: must be a function cost(obs, action, next_obs, info)")
        self.cost: CostFunction = cost
        self.last_observation: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        # a copy: the environment may write the next observation into the same array
        self.last_observation = copy.deepcopy(obs)
        return obs, info

    def step(self, action: Any) -> Step:
        """
        :raises ValueError: the function did not return a finite number
        """
        obs, reward, terminated, truncated, info = self.env.step(action)
        cost = number(
            self.cost(self.last_observation, action, obs, info), "what cost(...) returned"
        )
        self.last_observation = copy.deepcopy(obs)
        return obs, reward, terminated, truncated, {**info, self.key: cost}

"""Wrappers of single environments that make use of a cost which ``info`` reports.

:class:`RemainingBudget` shows the agent what is left of a budget, :class:`EarlyTermination` ends
the episode that overspends it, :class:`MaxCost` shows the highest cost of the episode so far. They
need neither torch nor MuJoCo; ``vec_budgets.py`` has the same for all environments of a ``VecEnv``
at once. What both do is in ``Remaining``, ``Spending`` and ``Highest``, for N environments.
"""

import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

from sb3_guard.checks import check_number
from sb3_guard.common.adapters import Step
from sb3_guard.costs import read_costs


def with_numbers(space: spaces.Space, name: str, size: int) -> spaces.Space:
    """The space of observations that ``size`` more numbers have joined.

    A flat observation gets them at its end, a dictionary as the entry ``name``; any other becomes a
    dictionary of ``"observation"`` and ``name``.

    :raises ValueError: there is an entry of that name already
    """
    more = spaces.Box(-np.inf, np.inf, (size,), np.float32)
    if isinstance(space, spaces.Dict):
        if name in space.spaces:
            raise ValueError(
                f"the observation has an entry {name!r} already: is the environment wrapped twice?"
            )
        return spaces.Dict({**space.spaces, name: more})
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        dtype = space.dtype if space.dtype in (np.float32, np.float64) else np.float32
        low = np.append(space.low, more.low).astype(dtype)
        high = np.append(space.high, more.high).astype(dtype)
        return spaces.Box(low, high, dtype=dtype)
    return spaces.Dict({"observation": space, name: more})


def join(outer: Any, inner: Any, obs: Any, name: str, numbers: np.ndarray) -> Any:
    """The observation with the numbers, as :func:`with_numbers` says; also batches of both.

    :param outer: who has the joint ``observation_space``
    :param inner: who has the space of ``obs``
    :param numbers: shape [size], or [N, size] for a batch
    """
    space = outer.observation_space
    if isinstance(space, spaces.Box):
        return np.concatenate([obs, numbers], axis=-1).astype(space.dtype)
    numbers = numbers.astype(np.float32)
    if isinstance(inner.observation_space, spaces.Dict):
        return {**obs, name: numbers}
    return {"observation": obs, name: numbers}


def _has_monitor(env: gym.Env) -> bool:
    """Whether SB3's ``Monitor`` is among the wrappers; if SB3 isn't imported, it can't be."""
    module = sys.modules.get("stable_baselines3.common.monitor")
    while module is not None and isinstance(env, gym.Wrapper):
        if isinstance(env, module.Monitor):
            return True
        env = env.env
    return False


class _Counting:
    name: str  # of the numbers that join the observation
    first: float  # what they are when an episode begins
    numbers: np.ndarray  # [N, size]
    #: become the wrapper of environments, with so many numbers; and arguments to tell of
    _wrap: Callable[[Any, int, dict[str, Any]], None]
    #: rewards and infos of a step, from those it had; ``numbers`` are those after it
    _count: Callable[[Any, Any], tuple[Any, Any]]


class Remaining(_Counting):
    """What :class:`RemainingBudget` counts, in N environments."""

    name, first = "budget", 1.0
    training_arguments = ("unsafe_reward",)

    def __init__(
        self,
        env: Any,
        budget: float,
        discount: float = 1.0,
        unsafe_reward: float | None = None,
        cost_key: str = "cost",
    ) -> None:
        check_number("budget", budget, ends="()")
        self.budget = float(budget)
        check_number("discount", discount, 0.0, 1.0, "(]")
        self.discount = float(discount)
        if unsafe_reward is not None:
            check_number("unsafe_reward", unsafe_reward, -np.inf, ends="()")
        self.unsafe_reward = unsafe_reward
        self.cost_key = cost_key
        kwargs = {"discount": discount, "unsafe_reward": unsafe_reward, "cost_key": cost_key}
        self._wrap(env, 1, {"budget": budget, **kwargs})

    def _count(self, rewards: Any, infos: Sequence[dict[str, Any]]) -> tuple[Any, Any]:
        costs, _ = read_costs(infos, [self.cost_key])  # [N, 1]
        self.numbers = (self.numbers - costs / self.budget) / self.discount
        if self.unsafe_reward is not None:
            rewards = np.where(self.numbers[:, 0] < 0.0, self.unsafe_reward, rewards)
        return rewards, infos


class Highest(_Counting):
    """What :class:`MaxCost` counts, in N environments."""

    name, first = "max_cost", 0.0

    def __init__(self, env: Any, cost_keys: Sequence[str] = ("cost",)) -> None:
        self.cost_keys = tuple(cost_keys)
        self._wrap(env, len(self.cost_keys), {"cost_keys": cost_keys})

    def _count(self, rewards: Any, infos: Sequence[dict[str, Any]]) -> tuple[Any, Any]:
        costs, _ = read_costs(infos, self.cost_keys)
        increase = np.maximum(costs - self.numbers, 0.0).tolist()
        self.numbers = np.maximum(self.numbers, costs)
        names = [f"{key}_increase" for key in self.cost_keys]
        pairs = zip(infos, increase, strict=True)
        return rewards, [{**info, **dict(zip(names, row, strict=True))} for info, row in pairs]


class Spending:
    """What :class:`EarlyTermination` counts, in N environments."""

    episode_costs: np.ndarray  # [N]
    _wrap: Callable[[Any, dict[str, Any]], None]

    def __init__(
        self, env: Any, budget: float, final_reward: float = 0.0, cost_key: str = "cost"
    ) -> None:
        check_number("budget", budget)
        self.budget = float(budget)
        check_number("final_reward", final_reward, -np.inf, ends="()")
        self.final_reward = float(final_reward)
        self.cost_key = cost_key
        self._wrap(env, {"budget": budget, "final_reward": final_reward, "cost_key": cost_key})

    def _count(self, rewards: Any, infos: Sequence[dict[str, Any]]) -> tuple[np.ndarray, Any, Any]:
        """Which rows are over the budget, [N] bool, and rewards and infos of the step."""
        self.episode_costs = self.episode_costs + read_costs(infos, [self.cost_key])[0][:, 0]
        over = self.episode_costs > self.budget
        if over.any():
            rewards = np.where(over, np.asarray(rewards) + self.final_reward, rewards)
            exceeded = {"budget_exceeded": True}
            infos = [
                {**info, **(exceeded if bad else {})} for info, bad in zip(infos, over, strict=True)
            ]
        return over, rewards, infos


class _Observing(_Counting, gym.Wrapper, RecordConstructorArgs):
    def _wrap(self, env: gym.Env, size: int, arguments: dict[str, Any]) -> None:
        RecordConstructorArgs.__init__(self, **arguments)
        gym.Wrapper.__init__(self, env)
        self.numbers = np.full((1, size), self.first)
        self.observation_space = with_numbers(env.observation_space, self.name, size)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        self.numbers = np.full_like(self.numbers, self.first)
        return join(self, self.env, obs, self.name, self.numbers[0]), info

    def step(self, action: Any) -> Step:
        """
        :raises ValueError: ``info`` lacks a cost, or it is not a number
        """
        obs, reward, terminated, truncated, info = self.env.step(action)
        [reward], [info] = self._count([reward], [info])
        obs = join(self, self.env, obs, self.name, self.numbers[0])
        return obs, reward, terminated, truncated, info


class RemainingBudget(Remaining, _Observing):
    """Show the agent what is left of its cost budget, so that it can use it wisely.

    A limit on the episode's cost depends on the past, which a policy of the observation alone does
    not know. Sauté RL (Sootla et al., ICML 2022) adds the remaining share z of the budget to it:
    z₀ = 1, z_{t+1} = (z_t - cost_t / budget) / discount, negative when the budget is overspent.
    A flat observation gets z as its last number, a dictionary an entry ``"budget"`` of shape (1,);
    any other becomes a dictionary of ``"observation"`` and ``"budget"``.

    With ``unsafe_reward``, the reward of every step that ends with z < 0 is replaced, as in the
    paper: then any algorithm for rewards alone learns to keep the budget. Evaluate without it to
    see true returns.

    :param env: an environment that reports its cost; adapters go inside
    :param budget: what an episode may cost, above 0
    :param discount: discount factor of the costs, in (0, 1]
    :param unsafe_reward: reward of the steps after the budget is overspent; None leaves rewards
    :param cost_key: entry of ``info`` that is counted
    :raises ValueError: an argument is out of its range, or the observation has an entry
        ``"budget"`` already
    """


class EarlyTermination(Spending, gym.Wrapper, RecordConstructorArgs):
    """End an episode that costs more than its budget, so that overspending gives no reward.

    The early-terminated MDP of Sun et al. (2021): with it an algorithm for rewards alone respects
    a limit, if rewards are positive. Where they are not, ending early is tempting, and
    ``final_reward`` must make up for it. The step that overspends is ``terminated`` and has
    ``info["budget_exceeded"]``; using up the budget exactly is allowed.

    It goes inside SB3's ``Monitor``, which otherwise never sees the episodes that are ended here:
    a warning says so.

    :param env: an environment that reports its cost; adapters go inside
    :param budget: what an episode may cost, at least 0
    :param final_reward: added to the reward of the step that overspends
    :param cost_key: entry of ``info`` that is counted
    :raises ValueError: an argument is out of its range
    """

    #: Commands evaluate without it: no episode would cost more than its budget, whatever the agent.
    training_only = True

    def _wrap(self, env: gym.Env, arguments: dict[str, Any]) -> None:
        RecordConstructorArgs.__init__(self, **arguments)
        gym.Wrapper.__init__(self, env)
        self.episode_costs = np.zeros(1)
        if _has_monitor(env):
            warnings.warn(
                "EarlyTermination is around a Monitor, which will not report the episodes that "
                "overspend: wrap the environment before its monitor, as "
                "sb3_guard.make_vec_env(..., wrapper_class=...) does; SB3's takes a function that "
                "makes it wrapped",
                UserWarning,
                stacklevel=3,
            )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self.episode_costs = np.zeros(1)
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> Step:
        """
        :raises ValueError: ``info`` lacks the cost, or it is not a number
        """
        obs, reward, terminated, truncated, info = self.env.step(action)
        [over], [reward], [info] = self._count([reward], [info])
        return obs, reward, terminated or bool(over), truncated, info


class MaxCost(Highest, _Observing):
    """Show the agent the highest cost of a step so far, for limits on the worst step.

    State-wise constrained policy optimisation (Zhao et al., 2023, arXiv 2306.12594) bounds
    ``E[max_t c_t]``. With M_t, the highest cost before step t (0 at first), the increments
    ``D_t = max(0, c_t - M_t)`` add up to the highest cost of the episode: an algorithm that limits
    the sum of ``info["<key>_increase"]`` limits the worst step. M joins the observation as the
    remaining budget does in :class:`RemainingBudget`, under the name ``"max_cost"``.

    :param env: an environment that reports its costs
    :param cost_keys: entries of ``info``, each with a maximum of its own
    """

"""Wrappers that make use of the costs which infos report.

:class:`VecRemainingBudget` shows the agent what is left of a budget, and :class:`VecMaxCost` the
highest cost of an episode so far. Both wrap a ``VecEnv``, inside or outside of ``CostMonitor``, and
inside ``VecNormalize`` and frame stacks. :class:`EarlyTermination` wraps a single environment, and
ends episodes that overspend a budget.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_guard.costs import read_costs
from sb3_guard.fields import fit


class Counted(VecEnvWrapper):
    """Numbers that a wrapper counts join the observation.

    A flat observation gets them at its end, a dictionary as the entry ``name``; any other becomes a
    dictionary of ``"observation"`` and ``name``.

    :param env: the environments
    :param size: how many numbers
    :raises ValueError: the observation has an entry of that name already
    """

    name: ClassVar[str]
    first: ClassVar[float]  # what the numbers are when an episode begins

    def __init__(self, env: VecEnv, size: int) -> None:
        self.numbers = np.full((env.num_envs, size), self.first)
        space, more = env.observation_space, spaces.Box(-np.inf, np.inf, (size,), np.float32)
        joined: spaces.Space
        if isinstance(space, spaces.Dict):
            if self.name in space.spaces:
                raise ValueError(
                    f"the observation has an entry {self.name!r} already: is the environment "
                    "wrapped twice?"
                )
            joined = spaces.Dict({**space.spaces, self.name: more})
        elif isinstance(space, spaces.Box) and len(space.shape) == 1:
            dtype = space.dtype if space.dtype in (np.float32, np.float64) else np.float32
            low, high = np.append(space.low, more.low), np.append(space.high, more.high)
            joined = spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype)
        else:
            joined = spaces.Dict({"observation": space, self.name: more})
        super().__init__(env, joined)

    def count(self, rewards: np.ndarray, infos: list[dict[str, Any]]) -> tuple[np.ndarray, Any]:
        """Count a step in ``numbers``; return its rewards and infos."""
        raise NotImplementedError

    def _join(self, obs: Any, numbers: np.ndarray) -> Any:
        """An observation with the numbers, [size], or a batch of both, [N, size]."""
        space = self.observation_space
        if isinstance(space, spaces.Box):
            return np.concatenate([obs, numbers], axis=-1).astype(space.dtype)
        numbers = numbers.astype(np.float32)
        if isinstance(self.venv.observation_space, spaces.Dict):
            return {**obs, self.name: numbers}
        return {"observation": obs, self.name: numbers}

    def reset(self) -> VecEnvObs:
        self.numbers = np.full_like(self.numbers, self.first)
        return self._join(self.venv.reset(), self.numbers)

    def step_wait(self) -> VecEnvStepReturn:
        """
        :raises ValueError: an info lacks a cost, or it is not a number
        """
        obs, rewards, dones, infos = self.venv.step_wait()
        rewards, infos = self.count(rewards, list(infos))
        # Rows whose episode ended begin with new numbers.
        for row in np.flatnonzero(dones):
            last = self._join(infos[row]["terminal_observation"], self.numbers[row])
            infos[row] = {**infos[row], "terminal_observation": last}
        self.numbers = np.where(dones[:, None], self.first, self.numbers)
        return self._join(obs, self.numbers), rewards, dones, infos


class VecRemainingBudget(Counted):
    """Show the agent what is left of its cost budget, so that it can use it wisely.

    A limit on the episode's cost depends on the past, which a policy of the observation alone does
    not know. Sauté RL (Sootla et al., ICML 2022) adds the remaining share z of the budget to it:
    z₀ = 1, z_{t+1} = (z_t - cost_t / budget) / discount, negative when the budget is overspent.
    A flat observation gets z as its last number, a dictionary an entry ``"budget"`` of shape (1,);
    any other becomes a dictionary of ``"observation"`` and ``"budget"``.

    With ``unsafe_reward``, the reward of every step that ends with z < 0 is replaced, as in the
    paper: then any algorithm for rewards alone learns to keep the budget. Evaluate without it to
    see true returns.

    :param env: environments that report their cost
    :param budget: what an episode may cost, above 0
    :param discount: discount factor of the costs, in (0, 1]
    :param unsafe_reward: reward of the steps after the budget is overspent; None leaves rewards
    :param cost_key: entry of ``info`` that is counted
    :raises ValueError: an argument is out of its range, or the observation has an entry
        ``"budget"`` already
    """

    name, first = "budget", 1.0
    training_arguments = ("unsafe_reward",)

    def __init__(
        self,
        env: VecEnv,
        budget: float,
        discount: float = 1.0,
        unsafe_reward: float | None = None,
        cost_key: str = "cost",
    ) -> None:
        self.budget = fit("budget", budget, float, 0.0)
        self.discount = fit("discount", discount, float, 0.0, 1.0, "(]")
        self.unsafe_reward = fit("unsafe_reward", unsafe_reward, float | None)
        self.cost_key = cost_key
        super().__init__(env, 1)

    def count(self, rewards: np.ndarray, infos: list[dict[str, Any]]) -> tuple[np.ndarray, Any]:
        costs, _ = read_costs(infos, [self.cost_key])  # [N, 1]
        self.numbers = (self.numbers - costs / self.budget) / self.discount
        if self.unsafe_reward is not None:
            rewards = np.where(self.numbers[:, 0] < 0.0, self.unsafe_reward, rewards)
        return rewards, infos


class VecMaxCost(Counted):
    """Show the agent the highest cost of a step so far, for limits on the worst step.

    State-wise constrained policy optimisation (Zhao et al., 2023, arXiv 2306.12594) bounds
    ``E[max_t c_t]``. With M_t, the highest cost before step t (0 at first), the increments
    ``D_t = max(0, c_t - M_t)`` add up to the highest cost of the episode: an algorithm that limits
    the sum of ``info["<key>_increase"]`` limits the worst step. M joins the observation as the
    remaining budget does in :class:`VecRemainingBudget`, under the name ``"max_cost"``.

    :param env: environments that report their costs
    :param cost_keys: entries of ``info``, each with a maximum of its own
    """

    name, first = "max_cost", 0.0

    def __init__(self, env: VecEnv, cost_keys: Sequence[str] = ("cost",)) -> None:
        self.cost_keys = tuple(cost_keys)
        super().__init__(env, len(self.cost_keys))

    def count(self, rewards: np.ndarray, infos: list[dict[str, Any]]) -> tuple[np.ndarray, Any]:
        costs, _ = read_costs(infos, self.cost_keys)
        increase = np.maximum(costs - self.numbers, 0.0).tolist()
        self.numbers = np.maximum(self.numbers, costs)
        names = [f"{key}_increase" for key in self.cost_keys]
        pairs = zip(infos, increase, strict=True)
        return rewards, [{**info, **dict(zip(names, row, strict=True))} for info, row in pairs]


class EarlyTermination(gym.Wrapper, RecordConstructorArgs):
    """End an episode that costs more than its budget, so that overspending gives no reward.

    The early-terminated MDP of Sun et al. (2021): with it an algorithm for rewards alone respects
    a limit, if rewards are positive. Where they are not, ending early is tempting, and
    ``final_reward`` must make up for it. The step that overspends is terminal; a budget may be used
    up exactly. It wraps a single environment: a batch has to end its rows itself.

    :param env: an environment that reports its cost
    :param budget: what an episode may cost, at least 0
    :param final_reward: added to the reward of the step that overspends
    :param cost_key: entry of ``info`` that is counted
    :raises ValueError: an argument is out of its range
    """

    #: Commands evaluate without it: no episode would cost more than its budget, whatever the agent.
    training_only = True

    def __init__(
        self, env: gym.Env, budget: float, final_reward: float = 0.0, cost_key: str = "cost"
    ) -> None:
        RecordConstructorArgs.__init__(
            self, budget=budget, final_reward=final_reward, cost_key=cost_key
        )
        gym.Wrapper.__init__(self, env)
        self.budget = fit("budget", budget, float, 0.0, ends="[)")
        self.final_reward = fit("final_reward", final_reward, float)
        self.cost_key = cost_key
        self.episode_cost = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self.episode_cost = 0.0
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :raises ValueError: the info lacks the cost, or it is not a number
        """
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.episode_cost += float(read_costs([info], [self.cost_key])[0][0, 0])
        if self.episode_cost > self.budget:
            reward, terminated = float(reward) + self.final_reward, True
        return obs, reward, terminated, truncated, info

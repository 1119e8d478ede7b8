"""The wrappers of ``budgets.py`` for all environments of a ``VecEnv`` at once.

Row i is, bit for bit, what the wrapper of one environment makes of environment i, on the native
batch at nearly its speed. They go inside or outside of ``CostMonitor``, and inside ``VecNormalize``
and frame stacks.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_guard.common.budgets import Highest, Remaining, Spending, _Counting, join, with_numbers


def end_rows(venv: VecEnv, rows: Sequence[int], infos: list[dict[str, Any]]) -> Any:
    """End the episodes of some rows and begin new ones there.

    :param rows: their numbers
    :param infos: of the step that ended them; a monitor adds its statistics there
    :return: observations, of which those of ``rows`` are new
    :raises ValueError: a wrapper on the way knows nothing of episodes that others end
    """
    if hasattr(type(venv), "end_rows"):
        return venv.end_rows(rows, infos)  # type: ignore[attr-defined]
    if isinstance(venv, VecEnvWrapper):
        raise ValueError(
            f"VecEarlyTermination can't end single episodes of {type(venv).__name__}: it belongs "
            "inside of it, next to the environments or CostMonitor"
        )
    begun = venv.env_method("reset", indices=rows)
    observations: Any = [None] * venv.num_envs
    for row, (obs, _) in zip(rows, begun, strict=True):
        observations[row] = obs
    return observations


def replace_rows(obs: Any, rows: Sequence[int], new: Any) -> Any:
    """A batch of observations with those of some rows replaced; the old one is left as it is."""
    if isinstance(obs, dict):
        listed = isinstance(new, list)
        return {
            key: replace_rows(value, rows, {r: new[r][key] for r in rows} if listed else new[key])
            for key, value in obs.items()
        }
    replaced = obs.copy()
    for row in rows:
        replaced[row] = new[row]
    return replaced


class _Observing(_Counting, VecEnvWrapper):
    def _wrap(self, env: VecEnv, size: int, arguments: dict[str, Any]) -> None:
        self.numbers = np.full((env.num_envs, size), self.first)
        VecEnvWrapper.__init__(self, env, with_numbers(env.observation_space, self.name, size))

    def reset(self) -> VecEnvObs:
        self.numbers = np.full_like(self.numbers, self.first)
        return join(self, self.venv, self.venv.reset(), self.name, self.numbers)

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        rewards, infos = self._count(rewards, list(infos))
        # Rows whose episode ended begin with new numbers.
        for row in np.flatnonzero(dones):
            last = infos[row]["terminal_observation"]
            last = join(self, self.venv, last, self.name, self.numbers[row])
            infos[row] = {**infos[row], "terminal_observation": last}
        self.numbers = np.where(dones[:, None], self.first, self.numbers)
        return join(self, self.venv, obs, self.name, self.numbers), rewards, dones, infos

    def end_rows(self, rows: Sequence[int], infos: list[dict[str, Any]]) -> Any:
        """See :func:`end_rows`."""
        new = end_rows(self.venv, rows, infos)
        self.numbers[list(rows)] = self.first
        if not isinstance(new, list):
            return join(self, self.venv, new, self.name, self.numbers)
        pairs = enumerate(new)
        return [
            None if obs is None else join(self, self.venv, obs, self.name, self.numbers[row])
            for row, obs in pairs
        ]


class VecRemainingBudget(Remaining, _Observing):
    """:class:`~sb3_guard.common.budgets.RemainingBudget` of every row (Sootla et al., 2022).

    :param env: environments that report their cost
    :param budget: what an episode may cost, above 0
    :param discount: discount factor of the costs, in (0, 1]
    :param unsafe_reward: reward of the steps after the budget is overspent; None leaves rewards
    :param cost_key: entry of ``info`` that is counted
    :raises ValueError: an argument is out of its range
    """


class VecMaxCost(Highest, _Observing):
    """:class:`~sb3_guard.common.budgets.MaxCost` of every row (Zhao et al., 2023).

    :param env: environments that report their costs
    :param cost_keys: entries of ``info``, each with a maximum of its own
    """


class VecEarlyTermination(Spending, VecEnvWrapper):
    """:class:`~sb3_guard.common.budgets.EarlyTermination` of every row (Sun et al., 2021).

    :param env: environments that report their cost, perhaps in a ``CostMonitor``, which then
        reports the episodes that end here, without ``final_reward``
    :param budget: what an episode may cost, at least 0
    :param final_reward: added to the reward of the step that overspends
    :param cost_key: entry of ``info`` that is counted
    :raises ValueError: an argument is out of its range
    """

    training_only = True  # as EarlyTermination

    def _wrap(self, env: VecEnv, arguments: dict[str, Any]) -> None:
        VecEnvWrapper.__init__(self, env)
        self.episode_costs = np.zeros(env.num_envs)

    def reset(self) -> VecEnvObs:
        self.episode_costs = np.zeros(self.num_envs)
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        over, rewards, infos = self._count(rewards, list(infos))
        if over.any():
            for row in np.flatnonzero(over).tolist():
                infos[row]["TimeLimit.truncated"] = False
            rows = np.flatnonzero(over & ~dones).tolist()
            if rows:
                for row in rows:
                    last = (
                        {key: value[row] for key, value in obs.items()}
                        if isinstance(obs, dict)
                        else obs[row]
                    )
                    infos[row]["terminal_observation"] = last
                obs = replace_rows(obs, rows, end_rows(self.venv, rows, infos))
            dones = dones | over
        self.episode_costs[dones] = 0.0
        return obs, rewards, dones, infos

    def end_rows(self, rows: Sequence[int], infos: list[dict[str, Any]]) -> Any:
        """See :func:`end_rows`."""
        self.episode_costs[list(rows)] = 0.0
        return end_rows(self.venv, rows, infos)

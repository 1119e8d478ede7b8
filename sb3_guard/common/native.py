"""The bridge between the two worlds: our environments as a Stable-Baselines3 ``VecEnv``.

It steps all environments in one call on one batch of simulations. Our environments are imported
where it is made: this module loads where MuJoCo is older than they need.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.envs.registration import EnvSpec

from sb3_guard.vector import BatchVecEnv

if TYPE_CHECKING:
    from sb3_guard.envs import GuardVectorEnv
    from sb3_guard.envs.scenario import Scenario


class GuardVecEnv(BatchVecEnv):
    """N environments of sb3_guard on one batch of simulations, for Stable-Baselines3.

    Equals, bit for bit, a ``DummyVecEnv`` of N single environments with seeds s, s + 1, …, and is
    many times faster.

    :param scenario: an id, a scenario, its plain data or its YAML file; or the vector environment,
        which is then stepped itself, and has been given the other arguments
    :param num_envs: number of environments N
    :param spec: what Gymnasium calls it, if it is registered
    :param kwargs: as for :class:`~sb3_guard.envs.vector_env.GuardVectorEnv`
    """

    def __init__(
        self,
        scenario: str | Path | Mapping[str, Any] | Scenario | GuardVectorEnv,
        num_envs: int = 1,
        spec: EnvSpec | None = None,
        **kwargs: Any,
    ) -> None:
        import sb3_guard.envs as envs

        batch = scenario
        if not isinstance(batch, envs.GuardVectorEnv):
            batch = envs.GuardVectorEnv(num_envs, batch, **kwargs)
        # algorithms read the length of an episode from it; a registered one is not ours to change
        spec = copy.deepcopy(spec or envs.env_spec(batch.scenario))
        spec.max_episode_steps = batch.max_episode_steps
        # which are no arguments of a single one
        others = {"num_threads", "num_envs", "max_episode_steps", "autoreset_mode"}
        others |= {"vectorization_mode"}
        given = batch.spec.kwargs if batch.spec is not None else kwargs
        spec.kwargs |= {name: given[name] for name in given.keys() - others}
        batch.spec = spec
        super().__init__(
            batch, batch.num_envs, batch.single_observation_space, batch.single_action_space
        )

    def reset(self) -> Any:
        obs = self.envs.begin(self._seeds)
        drawn = self.envs.engine.drawn.info()
        self.reset_infos = [
            {name: values[row].item() for name, values in drawn.items()}
            for row in range(self.num_envs)
        ]
        self._reset_seeds()
        self._reset_options()
        return self.envs.view(obs, self.envs.look())

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        t = self.envs.advance(self._actions)
        out = t.outcome
        # new dictionaries every step: Stable-Baselines3 keeps the ones it is given
        infos: list[dict[str, Any]] = [
            {"cost": cost, "TimeLimit.truncated": False} for cost in out.cost.tolist()
        ]
        for name, values in out.details.items():
            for info, value in zip(infos, values.tolist(), strict=True):
                info[name] = value
        for name, happened in out.events.items():
            if np.count_nonzero(happened):
                for row in np.flatnonzero(happened).tolist():
                    infos[row][name] = True
        for name, rows in out.ended_by.items():
            for row in np.flatnonzero(rows).tolist():
                infos[row]["terminated_by"] = name
        if np.count_nonzero(t.done):
            for row in np.flatnonzero(t.done).tolist():
                last = self.envs.view(out.obs, t.final_images, row)
                infos[row]["terminal_observation"] = last
                infos[row]["TimeLimit.truncated"] = bool(t.truncated[row] & ~out.terminated[row])
        return self.envs.view(t.obs, t.images), out.reward.astype(np.float32), t.done, infos

    def get_images(self) -> Sequence[np.ndarray | None]:
        return [self.envs.frame(row) for row in range(self.num_envs)]

    def state(self) -> dict[str, Any]:
        """Everything the coming steps depend on, the generators included."""
        return self.envs.state()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state` bit for bit, whatever the number of threads."""
        self.envs.restore(state)

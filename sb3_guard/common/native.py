"""The bridge between the two worlds: our environments as a Stable-Baselines3 ``VecEnv``.

It steps all environments in one call on one batch of simulations. Our environments are imported
where it is made: this module loads where MuJoCo is older than they need.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

if TYPE_CHECKING:
    from sb3_guard.envs.scenario import Scenario


class GuardVecEnv(VecEnv):
    """N environments of sb3_guard on one batch of simulations, for Stable-Baselines3.

    Equals, bit for bit, a ``DummyVecEnv`` of N single environments with seeds s, s + 1, …, and is
    many times faster.

    :param scenario: an id, a scenario, its plain data or its YAML file
    :param num_envs: number of environments N
    :param spec: what Gymnasium calls it, if it is registered
    :param kwargs: as for :class:`~sb3_guard.envs.vector_env.GuardVectorEnv`
    """

    def __init__(
        self,
        scenario: str | Path | Mapping[str, Any] | Scenario,
        num_envs: int = 1,
        spec: EnvSpec | None = None,
        **kwargs: Any,
    ) -> None:
        import sb3_guard.envs as envs

        self.envs = envs.GuardVectorEnv(num_envs, scenario, **kwargs)
        # algorithms read the length of an episode from it; a registered one is not ours to change
        self.spec = copy.deepcopy(spec or envs.env_spec(self.envs.scenario))
        self.spec.max_episode_steps = self.envs.max_episode_steps
        others = {"num_threads", "max_episode_steps"}  # which are no arguments of a single one
        self.spec.kwargs |= {name: kwargs[name] for name in kwargs.keys() - others}
        self.envs.spec = self.spec
        self.render_mode = self.envs.render_mode  # read by VecEnv.__init__
        super().__init__(
            num_envs, self.envs.single_observation_space, self.envs.single_action_space
        )
        self._actions = np.zeros((num_envs, *self.action_space.shape))  # type: ignore[misc]

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

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

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

    def end_rows(self, rows: Sequence[int], infos: list[dict[str, Any]]) -> Any:
        """Begin new episodes in some rows; the observations of all rows."""
        self.envs.engine.reset(np.asarray(rows))
        return self.envs.view(self.envs.engine.observe(), self.envs.look())

    def close(self) -> None:
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return [self.envs.frame(row) for row in range(self.num_envs)]

    def state(self) -> dict[str, Any]:
        """Everything the coming steps depend on, the generators included."""
        return self.envs.state()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state` bit for bit, whatever the number of threads."""
        self.envs.restore(state)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        raise AttributeError(
            f"cannot set {attr_name!r} on environments that share one batch of simulations; make "
            "them with the parameter changed, or use make_vec_env(..., vec_env='dummy')"
        )

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        raise AttributeError(
            f"cannot call {method_name!r} on one of the environments that share a batch of "
            "simulations; use make_vec_env(..., vec_env='dummy')"
        )

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))

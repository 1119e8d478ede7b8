"""The bridge between the two worlds: our environments as a Stable-Baselines3 ``VecEnv``.

:func:`make_vec_env` is what training, evaluation and notebooks call. For an environment of ours it
makes a :class:`GuardVecEnv`, which steps all environments in one call on one batch of simulations.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_guard.common.monitor import CostMonitor
from sb3_guard.common.sources import Source, find
from sb3_guard.spelling import did_you_mean

if TYPE_CHECKING:
    from sb3_guard.envs.scenario import Scenario

VEC_ENVS: dict[str, type[DummyVecEnv] | type[SubprocVecEnv]] = {
    "dummy": DummyVecEnv,
    "subproc": SubprocVecEnv,
}


class GuardVecEnv(VecEnv):
    """N environments of ours on one batch of simulations, for Stable-Baselines3.

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

    def film(self, row: int = 0) -> list[np.ndarray]:
        """The pictures of one row since the last call, ``envs.film_fps`` for each second."""
        return self.envs.film(row)

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


def make_vec_env(
    env_id: str | Path | Mapping[str, Any] | Scenario | Callable[..., gymnasium.Env] | Source,
    n_envs: int = 1,
    seed: int | None = None,
    *,
    vec_env: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    monitor_path: str | None = None,
    max_episode_steps: int | None = None,
    num_threads: int | None = None,
    render_mode: str | None = None,
    wrapper_class: Callable[[gymnasium.Env], gymnasium.Env] | None = None,
    monitor_kwargs: Mapping[str, Any] | None = None,
) -> VecEnv:
    """Make environments for Stable-Baselines3, with episode statistics that include the cost.

    :param env_id: an id of ours (the version may be left out), a scenario, its plain data or its
        YAML file, any id registered with Gymnasium, one of Safety-Gymnasium where that package is
        installed, a class or function that makes an environment, or what
        :func:`~sb3_guard.common.sources.find` returns
    :param n_envs: how many; 30 is a good number for training
    :param seed: the environments get seed, seed + 1, …
    :param vec_env: ``"native"`` (one batch of simulations; the default for our ids), ``"dummy"``
        (one by one; the default for others) or ``"subproc"`` (a process each)
    :param env_kwargs: parameters of the environment, such as ``{"hazards": {"num": 4}}``
    :param monitor_path: csv file for the episode statistics
    :param max_episode_steps: control steps after which an episode is cut, if not the id's own
    :param num_threads: threads of the native vector environment; results do not depend on it
    :param render_mode: as for :func:`gymnasium.make`
    :param wrapper_class: wraps each environment (not with ``"native"``)
    :param monitor_kwargs: further arguments of the monitor, such as ``{"cost_keys": ("a", "b")}``
    :return: the environments, wrapped in :class:`~sb3_guard.common.monitor.CostMonitor`
    :raises ValueError: unknown names or bad values, with what is allowed
    :raises gymnasium.error.DependencyNotInstalled: the package that has the environment is absent
    """
    if isinstance(n_envs, bool) or not isinstance(n_envs, (int, np.integer)) or n_envs < 1:
        raise ValueError(f"n_envs = {n_envs!r} must be an integer of at least 1")
    kwargs = dict(env_kwargs or {})
    if render_mode is not None:
        kwargs["render_mode"] = render_mode
    if max_episode_steps is not None:
        kwargs["max_episode_steps"] = max_episode_steps
    source = env_id if isinstance(env_id, Source) else find(env_id)
    batched = source.batch is not None and wrapper_class is None
    vec_env = vec_env or ("native" if batched else "dummy")
    venv: VecEnv
    if vec_env == "native":
        if source.batch is None:
            raise ValueError(
                f"{source.env_id or env_id!r} is not an sb3_guard environment, or has wrappers of "
                "its own: use vec_env 'dummy' or 'subproc'"
            )
        if wrapper_class is not None:
            raise ValueError(
                "wrapper_class, or env_wrapper of a run, needs vec_env 'dummy' or 'subproc': "
                "native envs share one batch"
            )
        venv = source.batch(n_envs, num_threads=num_threads, **kwargs)
    elif vec_env in VEC_ENVS:

        def make_one() -> gymnasium.Env:
            env = source.make(**kwargs)
            return env if wrapper_class is None else wrapper_class(env)

        venv = VEC_ENVS[vec_env]([make_one] * int(n_envs))
    else:
        raise ValueError(
            f"unknown vec_env {vec_env!r}: {did_you_mean(vec_env, ['native', *VEC_ENVS])}"
        )
    if seed is not None:
        venv.seed(seed)
    return CostMonitor(venv, monitor_path, **(monitor_kwargs or {}))

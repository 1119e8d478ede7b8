"""What training, evaluation and notebooks call to make environments for Stable-Baselines3.

For an environment of sb3_guard, :func:`make_vec_env` makes a
:class:`~sb3_guard.common.native.GuardVecEnv`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import gymnasium
from gymnasium.vector import VectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_guard.common.monitor import CostMonitor
from sb3_guard.common.sources import Source, find
from sb3_guard.fields import did_you_mean, fit
from sb3_guard.ids import UnknownPart
from sb3_guard.vector import BatchVecEnv, as_vec_env

if TYPE_CHECKING:
    from sb3_guard.envs.scenario import Scenario

    Wrapper = Callable[[gymnasium.Env], gymnasium.Env]
    EnvId = str | Path | Mapping[str, Any] | Scenario | Callable[..., gymnasium.Env] | Source


def make_vec_env(
    env_id: EnvId | VectorEnv | BatchVecEnv,
    n_envs: int = 1,
    seed: int | None = None,
    *,
    vec_env: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    monitor_path: str | None = None,
    max_episode_steps: int | None = None,
    num_threads: int | None = None,
    render_mode: str | None = None,
    wrapper_class: Wrapper | None = None,
    monitor_kwargs: Mapping[str, Any] | None = None,
) -> VecEnv:
    """Make environments for Stable-Baselines3, with episode statistics that include the cost.

    :param env_id: an id of sb3_guard (the version may be left out), a scenario, its plain data or
        its YAML file, any id registered with Gymnasium, one of Safety-Gymnasium where that package
        is installed, a class or function that makes an environment, what
        :func:`~sb3_guard.common.sources.find` returns; or a vector environment, such as
        ``gymnasium.make_vec(id, num_envs=8)``, which takes a seed and a monitor alone
    :param n_envs: how many; 30 is a good number for training
    :param seed: the environments get seed, seed + 1, …
    :param vec_env: ``"native"`` (one batch of simulations; the default for our ids), ``"dummy"``
        (one by one; the default for others), ``"subproc"`` (a process each) or ``"gymnasium"``
        (the vector environment that is registered for the id, else one by one)
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
    fit("n_envs", n_envs, int, 1, 10**6, "[]")
    given = {"render_mode": render_mode, "max_episode_steps": max_episode_steps}
    kwargs = {**(env_kwargs or {}), **{k: v for k, v in given.items() if v is not None}}
    rest = kwargs or vec_env or wrapper_class or num_threads
    if isinstance(env_id, VectorEnv | BatchVecEnv) and not rest and n_envs in (1, env_id.num_envs):
        venv = as_vec_env(env_id)
    else:
        source = env_id if isinstance(env_id, Source) else find(env_id)
        venv = _make(source, n_envs, vec_env, wrapper_class, num_threads, kwargs)
    if seed is not None:
        venv.seed(seed)
    return CostMonitor(venv, monitor_path, **(monitor_kwargs or {}))


def _make(
    source: Source,
    n_envs: int,
    vec_env: str | None,
    wrapper_class: Wrapper | None,
    num_threads: int | None,
    kwargs: Mapping[str, Any],
) -> VecEnv:
    vec_env = source.stepped(vec_env, wrapper_class is not None)
    if vec_env == "gymnasium" and source.spec is not None:
        return as_vec_env(gymnasium.make_vec(source.spec, num_envs=n_envs, **kwargs))
    if vec_env == "native":
        if source.batch is None:
            raise ValueError(
                f"{source.env_id!r} is not an sb3_guard environment, or has "
                "wrappers of its own: use vec_env 'dummy' or 'subproc'"
            )
        if wrapper_class is not None:
            raise ValueError(
                "wrapper_class, or env_wrapper of a run, needs vec_env 'dummy' or 'subproc': "
                "native envs share one batch"
            )
        return source.batch(n_envs, num_threads=num_threads, **kwargs)
    if vec_env not in ("dummy", "subproc"):
        allowed = ["native", "gymnasium", "dummy", "subproc"]
        raise ValueError(f"unknown vec_env {vec_env!r}: {did_you_mean(vec_env, allowed)}")

    def make_one() -> gymnasium.Env:
        env = source.make(**kwargs)
        if isinstance(env, VectorEnv):
            raise TypeError(
                f"what was to make single environments makes a {type(env).__name__}, a vector "
                "environment: hand that over itself, make_vec_env(gymnasium.make_vec(...))"
            )
        return env if wrapper_class is None else wrapper_class(env)

    if vec_env == "subproc":
        return _subprocesses(make_one, n_envs)
    return DummyVecEnv([make_one] * int(n_envs))


def _subprocesses(make: Callable[[], gymnasium.Env], n_envs: int) -> VecEnv:
    """
    A process each.

    :raises ValueError: an environment can't be made there, with what the process says of it
    """
    with TemporaryDirectory() as folder:

        def make_or_tell() -> gymnasium.Env:
            try:
                return make()
            except Exception as error:
                text = f"{type(error).__name__}: {error}"
                if isinstance(error, UnknownPart):
                    text += (
                        "; a process imports the main module anew, without what is under if "
                        "__name__ == '__main__': register parts above that, or in a module"
                    )
                with suppress(OSError):  # another one has told already
                    Path(folder, str(os.getpid())).write_text(text, encoding="utf-8")
                raise SystemExit(1) from error

        try:
            return SubprocVecEnv([make_or_tell] * int(n_envs))
        except (EOFError, ConnectionError):
            told = (path.read_text(encoding="utf-8") for path in Path(folder).iterdir())
            said = max(told, key=len, default="")
            if not said:
                raise
            raise ValueError(f"a process of vec_env='subproc' says {said}") from None

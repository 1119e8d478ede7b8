"""Anyone's vector environment, as Stable-Baselines3 steps it.

Constructors of algorithms, ``make_vec_env`` and evaluations take what Gymnasium calls a vector
environment and ask :func:`as_vec_env` for a ``VecEnv``. :class:`GymnasiumVecEnv` is the adapter of
those that are nothing simpler, :class:`TensorVecEnv` that of simulators that step torch tensors.
:func:`layers` walks through wrappers, :func:`normalizer_of` finds the one that normalises.
"""

import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_guard.errors import ContractError
from sb3_guard.fields import fit, is_number

#: ``cost(obs, actions, next_obs, infos)``, of N rows at once
BatchCost = Callable[[Any, Any, Any, Any], Any]
MODES = "NextStep", "SameStep", "Disabled"  # when rows that have ended are reset


def as_vec_env(env: Any) -> VecEnv:
    """Anyone's environment as a ``VecEnv``; one that is a ``VecEnv`` stays as it is.

    :param env: a vector environment of Gymnasium, or a single one, which becomes the only row.
        Ours become the native batch, and single ones that Gymnasium steps one by one SB3's
        ``DummyVecEnv``, so that they keep their methods, wrappers and states
    :raises ValueError: its autoreset mode is unknown
    """
    if isinstance(env, VecEnv):
        return env
    if not isinstance(env, VectorEnv):
        return DummyVecEnv([lambda: env])
    if type(env) is SyncVectorEnv:
        return DummyVecEnv([partial(list(env.envs).__getitem__, i) for i in range(env.num_envs)])
    entry_point = getattr(env, "vec_entry_point", None)
    return pkgutil.resolve_name(entry_point)(env) if entry_point else GymnasiumVecEnv(env)


def layers(env: Any) -> Iterator[Any]:
    """The wrappers of an environment from the outside in, and the environment itself last."""
    while isinstance(env, gym.Wrapper | VectorWrapper | VecEnvWrapper):
        yield env
        env = env.venv if isinstance(env, VecEnvWrapper) else env.env
    yield env


def normalizer_of(env: VecEnv | None) -> VecNormalize | None:
    """
    The one wrapper that normalises observations and rewards; None: there is none.

    :raises ContractError: there are two
    """
    normalizers = [layer for layer in layers(env) if isinstance(layer, VecNormalize)]
    if len(normalizers) > 1:
        raise ContractError(
            "env has two VecNormalize, and Stable-Baselines3 knows of the outer one alone: keep one"
        )
    return normalizers[0] if normalizers else None


def moments_of(env: VecEnv | None) -> dict[str, RunningMeanStd]:
    """What normalises observations, by their entries (``""``: they have none); empty: nothing."""
    normalizer = normalizer_of(env)
    if normalizer is None or not normalizer.norm_obs:
        return {}
    moments = normalizer.obs_rms
    return moments if isinstance(moments, dict) else {"": moments}


def lacks_statistics(model: Any, env: VecEnv | None) -> bool:
    """Whether an agent learnt from normalised observations, and ``env`` has no means of them."""
    now = isinstance(model, BaseAlgorithm) and bool(moments_of(model.get_env()))
    if not getattr(model, "learnt_normalized", now):
        return False
    moments = moments_of(env)
    # Those of a new VecNormalize are of no observation.
    return not moments or any(part.count < 1 for part in moments.values())


def own_statistics(env: VecEnv) -> str:
    """A fault where a wrapper of Gymnasium normalises by statistics of its own; empty: none."""
    rows = getattr(getattr(env.unwrapped, "envs", None), "unwrapped", None)
    for attribute, name in (("obs_rms", "Observation"), ("return_rms", "Reward")):
        with suppress(NotImplementedError):  # a vectorised environment need not tell
            has = env.has_attr(attribute)
            if isinstance(rows, AsyncVectorEnv):
                with answered(rows):
                    has = has or any(rows.call("has_wrapper_attr", attribute))
            if has:
                fault = "moves its statistics as it plays, and no file has them: use VecNormalize"
                return f"Normalize{name} {fault}"
    return ""


def step_limits(env: VecEnv) -> list[float]:
    """Steps of an episode at most, in each row; empty where not stated."""
    for name in ("_max_episode_steps", "max_episode_steps"):  # of TimeLimit, and of our batches
        with suppress(NotImplementedError):  # a vectorised environment need not tell
            limits = env.get_attr(name) if env.has_attr(name) else []
            if limits and all(is_number(limit) and limit > 0 for limit in limits):
                return limits
    return []


def each(function: Callable[..., Any], *obs: Any) -> Any:
    """Apply a function to observations, or to those of each entry of dictionaries."""
    if isinstance(obs[0], Mapping):
        return {key: each(function, *(o[key] for o in obs)) for key in obs[0]}
    return function(*obs)


def info_rows(infos: Mapping[str, Any], n: int) -> list[dict[str, Any]]:
    """What Gymnasium tells by arrays of N rows, as a dictionary for each row.

    :param infos: by name an array, a list or a dictionary of such; ``infos["_cost"]``, [N] bool,
        says which rows have a cost. Anything else is the same for all rows
    :param n: N
    """
    rows: list[dict[str, Any]] = [{} for _ in range(n)]
    for name, values in infos.items():
        if name[:1] == "_" and name[1:] in infos:
            continue
        if isinstance(values, Mapping):
            values = info_rows(values, n)
        elif not isinstance(values, list | tuple) and np.ndim(values):
            # numbers of Python's, or copies
            values = values.tolist() if np.ndim(values) == 1 else list(np.array(values))
        if not isinstance(values, list | tuple) or len(values) != n:
            values = [values] * n
        mask = infos.get(f"_{name}")
        for i in range(n) if mask is None else np.flatnonzero(mask).tolist():
            rows[i][name] = values[i]
    return rows


@contextmanager
def answered(env: VectorEnv) -> Iterator[None]:
    """Ask an environment; if a process of an ``AsyncVectorEnv`` dies, end the others."""
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:
        envs = env.unwrapped  # without a pipe to a process that has told of an error
        gone = isinstance(error, EOFError | ConnectionError | KeyboardInterrupt)
        if isinstance(envs, AsyncVectorEnv) and (gone or None in envs.parent_pipes):
            for process in envs.processes:
                process.terminate()
            envs.closed = True  # its close() would wait for answers that do not come
            if isinstance(error, Exception):
                why = "because of an error printed above, by a signal or for lack of memory"
                raise ConnectionError(f"a process of AsyncVectorEnv has died, {why}") from error
        raise


class BatchVecEnv(VecEnv):
    """N environments that step as one object, ``envs``, which has facts of all, but no rows."""

    def __init__(
        self, envs: Any, num_envs: int, observation_space: spaces.Space, action_space: spaces.Space
    ) -> None:
        self.envs = envs
        spec = getattr(envs, "spec", None)
        self.spec = spec if isinstance(spec, EnvSpec) else None  # EnvPool's is another
        super().__init__(num_envs, observation_space, action_space)
        self._actions: Any = None

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        owner = next((of for of in layers(self.envs) if hasattr(of, attr_name)), self.spec)
        return [getattr(owner, attr_name)] * len(list(self._get_indices(indices)))

    def env_method(self, method_name: str, *args: Any, **kwargs: Any) -> list[Any]:
        raise AttributeError(
            f"{method_name!r}: environments that step as one batch are not called or changed one "
            "by one; make them with a parameter, or use make_vec_env(..., vec_env='dummy')"
        )

    set_attr = env_method  # type: ignore[assignment]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))


class GymnasiumVecEnv(BatchVecEnv):
    """A vector environment of Gymnasium, in any autoreset mode, for Stable-Baselines3.

    Equals a ``DummyVecEnv`` of the same environments one by one: every row is a transition of the
    agent, and the last observation, truncation and info of an episode are in the step that ended
    it. Where the environment leaves a reset to the next step or to the caller, the rows that ended
    are reset at once, by ``reset(options={"reset_mask": rows})``, as Gymnasium's own environments
    and EnvPool's allow. An environment that begins other episodes, too, is refused when it does.

    :param env: the vector environment
    :param cost: ``cost(obs, actions, next_obs, infos)`` of N rows at once: the observations before
        a step, the actions, the observations after it (of episodes that it ended the last ones),
        and what ``step`` calls ``infos`` (of those what ``final_info`` has). It returns
        ``info["cost"]``, N numbers
    :raises TypeError: it is no vector environment
    :raises ValueError: its autoreset mode is unknown
    """

    def __init__(self, env: VectorEnv, cost: BatchCost | None = None) -> None:
        if not isinstance(env, VectorEnv):
            raise TypeError(f"{type(env).__name__} is no vector environment of Gymnasium")
        self.name = type(env.unwrapped).__name__
        mode = env.metadata.get("autoreset_mode")
        mode = fit(f"autoreset_mode of {self.name}", getattr(mode, "value", mode), choices=MODES)
        self.same_step, self.cost = mode == "SameStep", cost
        super().__init__(env, env.num_envs, env.single_observation_space, env.single_action_space)
        self._obs: Any = None

    def reset(self) -> Any:
        """Begin an episode in every row; the environment counts from the first row's seed.

        :raises ContractError: the space of a row is not that of a row
        """
        with answered(self.envs):
            obs, infos = self.envs.reset(seed=self._seeds[0], options=self._options[0] or None)

        def check(space: spaces.Space, values: Any) -> None:
            if np.shape(values) != (self.num_envs, *(space.shape or ())):
                raise ContractError(
                    f"{self.name} mixes up single and vector spaces: {self.num_envs} rows of "
                    f"single_observation_space, {space}, are not of shape {np.shape(values)}"
                )

        each(check, self.observation_space, obs)
        self._obs, self.reset_infos = each(np.array, obs), info_rows(infos, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return self._obs

    def step_wait(self) -> VecEnvStepReturn:
        """
        :raises ContractError: a row has ended without its last observation, its reset begins
            episodes of other rows, or ``cost`` does not return N numbers
        """
        with answered(self.envs):
            obs, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        dones, n = np.logical_or(terminated, truncated), self.num_envs
        rows, ended = info_rows(infos, n), np.flatnonzero(dones).tolist()
        # copies: the environment may write the next step into the same arrays
        after = each(np.array, obs)
        for i in ended if self.same_step else ():
            if "final_obs" not in rows[i]:
                raise ContractError(f"{self.name} has ended a row without infos['final_obs']")
            each(lambda o, last, i=i: o.__setitem__(i, last), after, rows[i].pop("final_obs"))
            # what else the row has is of its new episode
            rows[i] = rows[i].pop("final_info", rows[i])
        for info, cut in zip(rows, (dones & ~np.asarray(terminated)).tolist(), strict=True):
            info["TimeLimit.truncated"] = cut
        for i in ended:
            rows[i]["terminal_observation"] = each(lambda o, i=i: o[i], after)
        if self.cost is not None:
            if isinstance(last := infos.get("final_info"), Mapping):

                def told(of: Any, others: Any) -> np.ndarray:
                    rows = dones.reshape(-1, *[1] * (np.ndim(of) - 1))
                    return np.where(rows, of, others)

                infos = {**infos, **each(told, last, {**last, **infos})}
            costs = np.asarray(self.cost(self._obs, self._actions, after, infos))
            if costs.shape != (n,):
                raise ContractError(f"cost(...) returned shape {costs.shape}, expected ({n},)")
            for info, cost in zip(rows, costs.tolist(), strict=True):
                info["cost"] = cost
        self._obs = after
        if ended and self.same_step:
            self._obs = each(np.array, obs)
        elif ended:
            self._obs = self._begin(dones)
        return self._obs, np.array(rewards, np.float32), dones, rows

    def _begin(self, mask: np.ndarray) -> Any:
        """Begin new episodes in the rows of a mask, [N] bool; the observations of all rows."""

        def replaced(obs: np.ndarray, new: Any) -> np.ndarray:
            new = np.asarray(new)
            if len(new) == len(mask):  # of all rows; EnvPool has those of these alone
                if not np.array_equal(new[~mask], obs[~mask], equal_nan=True):
                    raise ContractError(
                        f"{self.name} begins other episodes, too, when rows that have ended are "
                        "reset by reset(options={'reset_mask': rows}): make it with "
                        "vectorization_mode='sync', or let it reset rows in the same step"
                    )
                new = new[mask]
            out = obs.copy()
            out[mask] = new
            return out

        with answered(self.envs):
            new, _ = self.envs.reset(options={"reset_mask": mask.copy()})
        return each(replaced, self._obs, new)

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.envs.render() or [None] * self.num_envs


class TensorVecEnv(BatchVecEnv):
    """A simulator that steps torch tensors of N rows, as mjlab and Isaac Lab do.

    ``step`` returns observations by group, reward, terminated, truncated and ``extras``, and begins
    new episodes in rows that have ended; with ``cfg.auto_reset=False``, ``reset(env_ids=rows)``
    does. All that Stable-Baselines3 needs of a step leaves the device in one copy, new episodes in
    another. Last observations are those of a step without resets, or ``extras["final_obs"]``, N
    rows by group; else the ones before them stand in. A row that is truncated and not terminated
    has timed out, and any row that has ended of which ``extras["time_outs"]``, [N], is true.

    :param env: the simulator, with ``num_envs``, ``device``, ``max_episode_length`` and the spaces
        of a row
    :param cost: the entry of ``extras`` that is the cost, [N], or a function ``cost(obs, actions,
        next_obs, extras)`` of tensors that returns it; it becomes ``info["cost"]``
    :param group: which observations the agent sees; None for ``"policy"``, ``"actor"`` or the first
    :param clip_actions: actions are within ± that; the simulator's have no bounds
    :raises TypeError: the environment steps no tensors, or a ``TimeLimit`` is around it
    :raises ValueError: there is no such group
    """

    def __init__(
        self,
        env: Any,
        cost: str | BatchCost = "cost",
        group: str | None = None,
        clip_actions: float = 5.0,
    ) -> None:
        self.simulator = inner = getattr(env, "unwrapped", env)  # wrappers pass nothing on
        name = type(inner).__name__
        if not hasattr(inner, "device"):
            raise TypeError(f"{name} has no device: algorithms take it as it is")
        if is_wrapped(env, TimeLimit):
            raise TypeError(
                f"a TimeLimit ends all rows at once: set the episode length of {name} itself, and "
                "register it without max_episode_steps"
            )
        self.auto_reset = getattr(getattr(inner, "cfg", None), "auto_reset", True)
        self.device, groups = inner.device, inner.single_observation_space.spaces
        first = next(key for key in ("policy", "actor", *groups) if key in groups)
        self.group = fit("group", group or first, choices=[*groups])
        self.cost = cost
        bound = np.full(inner.single_action_space.shape, clip_actions, np.float32)
        seen = spaces.Box(-np.inf, np.inf, groups[self.group].shape)
        super().__init__(env, inner.num_envs, seen, spaces.Box(-bound, bound))
        self.spec = EnvSpec(f"{name}-v0", max_episode_steps=inner.max_episode_length)
        self._tensor, self._obs = th.zeros(0), np.zeros(0)  # the same, on the device and here

    def reset(self) -> np.ndarray:
        obs, _ = self.envs.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        self._tensor = obs[self.group].clone()
        self._obs = self._tensor.float().cpu().numpy()
        return self._obs

    def step_wait(self) -> VecEnvStepReturn:
        """
        :raises ContractError: not five values, or cost, time-outs, last observations not of N rows
        """
        actions = th.as_tensor(self._actions, dtype=th.float32, device=self.device)
        step = self.envs.step(actions)
        if len(step) != 5:
            raise ContractError(
                f"step returned {len(step)} values, not five (observations, reward, terminated, "
                "truncated, extras): leave out the wrapper for another library"
            )
        obs, reward, terminated, truncated, extras = step
        before, now = self._tensor, obs[self.group].clone()
        final, last = extras.get("final_obs"), now
        if final is not None:
            last = final.get(self.group) if isinstance(final, Mapping) else final
        late = extras.get("time_outs", th.zeros_like(reward))
        for name, tensor, like in ("final_obs", last, now), ("time_outs", late, reward):
            if not (isinstance(tensor, th.Tensor) and tensor.shape == like.shape):
                raise ContractError(f"extras[{name!r}] has no tensor of shape {tuple(like.shape)}")
        ended = (terminated + truncated > 0).reshape(-1, *[1] * (now.ndim - 1))
        last = th.where(ended, last, now)
        seen = before, actions, last, extras
        cost = self.cost(*seen) if callable(self.cost) else extras.get(self.cost)
        if not (isinstance(cost, th.Tensor) and cost.shape == reward.shape):
            raise ContractError(
                f"cost={self.cost!r} is no tensor of {len(reward)} numbers; extras: {[*extras]}"
            )
        columns = th.stack([reward, terminated, truncated, late, cost], dim=1)
        together = th.cat([columns, last.flatten(1)], dim=1).float().cpu().numpy()
        rewards, died, cut, late, costs = together[:, :5].T
        shown = together[:, 5:].reshape(self._obs.shape)
        dones, cut = died + cut > 0.0, (late > 0.0) | (cut > died)
        infos: list[dict[str, Any]] = [{"cost": cost} for cost in costs.tolist()]
        rows, lost = np.flatnonzero(dones).tolist(), self.auto_reset and final is None
        for i in rows:
            infos[i]["TimeLimit.truncated"] = bool(cut[i])
            infos[i]["terminal_observation"] = (self._obs if lost else shown)[i]
        if rows and not lost:
            ids = th.as_tensor(rows, device=self.device)
            if not self.auto_reset:
                new = self.simulator.reset(env_ids=ids)[0][self.group]
                now = now.index_copy(0, ids, new[ids])
            shown = shown.copy()
            shown[rows] = now[ids].float().cpu().numpy()
        self._tensor, self._obs = now, shown
        return self._obs, rewards, dones, infos

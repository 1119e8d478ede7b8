"""Episode statistics with costs, for every vectorised environment."""

import copy
import inspect
import math
import os
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, is_vecenv_wrapped
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_guard.costs import EpisodeCost, EpisodeCosts, check_cost_keys, number, read_costs
from sb3_guard.errors import NumberError
from sb3_guard.vector import layers, step_limits


def total_cost(info: Mapping[str, Any], cost_keys: Sequence[str] = ("cost",)) -> float:
    """
    The cost of one step: ``info["cost"]``, else the sum of ``cost_keys``; absent keys count as 0.

    Whether an absent key is an error is for the algorithm to say; statistics only count.
    """
    cost = info.get("cost", 0.0 if "cost" in cost_keys else None)
    if cost is None:
        return sum(number(info.get(key, 0.0), f"info[{key!r}]") for key in cost_keys)
    return number(cost, "info['cost']")


# What a run continues with
KEPT = (
    "episode_returns", "episode_count", "total_cost", "total_steps", "physics_errors", "t_start",
)  # fmt: skip


class CostMonitor(VecMonitor):
    """
    Report return, length, time **and cost** of every episode, in its last info and in a csv.

    ``info["episode"]`` has ``r`` (return), ``l`` (steps), ``t`` (seconds since the start) and
    ``c``, the undiscounted sum of ``info["cost"]`` over the episode. When an environment has
    several costs, each of ``cost_keys`` is summed too, as ``c_<key>``. ``max`` and ``max_<key>``,
    which are not in the csv, are the highest costs of a step, 0 where none is above it. All of them
    are NaN of an episode whose last info has a true ``physics_error``: nobody knows what it would
    have cost. The csv is what :func:`stable_baselines3.common.monitor.load_results` reads.

    The sums of the episodes under way are part of :meth:`state`, so that a resumed training run
    reports the episodes in which it was stopped as if nothing had happened.

    :param venv: the environment to watch
    :param filename: csv to write, see :meth:`log_to`; None: no file
    :param info_keywords: other entries of the last step's info to report as they are
    :param cost_keys: the entries of info that are costs
    :raises ValueError: ``cost_keys`` is not a sequence of different names
    """

    def __init__(
        self,
        venv: VecEnv,
        filename: str | os.PathLike[str] | None = None,
        info_keywords: tuple[str, ...] = (),
        cost_keys: Sequence[str] = ("cost",),
    ):
        self.cost_keys = check_cost_keys(cost_keys)
        super().__init__(venv, info_keywords=tuple(info_keywords))
        self._columns = (
            [f"c_{key}" for key in self.cost_keys] if self.cost_keys != ("cost",) else []
        )
        #: cost and number of all steps so far, episodes under way included
        self.total_cost = 0.0
        self.total_steps = 0
        #: episodes that ended because the physics diverged
        self.physics_errors = 0
        self._clear()
        if filename is not None:
            self.log_to(filename)

    def __getstate__(self) -> dict[str, Any]:
        # of its class, and nothing that can be pickled
        return {key: value for key, value in vars(self).items() if key != "class_attributes"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.class_attributes = dict(inspect.getmembers(type(self)))
        vars(self).update(state)

    def _clear(self) -> None:
        self.episode_returns: np.ndarray = np.zeros(self.num_envs)
        # all costs, then each of the keys that are reported
        self.episodes = EpisodeCosts(self.num_envs, 1 + len(self._columns))

    def reset(self) -> VecEnvObs:
        """
        Begin new episodes everywhere; those under way are not reported.

        :raises NumberError: an observation is not finite
        """
        self._clear()
        obs = self.venv.reset()
        _require_finite("observation", obs)
        return obs

    def step_wait(self) -> VecEnvStepReturn:
        """
        Pass a step on; the infos of rows that ended an episode gain ``"episode"``.

        :raises NumberError: a reward, cost or observation is not finite
        """
        obs, rewards, dones, infos = self.venv.step_wait()
        _require_finite("reward", rewards)
        _require_finite("observation", obs)
        totals = [total_cost(info, self.cost_keys) for info in infos]
        costs = np.array(totals, np.float64)[:, None]
        if self._columns:
            keys, _ = read_costs(infos, self.cost_keys, True, self.episodes.lengths)
            costs = np.hstack([costs, keys])
        self.episode_returns += rewards
        self.total_cost += sum(totals)
        self.total_steps += self.num_envs
        infos = list(infos)
        for episode in self.episodes.step(costs, dones):
            self._report(episode, infos)
        return obs, rewards, dones, infos

    def _report(self, ended: EpisodeCost, infos: list[dict[str, Any]]) -> None:
        """Put an episode that has ended into its last info, and into the csv."""
        info = infos[ended.row]
        ended = ended.known(info)
        cost, *keys = ended.total.tolist()
        episode: dict[str, Any] = {
            "r": float(self.episode_returns[ended.row]),
            "l": ended.length,
            "t": round(time.time() - self.t_start, 6),
            "c": cost,
            **dict(zip(self._columns, keys, strict=True)),
            **{key: info[key] for key in self.info_keywords},
        }
        self.episode_count += 1
        self.physics_errors += bool(info.get("physics_error", False))
        self.episode_returns[ended.row] = 0.0
        if self.results_writer is not None:
            self.results_writer.write_row(episode)
        names = ["max", *(f"max_{name[2:]}" for name in self._columns)]
        episode |= zip(names, ended.highest.tolist(), strict=True)
        # Infos may be the environment's own objects: a copy gets the new entry.
        infos[ended.row] = {**info, "episode": episode}

    def log_to(self, filename: str | os.PathLike[str], append: bool = False) -> None:
        """
        Write episodes to a csv from now on.

        :param filename: the csv; its name ends in ``monitor.csv`` (else that is appended)
        :param append: write after the rows that it has; False: begin a new one
        """
        if self.results_writer is not None:
            self.results_writer.close()
        spec = getattr(self.venv, "spec", None)
        self.results_writer = ResultsWriter(
            os.fspath(filename),
            header={"t_start": self.t_start, "env_id": str(spec.id if spec else None)},
            extra_keys=("c", *self._columns, *self.info_keywords),
            override_existing=not append,
        )

    def state(self) -> dict[str, Any]:
        """What :meth:`restore` needs to continue counting."""
        counts = {name: copy.copy(getattr(self, name)) for name in KEPT}
        return {**counts, "episodes": copy.deepcopy(self.episodes)}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue counting from :meth:`state`; the csv is left as it is."""
        for name in KEPT:
            setattr(self, name, copy.copy(state[name]))
        self.episodes = copy.deepcopy(state["episodes"])


def _require_finite(name: str, values: VecEnvObs) -> None:
    """
    Refuse what networks would turn into NaN everywhere.

    :param values: shape (n_envs, ...), or a dictionary or tuple of such
    :raises NumberError: one is not finite; the message names the environments
    """
    if not isinstance(values, np.ndarray):
        entries = values.items() if isinstance(values, Mapping) else enumerate(values)
        for key, value in entries:
            _require_finite(f"{name} {key!r}", value)
    elif values.dtype.kind == "f" and not np.isfinite(values).all():
        bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
        rows = np.flatnonzero(bad).tolist()
        raise NumberError(
            f"the {name} of environment {rows[0]} is {values[rows[0]].tolist()}: it must be finite"
        )


def find_monitor(env: VecEnv) -> CostMonitor:
    """The cost monitor among an environment's wrappers."""
    for layer in layers(env):
        if isinstance(layer, CostMonitor):
            return layer
    raise ValueError("the environment is not wrapped in a CostMonitor")


def cost_keys_of(model: Any, env: VecEnv) -> tuple[str, ...]:
    """Entries of info that are costs: those of the model, else of the monitor, else ``cost``."""
    if hasattr(model, "cost_keys"):
        return tuple(model.cost_keys)
    return find_monitor(env).cost_keys if is_vecenv_wrapped(env, CostMonitor) else ("cost",)


def highest_costs(env: VecEnv, limit_on: str = "sum") -> dict[str, float]:
    """
    The highest cost of an episode that the environment states, by entry of info.

    :param limit_on: ``"sum"`` of an episode's costs, or ``"max"``, the highest one of a step
    :return: infinite without a limit of steps; empty where nothing is stated
    """
    if not env.has_attr("most_costs") or getattr(env.unwrapped, "cost", None):  # another cost
        return {}
    steps = 1.0 if limit_on == "max" else max(step_limits(env), default=math.inf)
    stated = env.get_attr("most_costs")
    highest = {key: max(most.get(key, 0.0) for most in stated) for key in stated[0]}
    return {key: cost and cost * steps for key, cost in highest.items()}

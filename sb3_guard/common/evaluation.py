"""How good and how safe a policy is: returns and costs of episodes, with their uncertainty."""

import copy
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

from sb3_guard.algorithms.common.constrained import BROKEN_OFF, Constrained
from sb3_guard.common.monitor import cost_keys_of, total_cost
from sb3_guard.costs import (
    EpisodeCost,
    EpisodeCosts,
    Estimate,
    beside,
    bounded_name,
    check_cost_keys,
    estimate,
    read_costs,
)
from sb3_guard.errors import NumberError
from sb3_guard.vector import (
    as_vec_env,
    lacks_statistics,
    layers,
    moments_of,
    normalizer_of,
    own_statistics,
    step_limits,
)

LONGEST = 20_000  # steps of an episode that nothing ends, after which it is given up


@dataclass(frozen=True)
class Evaluation:
    """
    What :func:`evaluate_policy` saw; E episodes in the order in which they ended.

    :param returns: undiscounted return of each episode, shape [E]
    :param costs: undiscounted cost of each episode, shape [E]: of the one cost key, or, where
        several are asked for, of all: the sum of ``info["cost"]``, else of the keys. NaN, as all
        its costs, of an episode that a physics error ended (``info["physics_error"]``)
    :param lengths: steps of each episode, shape [E]
    :param key_costs: episode cost of each of the cost keys asked for, shape [E, m]
    :param successes: ``info["is_success"]`` at the end of the episodes that report one
    :param unfinished: return, cost and steps of the episodes that ``max_steps`` cut short or that
        were given up, shape [K, 3]; they are in none of the others
    :param max_costs: highest cost of a step, by key, shape [E, m]; 0 where none is above it
    :param limit_on: what of the costs the model's limits bound, their ``"sum"`` or ``"max"``
    :param limits: the model's limits, one for each cost key; empty if it has none
    :param cost_keys: the m entries of info that were read as costs
    :param absent: those of them that no step had
    """

    returns: np.ndarray
    costs: np.ndarray
    lengths: np.ndarray
    key_costs: np.ndarray
    successes: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    unfinished: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    max_costs: np.ndarray = field(default_factory=lambda: np.zeros((0, 1)))
    limit_on: str = "sum"
    limits: tuple[float, ...] = ()
    cost_keys: tuple[str, ...] = ("cost",)
    absent: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.returns)

    def __str__(self) -> str:
        returns, costs = self.estimate(self.returns), self.estimate(self.costs)
        text = f"{len(self)} episodes: return {returns}, cost {costs}"
        if not self.limits:
            text += beside(costs.diverged)
        if self.limit_on == "sum" and len(self.cost_keys) == 1:
            return text + "".join(f", {costs.against(limit)}" for limit in self.limits)
        return text + "".join(
            f"; {name} {cost}" + ("" if limit is None else f", {cost.against(limit)}")
            for name, (cost, limit) in self.by_key().items()
        )

    def by_key(self) -> dict[str, tuple[Estimate, float | None]]:
        """Of each cost key what a limit bounds, and the limit: None if the model has none."""
        names = [bounded_name(key, self.limit_on) for key in self.cost_keys]
        limits = self.limits or (None,) * len(names)
        costs = map(estimate, self.limited.T)
        return dict(zip(names, zip(costs, limits, strict=True), strict=True))

    @property
    def limited(self) -> np.ndarray:
        """What the model's limits bound, of each episode and cost key, shape [E, m]."""
        return self.max_costs if self.limit_on == "max" else self.key_costs

    @property
    def worst(self) -> np.ndarray:
        """Highest cost of a step of any key, shape [E]."""
        return self.max_costs.max(axis=1)

    estimate = staticmethod(estimate)


def sync_normalization(env: VecEnv, eval_env: VecEnv) -> None:
    """
    Give an evaluation the statistics that training normalises with.

    SB3's ``sync_envs_normalization`` asks for the same wrappers around both, and an evaluation
    leaves out those that are ``training_only``.

    :param env: training environment; nothing happens if it is not normalised
    :param eval_env: evaluation environment
    :raises ValueError: the evaluation environment is not normalised, but training is
    """
    training, evaluation = normalizer_of(env), normalizer_of(eval_env)
    if training is None:
        return
    if evaluation is None:
        raise ValueError(
            "eval_env has no VecNormalize, and the training environment has: wrap both alike"
        )
    for name in ("obs_rms", "ret_rms"):
        if hasattr(training, name):
            setattr(evaluation, name, copy.deepcopy(getattr(training, name)))


def check_agent(model: Any, env: VecEnv) -> None:
    """
    Refuse what can't be played: every place that plays or exports an agent asks here.

    :param model: an algorithm or a policy
    :param env: environments to play it in
    :raises NumberError: a weight is not finite
    :raises ValueError: the statistics of observations do not fit, see :func:`check_normalizer`, or
        the actions are others
    """
    policy = getattr(model, "policy", model)
    if (own := getattr(policy, "action_space", env.action_space)) != env.action_space:
        raise ValueError(f"the agent's actions are {own}, those here {env.action_space}")
    if isinstance(policy, th.nn.Module):
        for name, weights in policy.named_parameters():  # a buffer may hold -inf, as masks do
            if not th.isfinite(weights).all():
                raise NumberError(
                    f"the agent can't act: its weights {name!r} are not finite; take an earlier "
                    "model, or train it again with a lower learning_rate"
                )
    normalizer = normalizer_of(env)
    if normalizer is not None:
        check_normalizer(normalizer, normalizer.venv.observation_space)


def check_normalizer(normalizer: Any, space: spaces.Space) -> None:
    """
    Refuse statistics of observations that belong to others, or are none.

    :param normalizer: what ``vecnormalize.pkl`` has
    :param space: of the observations
    :raises ValueError: it is no VecNormalize, or does not make finite numbers of an observation
    """
    if not isinstance(normalizer, VecNormalize):
        raise ValueError(
            f"observation statistics are a {type(normalizer).__name__}, no VecNormalize"
        )
    if not normalizer.norm_obs:
        return
    several = isinstance(space, spaces.Dict)
    entries: Any = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    zeros = {name: np.zeros(entry.shape or ()) for name, entry in entries.items()}
    try:
        with np.errstate(all="ignore"):
            seen: Any = normalizer.normalize_obs(zeros if several else zeros[""])
    except Exception as error:
        fault = f"{type(error).__name__}: {error}"
        raise ValueError(f"observation statistics do not fit {space}: {fault}") from None
    moments = moments_of(normalizer)
    for name, values in (seen if several else {"": seen}).items():
        part = moments.get(name, RunningMeanStd(shape=zeros[name].shape))
        shapes = {np.shape(numbers) for numbers in (values, part.mean, part.var)}
        sound = np.isfinite(values).all() and np.all(part.var > 0.0)
        if shapes != {zeros[name].shape} or not sound:
            of = f" of {name!r}" if name else ""
            raise ValueError(
                f"observation statistics do not fit {space}: means and variances{of} have another "
                "shape, or are not finite, or a variance is not above 0"
            )


def share_environment(one: VecEnv, other: VecEnv) -> bool:
    """Whether to reset one of two vectorised environments resets something of the other, too."""

    def parts(env: VecEnv) -> set[int]:
        inner = getattr(env.unwrapped, "envs", [])  # a list of single environments, or one batch
        inner = inner if isinstance(inner, list) else [inner]
        return {id(env.unwrapped), *(id(part.unwrapped) for part in inner)}

    return not parts(one).isdisjoint(parts(other))


@contextmanager
def _constant_normalization(model: PolicyPredictor, env: VecEnv) -> Iterator[None]:
    """Let an evaluation see normalised observations and leave their statistics as they are.

    :raises ValueError: the model's own environment normalises observations, and this one nothing
    """
    normalizer = normalizer_of(env)
    learnt_with = moments_of(model.get_env()) if isinstance(model, BaseAlgorithm) else None
    if normalizer is None and learnt_with:
        raise ValueError(
            "the model learnt from normalised observations, and env has no VecNormalize: "
            "evaluate it in model.get_env(), or wrap env in VecNormalize and call "
            "sync_normalization(model.get_env(), env)"
        )
    if lacks_statistics(model, env):
        warnings.warn(
            "the agent learnt from normalised observations, and env has no VecNormalize of theirs: "
            "unless it normalises them in another way, these are not its return and cost",
            stacklevel=4,
        )
    if fault := own_statistics(env):
        warnings.warn(fault, stacklevel=4)
    if normalizer is None:
        yield
        return
    training, normalizer.training = normalizer.training, False
    try:
        yield
    finally:
        normalizer.training = training


def limits_on(model: Any, keys: Sequence[str]) -> tuple[float, ...]:
    """The model's limits on these costs; empty if it has none."""
    if isinstance(model, Constrained) and model.constrained and keys == tuple(model.cost_keys):
        return tuple(model.final_cost_limits.tolist())
    return ()


def shares(n_episodes: int, n_envs: int) -> np.ndarray:
    """How many of the episodes each environment plays, shape [n_envs]."""
    return np.array([(n_episodes + i) // n_envs for i in range(n_envs)])


def evaluate_policy(
    model: PolicyPredictor,
    env: gym.Env | gym.vector.VectorEnv | VecEnv,
    n_eval_episodes: int = 10,
    deterministic: bool = True,
    *,
    seed: int | None = None,
    cost_keys: Sequence[str] | None = None,
    max_steps: int | None = None,
    on_step: Callable[[], Any] | None = None,
    on_episode: Callable[[float, float, int], Any] | None = None,
) -> Evaluation:
    """
    Play whole episodes and report return and cost of each.

    Each row of a vectorised environment plays its own share of the episodes, fixed beforehand. To
    take the first ones that end, from any row, would favour short episodes.

    Returns and lengths are those of a monitor wrapper where there is one, else sums of the rewards
    before ``VecNormalize``. Costs are read as the model reads them in training,
    with its ``missing_cost``; if it has none, as a policy or PPO, an absent cost counts as 0.

    A policy that corrects its actions by the cost of the last step has a true attribute
    ``acts_on_cost`` and is given these costs, shape [n_envs, m], zeros at the start of an
    episode, as ``predict(..., state=(costs,))``.

    A model's own training environment will do: if ``learn`` is called again, it begins new
    episodes. During a rollout, as in a callback, it is refused. The statistics of
    ``VecNormalize`` stay as they are.

    :param model: anything with ``predict``: an algorithm or a policy
    :param env: a single or a vectorised environment; it is reset first
    :param n_eval_episodes: number of episodes. One that has not ended after 20,000 steps, or the
        environment's own limit if that is higher, is given up with a warning, as are those that
        were to follow it
    :param deterministic: take the most likely action instead of sampling
    :param seed: seed of the episodes and of sampled actions. With the same seed, the same policy
        has the same evaluation, and training is not affected; None: continue from where the
        generators are
    :param cost_keys: entries of info that are costs; None: those of ``model``, else those of the
        environment's :class:`~sb3_guard.common.monitor.CostMonitor`, else ``"cost"``
    :param max_steps: stop after this many steps of the (vectorised) environment; episodes that
        have not ended are left out
    :param on_step: called after each step, e.g. to render
    :param on_episode: called with return, cost and length of each counted episode as it ends
    :raises ValueError: ``n_eval_episodes`` is below 1, a cost is not finite or missing where it
        must not be, ``env`` is the environment of a training that is under way, or the model's own
        environment normalises observations and ``env`` nothing
    """
    if n_eval_episodes < 1:
        raise ValueError(f"n_eval_episodes must be at least 1, not {n_eval_episodes}")
    env = as_vec_env(env)
    keys = check_cost_keys(cost_keys_of(model, env) if cost_keys is None else cost_keys)
    check_agent(model, env)
    zero_if_missing = getattr(model, "missing_cost", "zero") == "zero"
    policy = getattr(model, "policy", model)
    acts_on_cost = getattr(policy, "acts_on_cost", False)
    if isinstance(model, Constrained) and model.env and share_environment(model.env, env):
        if model.collecting:
            raise ValueError(BROKEN_OFF)
        model.set_env(model.env)  # so the next learn begins new episodes

    # steps after which an episode is given up
    longest = int(max([LONGEST, *step_limits(env)])) if max_steps is None else None
    tally = _Tally(env, n_eval_episodes, keys, on_episode, longest)
    # sampled actions are drawn from the seed, and the generators that draw them stay as they were
    device = th.device(getattr(model, "device", "cpu"))
    forked = th.random.fork_rng([device] if device.type == "cuda" else [], seed is not None)
    with _constant_normalization(model, env), forked:
        if seed is not None:
            th.manual_seed(seed)
            env.seed(seed)
        observations = env.reset()
        starts = np.ones(env.num_envs, dtype=bool)
        state: tuple[np.ndarray, ...] | None = None
        last_costs = np.zeros((env.num_envs, len(keys)))
        steps = 0
        while tally.left.any() and (max_steps is None or steps < max_steps):
            actions, state = model.predict(
                observations,  # type: ignore[arg-type]
                state=(last_costs,) if acts_on_cost else state,
                episode_start=starts,
                deterministic=deterministic,
            )
            observations, rewards, starts, infos = env.step(actions)
            steps += 1
            last_costs, _ = read_costs(infos, keys, zero_if_missing, tally.costs.lengths)
            if on_step is not None:
                on_step()
            tally.step(rewards, last_costs, starts, infos)
            last_costs[np.flatnonzero(starts)] = 0.0
    return tally.evaluation(getattr(model, "limit_on", "sum"), limits_on(model, keys))


class _Tally:
    """
    Return, costs and steps of the episodes of vectorised environments, under way and ended.

    :param left: episodes that each environment has still to play, shape [n]
    :param longest: steps after which an episode is given up; None: never
    """

    def __init__(
        self,
        env: VecEnv,
        n_eval_episodes: int,
        keys: tuple[str, ...],
        on_episode: Callable[[float, float, int], Any] | None,
        longest: int | None,
    ) -> None:
        n, self.env = env.num_envs, env
        self.keys, self.on_episode, self.longest = keys, on_episode, longest
        self.monitored = env.env_is_wrapped(Monitor)[0]
        normalizer = normalizer_of(env)
        #: VecNormalize where it changes rewards; returns that a monitor outside of it reports are
        #: of changed ones
        self.changing = normalizer if normalizer and normalizer.norm_reward else None
        kinds = (layer for layer in layers(env) if isinstance(layer, VecMonitor | VecNormalize))
        self.reported = not (self.changing and isinstance(next(kinds), VecMonitor))
        self.asked = n_eval_episodes
        self.left = shares(n_eval_episodes, n)
        self.returns = np.zeros(n)
        self.costs = EpisodeCosts(n, len(keys) + 1)  # each of the keys, then all costs
        self.ended: list[tuple[float, int, EpisodeCost]] = []  # return, steps, costs
        self.unfinished: list[np.ndarray] = []
        self.successes: list[bool] = []
        self.absent = {*keys}  # costs that no step has reported

    def step(
        self,
        rewards: np.ndarray,
        costs: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Add a step of every environment, and the episodes that it ends; give up endless ones."""
        self.returns += rewards if self.changing is None else self.changing.get_original_reward()
        if self.absent:
            self.absent.difference_update(*infos)
        if len(self.keys) == 1:
            totals = costs
        else:
            totals = np.array([[total_cost(info, self.keys)] for info in infos])
        over = np.array(dones, dtype=bool)
        for i in np.flatnonzero(dones).tolist():
            over[i] = self._is_over(i, infos[i])
        for cost in self.costs.step(np.hstack([costs, totals]), over):
            self._end(cost, infos[cost.row])
        if self.longest is not None:
            rows = (self.left > 0) & (self.costs.lengths >= self.longest)
            if rows.any():
                self.unfinished.append(self._under_way(rows))
                self.left[rows] = 0

    def _under_way(self, rows: np.ndarray) -> np.ndarray:
        """Return, cost and steps so far of some rows, shape [K, 3]."""
        lengths = self.costs.lengths
        return np.stack([self.returns, self.costs.totals[:, -1], lengths], axis=1)[rows]

    def _is_over(self, row: int, info: dict[str, Any]) -> bool:
        """Whether an episode that a step ended has come to its true end.

        Where a wrapper outside Monitor has ended it, it goes on if Monitor has not been reset, as
        after a life lost in Atari.
        """
        reset = not self.monitored or "episode" in info
        return reset or not self.env.get_attr("rewards", [row])[0]

    def _end(self, cost: EpisodeCost, info: dict[str, Any]) -> None:
        """Count an episode that is over, if one is still to be played."""
        i = cost.row
        if self.left[i]:
            self.left[i] -= 1
            earned, steps = float(self.returns[i]), cost.length
            episode = info.get("episode") if self.reported else None
            # Other steps than Monitor's are of several episodes, some ended by a wrapper outside.
            if episode is not None and (self.monitored or episode["l"] == steps):
                earned, steps = float(episode["r"]), int(episode["l"])
            cost = cost.known(info)
            self.ended.append((earned, steps, cost))
            if "is_success" in info:
                self.successes.append(bool(info["is_success"]))
            if self.on_episode is not None:
                self.on_episode(earned, float(cost.total[-1]), steps)
        self.returns[i] = 0.0

    def evaluation(self, limit_on: str, limits: tuple[float, ...]) -> Evaluation:
        """What was seen."""
        if self.keys != ("cost",) and self.absent == {*self.keys} and not limits:
            warnings.warn(
                f"no step reported a cost as info[{self.keys[0]!r}], so costs are 0: cost_keys, or "
                "the monitor's, name the entries of info that are costs",
                stacklevel=3,
            )
        absent = self.asked - len(self.ended)
        if absent and self.longest is not None:
            warnings.warn(
                f"{absent} of {self.asked} episodes are left out: one had not ended after "
                f"{self.longest:,} steps; limit their length, with gymnasium.wrappers.TimeLimit("
                "env, 1000) or, in commands, --env-kwargs max_episode_steps:1000",
                stacklevel=3,
            )
        shape = len(self.ended), len(self.keys)
        left = self._under_way((self.left > 0) & (self.costs.lengths > 0))
        return Evaluation(
            returns=np.array([earned for earned, _, _ in self.ended]),
            costs=np.array([cost.total[-1] for _, _, cost in self.ended]),
            lengths=np.array([steps for _, steps, _ in self.ended], dtype=np.int64),
            key_costs=np.array([cost.total[:-1] for _, _, cost in self.ended]).reshape(shape),
            successes=np.array(self.successes, dtype=bool),
            unfinished=np.concatenate([*self.unfinished, left]),
            max_costs=np.array([cost.highest[:-1] for _, _, cost in self.ended]).reshape(shape),
            limit_on=limit_on,
            limits=limits,
            cost_keys=self.keys,
            absent=tuple(key for key in self.keys if key in self.absent),
        )

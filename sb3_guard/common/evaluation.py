"""How good and how safe a policy is: returns and costs of episodes, with their uncertainty."""

import copy
import math
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
from sb3_guard.costs import EpisodeCost, EpisodeCosts, check_cost_keys, read_costs
from sb3_guard.errors import NumberError
from sb3_guard.judging import Limits, Mean
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
    What :func:`evaluate_policy` saw; E episodes in the order of their seeds.

    :param returns: undiscounted return of each episode, shape [E]
    :param costs: undiscounted cost of each episode, shape [E]: of the one cost key, or, where
        several are asked for, of all: the sum of ``info["cost"]``, else of the keys. NaN, as all
        its costs, of an episode that a physics error ended (``info["physics_error"]``)
    :param lengths: steps of each episode, shape [E]
    :param key_costs: episode cost of each of the cost keys asked for, shape [E, m]
    :param max_costs: highest cost of a step, by key, shape [E, m]; 0 where none is above it
    :param limits: the model's limits on these costs, and the cost keys
    :param successes: ``info["is_success"]`` at the end of the episodes that report one
    :param unfinished: return, cost and steps of the episodes that ``max_steps`` cut short or that
        were given up, shape [K, 3]; they are in none of the others
    :param absent: cost keys that no step had
    :param copies: whether environments that were seeded differently played the same episode
    """

    returns: np.ndarray
    costs: np.ndarray
    lengths: np.ndarray
    key_costs: np.ndarray
    max_costs: np.ndarray
    limits: Limits
    successes: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    unfinished: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    absent: tuple[str, ...] = ()
    copies: bool = False

    def __len__(self) -> int:
        return len(self.returns)

    def __str__(self) -> str:
        return f"{len(self)} episodes: {self.words}"

    @property
    def words(self) -> str:
        """Mean return and costs, ± their standard errors, and the limits."""
        words = [f"return {Mean.of(self.returns)}"]
        if self.limits.on == "max" or len(self.limits.keys) > 1:
            words.append(f"total cost {Mean.of(self.costs)}")
        limited = self.limits.described(self.limited).items()
        return ", ".join([*words, *(f"{name} {cost}" for name, cost in limited)])

    @property
    def cost_keys(self) -> tuple[str, ...]:
        """The m entries of info that were read as costs."""
        return self.limits.keys

    @property
    def limited(self) -> np.ndarray:
        """The part of each episode's costs that the model's limits bound, shape [E, m]."""
        return self.max_costs if self.limits.on == "max" else self.key_costs

    @property
    def worst(self) -> np.ndarray:
        """Highest cost of a step of any key, shape [E]."""
        return self.max_costs.max(axis=1)

    @property
    def whole(self) -> bool:
        """Whether every episode that was asked for has come to its end, and its cost is known."""
        return len(self) > 1 and not len(self.unfinished) and not np.isnan(self.limited).any()


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
        sound = np.isfinite(values).all() and np.isfinite(part.mean).all()  # values are clipped
        sound = sound and np.all((part.var > 0.0) & (part.var < np.inf))
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

    The rows of a vectorised environment begin together, and when all have played an episode, again.
    To take the first episodes that end, from any row, would favour short ones. With a seed, the
    i-th episode begins with ``seed + i``.

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
    with _constant_normalization(model, env), _constant_mode(policy), forked:
        if seed is not None:
            th.manual_seed(seed)
        steps_left = math.inf if max_steps is None else max_steps
        while tally.asked and steps_left:
            if seed is not None:
                env.seed(seed + len(tally.ended))
            observations = env.reset()
            tally.begin(observations)
            starts = np.ones(env.num_envs, dtype=bool)
            state: tuple[np.ndarray, ...] | None = None
            last_costs = np.zeros((env.num_envs, len(keys)))
            while tally.playing.any() and steps_left:
                actions, state = model.predict(
                    observations,  # type: ignore[arg-type]
                    state=(last_costs,) if acts_on_cost else state,
                    episode_start=starts,
                    deterministic=deterministic,
                )
                observations, rewards, starts, infos = env.step(actions)
                steps_left -= 1
                last_costs, _ = read_costs(infos, keys, zero_if_missing, tally.costs.lengths)
                if on_step is not None:
                    on_step()
                tally.step(rewards, last_costs, starts, infos)
                last_costs[np.flatnonzero(starts)] = 0.0
            tally.end()
    return tally.evaluation(Limits.of(model, keys))


@contextmanager
def _constant_mode(policy: Any) -> Iterator[None]:
    """Set a policy to evaluation once; its ``predict`` would walk over its modules in each step."""
    if not isinstance(policy, th.nn.Module) or not hasattr(policy, "set_training_mode"):
        yield
        return
    policy.set_training_mode(False)  # type: ignore[operator]
    object.__setattr__(policy, "set_training_mode", lambda mode: None)
    try:
        yield
    finally:
        object.__delattr__(policy, "set_training_mode")


def _prints(observations: Any) -> list[int]:
    """A number for each row of observations, the same for the same observation."""
    parts = observations.values() if isinstance(observations, dict) else [observations]
    rows = zip(*(np.ascontiguousarray(part) for part in parts), strict=True)
    return [hash(tuple(part.tobytes() for part in row)) for row in rows]


class _Tally:
    """
    Return, costs and steps of the episodes of vectorised environments, under way and ended.

    :param asked: episodes that are still to be begun
    :param longest: steps after which an episode is given up, and those that were to follow; None:
        never
    """

    def __init__(
        self,
        env: VecEnv,
        n_eval_episodes: int,
        keys: tuple[str, ...],
        on_episode: Callable[[float, float, int], Any] | None,
        longest: int | None,
    ) -> None:
        self.env = env
        self.keys, self.on_episode, self.longest = keys, on_episode, longest
        self.monitored = env.env_is_wrapped(Monitor)[0]
        normalizer = normalizer_of(env)
        #: VecNormalize where it changes rewards; returns that a monitor outside of it reports are
        #: of changed ones
        self.changing = normalizer if normalizer and normalizer.norm_reward else None
        kinds = (layer for layer in layers(env) if isinstance(layer, VecMonitor | VecNormalize))
        self.reported = not (self.changing and isinstance(next(kinds), VecMonitor))
        self.asked = self.wanted = n_eval_episodes
        #: return, steps and costs of the episodes that have ended
        self.ended: list[tuple[float, int, EpisodeCost]] = []
        self.unfinished: list[np.ndarray] = []
        self.successes: list[bool] = []
        self.absent = {*keys}  # costs that no step has reported
        self.different: set[tuple[Any, ...]] = set()  # episodes, as far as they differ
        self.copies = True
        #: whether all environments began alike whenever they began together, and how they began
        self.alike, self.starts = env.num_envs > 1, set[int]()

    def begin(self, observations: Any) -> None:
        """An episode begins in every environment; those that are asked for count."""
        n = self.env.num_envs
        self.playing = np.arange(n) < self.asked
        self.asked = max(self.asked - n, 0)
        self.returns = np.zeros(n)
        self.costs = EpisodeCosts(n, len(self.keys) + 1)  # each of the keys, then all costs
        self.first, self.over = _prints(observations), list[tuple[float, int, EpisodeCost]]()
        if n > 1:
            self.different = set()
        self.alike &= len({*self.first}) == 1
        self.starts.add(self.first[0])

    def end(self) -> None:
        """All episodes that began together have ended, or steps are used up."""
        self.unfinished.append(self._under_way(self.playing & (self.costs.lengths > 0)))
        self.over.sort(key=lambda episode: episode[2].row)
        self.ended += self.over
        for earned, steps, cost in self.over:
            self.different.add((self.first[cost.row], earned, steps, *cost.total.tolist()))
        self.copies &= len(self.different) == 1

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
            endless = self.playing & (self.costs.lengths >= self.longest)
            if endless.any():
                self.unfinished.append(self._under_way(endless))
                self.playing[endless] = False
                self.asked = 0

    def _under_way(self, rows: np.ndarray) -> np.ndarray:
        """Return, cost and steps so far of some rows, shape [K, 3]."""
        lengths = self.costs.lengths
        return np.stack([self.returns, self.costs.totals[:, -1], lengths], axis=1)[rows]

    def _is_over(self, row: int, info: dict[str, Any]) -> bool:
        """Whether an episode that a step ended has come to its true end.

        Where a wrapper outside Monitor has ended it, it goes on if Monitor has not been reset, as
        after a life lost in Atari: else its rewards are those of steps that the reset took, if any.
        """
        reset = not self.monitored or "episode" in info
        return reset or len(self.env.get_attr("rewards", [row])[0]) <= self.costs.lengths[row]

    def _end(self, cost: EpisodeCost, info: dict[str, Any]) -> None:
        """Count an episode that is over, if one is still to be played."""
        i = cost.row
        if self.playing[i]:
            self.playing[i] = False
            earned, steps = float(self.returns[i]), cost.length
            episode = info.get("episode") if self.reported else None
            # Other steps than Monitor's are of several episodes, some ended by a wrapper outside.
            if episode is not None and (self.monitored or episode["l"] == steps):
                earned, steps = float(episode["r"]), int(episode["l"])
            cost = cost.known(info)
            self.over.append((earned, steps, cost))
            if "is_success" in info:
                self.successes.append(bool(info["is_success"]))
            if self.on_episode is not None:
                self.on_episode(earned, float(cost.total[-1]), steps)
        self.returns[i] = 0.0

    def evaluation(self, limits: Limits) -> Evaluation:
        """What was seen."""
        if self.keys != ("cost",) and self.absent == {*self.keys} and not limits:
            warnings.warn(
                f"no step reported a cost as info[{self.keys[0]!r}], so costs are 0: cost_keys, or "
                "the monitor's, name the entries of info that are costs",
                stacklevel=3,
            )
        absent = self.wanted - len(self.ended)
        if absent and self.longest is not None:
            warnings.warn(
                f"{absent} of {self.wanted} episodes are left out: one had not ended after "
                f"{self.longest:,} steps; limit their length, with gymnasium.wrappers.TimeLimit("
                "env, 1000) or, in commands, --env-kwargs max_episode_steps:1000",
                stacklevel=3,
            )
        shape = len(self.ended), len(self.keys)
        return Evaluation(
            returns=np.array([earned for earned, _, _ in self.ended]),
            costs=np.array([cost.total[-1] for _, _, cost in self.ended]),
            lengths=np.array([steps for _, steps, _ in self.ended], dtype=np.int64),
            key_costs=np.array([cost.total[:-1] for _, _, cost in self.ended]).reshape(shape),
            max_costs=np.array([cost.highest[:-1] for _, _, cost in self.ended]).reshape(shape),
            limits=limits,
            successes=np.array(self.successes, dtype=bool),
            unfinished=np.concatenate(self.unfinished),
            absent=tuple(key for key in self.keys if key in self.absent),
            # With sampled actions copies differ, but for their first observations.
            copies=len(self.ended) > 1 and (self.copies or (self.alike and len(self.starts) > 1)),
        )

"""Certificates: an agent's mean episode cost is within its limit, shown by fresh episodes."""

import hashlib
import json
import math
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from importlib.metadata import version
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import torch as th
from scipy import stats
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.algorithms.common.constrained import Constrained
from sb3_guard.common.evaluation import Evaluation, evaluate_policy
from sb3_guard.common.monitor import cost_keys_of
from sb3_guard.costs import bounded_name, check_cost_keys, check_per_cost
from sb3_guard.fields import fit
from sb3_guard.vector import as_vec_env, lacks_statistics, moments_of, own_statistics

#: The looks at the episodes, as shares of all. Only the last one can certify: costs that are rare
#: and high are often absent from fewer episodes, which then all look safe.
LOOKS = 0.25, 0.5, 1.0
UPPER = 0.8  # share of the error for the upper bound; the looks at the lower one share the rest
LEAST, MOST = 100, 400  # episodes of a certificate
ERROR = 0.05  # probability that an agent whose mean cost is above the limit is certified
PACKAGES = "sb3-guard", "stable-baselines3", "torch", "mujoco"

Verdict = Literal["certified", "exceeded", "undecided"]


def mean_bounds(values: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """
    One-sided confidence bounds of a mean, each of which fails with probability ``error``.

    Student's bounds are too low for costs, most of which are small and few large: a sample without
    the large ones has a small mean and a small deviation, too. Hall's cubic transformation of the
    t statistic removes the influence of the skewness γ (Hall, 1992, On the removal of skewness by
    transformation, J. R. Stat. Soc. B 54)::

        W(t) = (3/γ) (cbrt(1 + γ (t/√n - γ/(6n))) - 1),    bound = mean - s W(±t)

    :param values: n independent values along the last axis, shape [..., n]
    :param error: probability, below 0.5
    :return: lower and upper bound, each of shape [...]
    """
    n = values.shape[-1]
    mean, deviation = values.mean(axis=-1), values.std(axis=-1, ddof=1)
    scale = np.where(deviation > 0.0, deviation, 1.0)
    skewness = (((values - mean[..., None]) / scale[..., None]) ** 3).mean(axis=-1)
    skewness = np.where(np.abs(skewness) < 1e-6, 1e-6, skewness)

    def bound(t: float) -> np.ndarray:
        root = np.cbrt(1.0 + skewness * (t / math.sqrt(n) - skewness / (6 * n)))
        return mean - deviation * 3.0 / skewness * (root - 1.0)

    t = float(stats.t.isf(error, n - 1))
    return bound(t), bound(-t)


@dataclass(frozen=True)
class CostBound:
    """
    What the episodes say of one cost and its limit.

    :param limit: d
    :param mean: mean episode cost
    :param lower: lower confidence bound of the agent's true mean
    :param upper: upper confidence bound of it
    :param share_above: share of the episodes that cost more than d
    :param deviation: standard deviation of an episode's cost
    """

    limit: float
    mean: float
    lower: float
    upper: float
    share_above: float
    deviation: float

    @classmethod
    def of(cls, costs: np.ndarray, limit: float, error: float) -> "CostBound":
        """The bounds from one cost an episode, shape [E]; the lower one is one of three looks."""
        lower, _ = mean_bounds(costs, error * (1.0 - UPPER) / len(LOOKS))
        _, upper = mean_bounds(costs, error * UPPER)
        numbers = limit, costs.mean(), lower, upper, np.mean(costs > limit), costs.std(ddof=1)
        return cls(*map(float, numbers))

    @property
    def excess(self) -> float:
        """How far the upper bound lies above the limit."""
        return self.upper - self.limit

    @property
    def verdict(self) -> Verdict:
        if self.upper <= self.limit:
            return "certified"
        return "exceeded" if self.lower > self.limit else "undecided"

    def __str__(self) -> str:
        words = {
            "certified": f"upper bound {self.upper:.4g}",
            "exceeded": f"lower bound {self.lower:.4g}",
            "undecided": f"bounds {self.lower:.4g} and {self.upper:.4g}",
        }[self.verdict]
        return f"{self.mean:.4g}, {words}, limit {self.limit:g}"


@dataclass(frozen=True)
class Certificate:
    """
    Whether an agent's mean episode cost is within its limits, and how that is known.

    A *certified* agent's true mean costs, in this environment and with this kind of actions, are
    within their limits, with a confidence of about ``1 - error``, all looks and tries counted.
    Single episodes may cost more, and events that no episode saw are not bounded: 400 episodes see
    none of those in one of 130 episodes with a probability of 5 %.

    :param costs: the bounds of each cost
    :param episodes: number of fresh episodes, without those that a physics error ended
    :param physics_errors: number of these; the costs of such an episode are not known, so that an
        agent that has any is not certified
    :param mean_return: their mean return
    :param deterministic: whether the most likely actions were taken, or sampled ones
    :param seed: of the episodes and of sampled actions
    :param error: probability of a certificate for an agent that exceeds a limit
    :param tries: number of agents that shared this error; this is one of them
    :param env: id of the environment, and its arguments
    :param agent: SHA-256 of the policy's weights and of the normaliser's statistics
    :param versions: of the packages
    """

    costs: dict[str, CostBound]
    episodes: int
    physics_errors: int
    mean_return: float
    deterministic: bool
    seed: int
    error: float
    tries: int
    env: dict[str, Any]
    agent: str
    versions: dict[str, str]

    @property
    def verdict(self) -> Verdict:
        """*certified* if every cost is, *exceeded* if any limit is."""
        verdicts = {cost.verdict for cost in self.costs.values()}
        if "exceeded" in verdicts:
            return "exceeded"
        safe = verdicts == {"certified"} and self.physics_errors == 0
        return "certified" if safe else "undecided"

    @property
    def nearest(self) -> CostBound:
        """The bounds of the cost whose upper bound lies highest above its limit."""
        return max(self.costs.values(), key=lambda cost: cost.excess)

    @property
    def to_decide(self) -> int | None:
        """How many episodes would probably decide, if the mean stays; None if none would."""
        costs = [cost for cost in self.costs.values() if cost.verdict == "undecided"]
        if not costs or self.physics_errors or any(cost.mean == cost.limit for cost in costs):
            return None
        t = stats.norm.isf(UPPER * self.error / self.tries / len(self.costs))
        widths = (t * cost.deviation / abs(cost.mean - cost.limit) for cost in costs)
        return math.ceil(max(max(widths) ** 2, 1.1 * self.episodes))

    def __str__(self) -> str:
        actions = "most likely" if self.deterministic else "sampled"
        tail = (
            f"return {self.mean_return:.4g}, {actions} actions, confidence about "
            f"{1 - self.error:.0%}"
        )
        if self.verdict == "undecided" and self.to_decide is not None:
            tail += f"; about {self.to_decide:,} episodes would decide"
        if self.physics_errors:
            tail += f"; {self.physics_errors} more ended in a physics error"
        above = f"of {self.episodes} fresh episodes cost more than the limit"
        lines = [
            f"mean {key} {cost}; {round(cost.share_above * self.episodes)} {above}"
            for key, cost in self.costs.items()
        ]
        if len(lines) == 1:
            return f"{self.verdict}: {lines[0]}; {tail}"
        return "\n  ".join([f"{self.verdict}: {tail}", *lines])

    def summary(self) -> dict[str, Any]:
        """Return, actions, and of each cost its mean, bound, limit and share above it."""
        costs = {
            key: {
                "mean": cost.mean,
                "upper": cost.upper,
                "limit": cost.limit,
                "share_above": cost.share_above,
            }
            for key, cost in self.costs.items()
        }
        played = {"episodes": self.episodes, "deterministic": self.deterministic}
        return {"return": self.mean_return, "costs": costs, **played}

    def to_json(self) -> str:
        """All fields, with the verdict, as JSON."""
        return json.dumps({"verdict": self.verdict, **asdict(self)}, indent=2, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> "Certificate":
        """The certificate that :meth:`to_json` wrote; raises ValueError for another text."""

        def values(kind: Any, content: Any) -> dict[str, Any]:
            return {it.name: fit(it.name, content[it.name], it.type) for it in fields(kind)}

        try:
            content = json.loads(text)
            costs = {key: CostBound(**values(CostBound, c)) for key, c in content["costs"].items()}
            return cls(**values(cls, {**content, "costs": costs or None}))
        except (TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"this is no certificate: {error!r}") from None


def agent_hash(model: Any, env: VecEnv) -> str:
    """SHA-256 of a policy's weights and what normalises its observations; "" of other objects."""
    digest = hashlib.sha256()
    policy = getattr(model, "policy", model)
    weights = policy.state_dict() if isinstance(policy, th.nn.Module) else {}
    for name, tensor in sorted(weights.items()):
        digest.update(name.encode() + np.ascontiguousarray(tensor.cpu()).tobytes())
    for name, part in sorted(moments_of(env).items()):
        digest.update(name.encode() + part.mean.tobytes() + part.var.tobytes())
    return digest.hexdigest() if weights else ""


def _described(env: VecEnv) -> dict[str, Any]:
    """The id and the arguments of an environment, as far as it says."""
    try:
        spec = env.get_attr("spec")[0]
        kwargs = {**spec.kwargs, "max_episode_steps": spec.max_episode_steps}
        return {"id": spec.id, "kwargs": json.loads(json.dumps(kwargs, default=str))}
    except (AttributeError, IndexError):
        return {"id": "", "kwargs": {}}


def certify(
    model: PolicyPredictor,
    env: gym.Env | gym.vector.VectorEnv | VecEnv,
    cost_limit: float | Sequence[float] | None = None,
    *,
    n_episodes: int = MOST,
    deterministic: bool = True,
    cost_keys: Sequence[str] | None = None,
    seed: int | None = None,
    error: float = ERROR,
    tries: int = 1,
) -> Certificate:
    """
    Play fresh episodes and say whether the agent's mean episode cost is within its limit.

    After all of the episodes an upper bound of the mean (:func:`mean_bounds`) is compared with the
    limit. After a quarter and half of them the playing ends where a lower bound is above it. The
    error is shared among bounds, costs and tries (Bonferroni), so that an agent whose true mean is
    above the limit is certified with a probability of about ``error`` at most: the bound is an
    approximation, and ``scripts/certificates.py`` measures by simulation how good it is. It is too
    low where very few episodes make up the mean.

    :param model: anything with ``predict``: an algorithm of Stable-Baselines3 or a policy
    :param env: a single or a vectorised environment with costs, normalised as in training
    :param cost_limit: d, one number or one per cost key; None: the model's own
    :param n_episodes: most episodes to play, at least 100
    :param deterministic: take the most likely action instead of sampling
    :param cost_keys: entries of info that are costs; None: those of the model or the environment
    :param seed: the episodes' seeds are drawn from it, and are not those that training or
        evaluation with the same seed draw; None draws one
    :param error: probability of a false certificate, below 0.5
    :param tries: how many agents share this error, such as candidates of one training. If there
        are others, one whose mean is above the limit at a look is not looked at again
    :raises ValueError: the limit is no finite number, there are too few episodes, no step reports
        a cost, the normalisation of the model's observations is absent, or a wrapper of ``env`` is
        for training only, as ``EarlyTermination`` and Gymnasium's ``NormalizeReward``
    """
    fit("n_episodes", n_episodes, int, LEAST, ends="[)")
    fit("tries", tries, int, 1, ends="[)")
    fit("error", error, float, 0.0, 0.5)
    env = as_vec_env(env)
    refuse_training_only(env)
    keys = check_cost_keys(cost_keys_of(model, env) if cost_keys is None else cost_keys)
    limits = limits_of(model, cost_limit, keys)
    seed = int(np.random.SeedSequence().generate_state(1)[0] if seed is None else seed)
    names = [bounded_name(key, getattr(model, "limit_on", "sum")) for key in keys]
    costs, returns = np.zeros((0, len(keys))), np.zeros(0)
    for look, share in enumerate(LOOKS):
        # Words of the seed's children, which training with the same seed has not drawn.
        fresh = int(np.random.SeedSequence(seed, spawn_key=(2, look)).generate_state(1)[0] >> 1)
        more = math.ceil(share * n_episodes) - len(returns)
        played = _play(model, env, more, deterministic, fresh, keys)
        costs = np.concatenate([costs, played.limited])
        returns = np.concatenate([returns, played.returns])
        ended = np.isfinite(costs).all(axis=1)
        if ended.sum() < 2:
            raise ValueError("the episodes ended in a physics error, whose costs are not known")
        bounds = [
            CostBound.of(cost, limit, error / tries / len(keys))
            for cost, limit in zip(costs[ended].T, limits, strict=True)
        ]
        if any(b.lower > b.limit or (tries > 1 and b.mean > b.limit) for b in bounds):
            break
    return Certificate(
        costs=dict(zip(names, bounds, strict=True)),
        episodes=int(ended.sum()),
        physics_errors=int((~ended).sum()),
        mean_return=float(returns[ended].mean()),
        deterministic=deterministic,
        seed=seed,
        error=error,
        tries=tries,
        env=_described(env),
        agent=agent_hash(model, env),
        versions={name: version(name) for name in PACKAGES},
    )


def refuse_training_only(env: VecEnv) -> None:
    """
    :raises ValueError: a wrapper is for training only, or has statistics that move: other costs
        would be certified
    """
    marks = [getattr(env, "training_only", False)]  # of any wrapper of a VecEnv
    with suppress(AttributeError, NotImplementedError):
        marks += env.get_attr("training_only")  # of single environments
    if any(marks):
        raise ValueError("a wrapper of env is for training only: certify without it")
    if fault := own_statistics(env):
        raise ValueError(fault)


def limits_of(model: Any, cost_limit: Any, keys: tuple[str, ...]) -> list[float]:
    """
    One limit for each cost.

    :param cost_limit: one number or one per cost key; None: the model's own
    :raises ValueError: they are not finite, too many or too few, or there is none
    """
    if cost_limit is None and isinstance(model, Constrained) and model.constrained:
        cost_limit = model.final_cost_limits
    if cost_limit is None:
        raise ValueError("the agent has no cost limit of its own: give cost_limit")
    check_per_cost("cost_limit", cost_limit, keys)
    return [float(limit) for limit in np.broadcast_to(cost_limit, len(keys))]


def _play(
    model: PolicyPredictor,
    env: VecEnv,
    episodes: int,
    deterministic: bool,
    seed: int,
    keys: tuple[str, ...],
) -> Evaluation:
    """
    Episodes of an agent, all of them.

    :raises ValueError: one has no end, no step reports a cost, or the observations lack the
        normalisation that the agent learnt with
    """
    if lacks_statistics(model, env):
        raise ValueError(
            "the agent learnt from normalised observations, and env has no VecNormalize of theirs"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they say of these episodes is an error here
        played = evaluate_policy(model, env, episodes, deterministic, seed=seed, cost_keys=keys)
    if len(played) < episodes:
        raise ValueError(
            f"{episodes - len(played)} of {episodes} episodes did not end; limit their length, "
            "with gymnasium.wrappers.TimeLimit(env, 1000) or, in commands, --env-kwargs "
            "max_episode_steps:1000"
        )
    if played.absent and getattr(model, "missing_cost", "error") == "error":
        absent = ", ".join(played.absent)
        raise ValueError(f"no step reported a cost as {absent} in info: name cost_keys")
    return played

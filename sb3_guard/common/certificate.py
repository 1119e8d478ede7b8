"""Certificates: an agent's mean episode cost is within its limit, shown by fresh episodes."""

import hashlib
import json
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.common.evaluation import Evaluation, evaluate_policy
from sb3_guard.common.monitor import cost_keys_of
from sb3_guard.costs import check_cost_keys
from sb3_guard.fields import fit
from sb3_guard.judging import EPISODES, ERROR, LEAST, Bound, Judgement, Limits, decide
from sb3_guard.vector import (
    as_vec_env,
    lacks_statistics,
    moments_of,
    normalizer_of,
    own_statistics,
)

PACKAGES = "sb3-guard", "stable-baselines3", "torch", "mujoco"
# Arguments of an environment that change its pictures alone
DRAWN = {"render_mode", "width", "height", "camera_name", "camera_id"}
#: Parts of a policy that its hash leaves out: critics and targets, without which it acts, and the
#: bounds of actions, which are those of the environment.
LEFT_OUT = (
    "value_net", "mlp_extractor.value_net", "vf_features_extractor", "critic", "critic_target",
    "actor_target", "box",
)  # fmt: skip


@dataclass(frozen=True)
class Certificate(Judgement):
    """
    Whether an agent's mean episode cost is within its limits, and how that is known.

    A *certified* agent's true mean costs, in this environment and with this kind of actions, are
    within their limits, with a confidence of about ``1 - error``, all looks and tries counted.
    Single episodes may cost more, and events that no episode saw are not bounded: 600 episodes see
    none of those in one of 200 episodes with a probability of 5 %.

    :param mean_return: mean return of the episodes
    :param deterministic: whether the most likely actions were taken, or sampled ones
    :param seed: of the episodes and of sampled actions
    :param error: probability of a certificate for an agent that exceeds a limit
    :param tries: number of agents that shared this error; this is one of them
    :param most: highest possible cost of an episode, with which the bounds are exact; None: they
        are approximate
    :param env: id of the environment, and its arguments
    :param agent: SHA-256 of the policy, see :func:`agent_hash`
    :param versions: of the packages
    """

    mean_return: float
    deterministic: bool
    seed: int
    error: float
    tries: int
    most: float | None
    env: dict[str, Any]
    agent: str
    versions: dict[str, str]

    def __str__(self) -> str:
        confidence = f"{1 - self.error:.0%}" if self.most else f"about {1 - self.error:.0%}"
        tail = f"return {self.mean_return:.4g}, {self._actions} actions, confidence {confidence}"
        if self.reason:
            tail += f"; {self.reason}"
        if self.to_decide is not None:
            tail += f"; about {self.to_decide:,} episodes would decide"
        if self.physics_errors:
            tail += f"; {self.physics_errors} more ended in a physics error"
        lines = [f"mean {name} {self._words(bound)}" for name, bound in self.costs.items()]
        if len(lines) == 1:
            return f"{self.verdict}: {lines[0]}; {tail}"
        return "\n  ".join([f"{self.verdict}: {tail}", *lines])

    @property
    def _actions(self) -> str:
        return "most likely" if self.deterministic else "sampled"

    def _words(self, bound: Bound) -> str:
        """Mean, the bound that decides, and the limit."""
        if bound.highest == bound.mean == 0.0:
            one_of = int(1.0 / (1.0 - self.error ** (1.0 / self.episodes)) + 1e-9)
            return (
                f"0, limit {bound.limit:g}; no cost in {self.episodes} fresh episodes, an event in "
                f"up to 1 of {one_of} would not have been seen"
            )
        above = round(bound.share_above * self.episodes)
        return f"{bound}; {above} of {self.episodes} fresh episodes cost more than the limit"

    def foreign(self, model: Any, env: VecEnv, deterministic: bool) -> str:
        """
        Of what else this certificate is: another agent, environment or kind of actions.

        Whoever shows or exports a certificate asks here first.

        :param model: the agent that is played
        :param env: the environment that it is played in
        :param deterministic: whether its most likely actions are taken
        :return: such as ``"another environment"``; empty if it is of this agent in this world
        """
        # Agents without weights and environments without an id are not told apart.
        if not self.agent or self.agent != agent_hash(model, env):
            return "another agent"
        names = Limits.of(model, cost_keys_of(model, env)).names
        if not self.env.get("id") or self.env != described(env) or tuple(self.costs) != names:
            return "another environment"
        return "" if self.deterministic == deterministic else f"{self._actions} actions"

    def summary(self) -> dict[str, Any]:
        """Return, actions, and of each cost its mean, bound, limit and share above it."""
        shown = "mean", "upper", "limit", "share_above"
        costs = {
            key: {name: getattr(cost, name) for name in shown} for key, cost in self.costs.items()
        }
        played = {"episodes": self.episodes, "deterministic": self.deterministic}
        return {"return": self.mean_return, "costs": costs, **played}

    def to_json(self) -> str:
        """All fields as JSON."""
        return json.dumps(asdict(self), indent=2, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> "Certificate":
        """
        The certificate that :meth:`to_json` wrote.

        :raises ValueError: the text is no certificate, or contradicts itself
        """

        def read(kind: type, content: Any) -> Any:
            types = {entry.name: entry.type for entry in fields(kind)}
            return kind(**{name: fit(name, content[name], types[name]) for name in types})

        try:
            content = json.loads(text)
            costs = {name: read(Bound, cost) for name, cost in content["costs"].items()}
            certificate: Certificate = read(cls, {**content, "costs": costs})
        except (TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"not of a certificate: {error!r}") from None
        safe = [cost.verdict == "certified" for cost in costs.values()]
        if not safe or (certificate.verdict == "certified" and not all(safe)):
            raise ValueError("its verdict contradicts its bounds")
        return certificate


def agent_hash(model: Any, env: VecEnv) -> str:
    """
    SHA-256 of all that makes a policy act as it does; "" of objects without weights.

    It covers the networks that act, their activations and weights, and of the normaliser of
    observations means, variances, clipping and epsilon.
    """
    digest = hashlib.sha256()
    policy = getattr(model, "policy", model)
    if not isinstance(policy, th.nn.Module) or not policy.state_dict():
        return ""

    def acts(name: str) -> bool:
        return not any(f"{name}.".startswith(f"{part}.") for part in LEFT_OUT)

    digest.update(type(policy).__name__.encode())
    for name, module in policy.named_modules():
        if acts(name) and not [*module.children()]:
            digest.update(f"{name} {module}".encode())
    for name, tensor in sorted(policy.state_dict().items()):
        if acts(name):
            digest.update(name.encode() + np.ascontiguousarray(tensor.cpu()).tobytes())
    moments, normalizer = moments_of(env), normalizer_of(env)
    if moments and normalizer:
        digest.update(f"{normalizer.clip_obs:g} {normalizer.epsilon:g}".encode())
    for name, part in sorted(moments.items()):
        digest.update(name.encode() + part.mean.tobytes() + part.var.tobytes())
    return digest.hexdigest()


def described(env: VecEnv) -> dict[str, Any]:
    """The id of an environment and the arguments that change more than its pictures."""
    try:
        spec = env.get_attr("spec")[0]
        kwargs = {**spec.kwargs, "max_episode_steps": spec.max_episode_steps}
    except (AttributeError, IndexError):
        return {"id": "", "kwargs": {}}
    kwargs = {name: value for name, value in kwargs.items() if name not in DRAWN}
    return {"id": spec.id, "kwargs": json.loads(json.dumps(kwargs, default=str))}


def certify(
    model: PolicyPredictor,
    env: gym.Env | gym.vector.VectorEnv | VecEnv,
    cost_limit: float | Sequence[float] | None = None,
    *,
    n_episodes: int = EPISODES,
    deterministic: bool = True,
    cost_keys: Sequence[str] | None = None,
    seed: int | None = None,
    error: float = ERROR,
    tries: int = 1,
    most: float | None = None,
) -> Certificate:
    """
    Play fresh episodes and say whether the agent's mean episode cost is within its limit.

    :func:`sb3_guard.judging.decide` says how: an upper bound of the mean is compared with the limit
    after ``n_episodes``, and after twice and four times as many where these would probably decide.
    The bound is an approximation; ``scripts/certificates.py`` measures by simulation how good it
    is. With ``most`` it is exact, and needs some 3 ``most`` / (limit - mean) episodes.

    :param model: anything with ``predict``: an algorithm of Stable-Baselines3 or a policy
    :param env: a single or a vectorised environment with costs, normalised as in training. Each
        episode begins with a seed of its own; many environments are played faster than one
    :param cost_limit: d, one number or one per cost key; None: the model's own
    :param n_episodes: episodes after which the agent may be certified, at least 100
    :param deterministic: take the most likely action instead of sampling
    :param cost_keys: entries of info that are costs; None: those of the model or the environment
    :param seed: the episodes' seeds are drawn from it, and are not those that training or
        evaluation with the same seed draw; None draws one
    :param error: probability of a false certificate, from 1e-12 to 0.5
    :param tries: how many agents share this error, such as candidates of one training. If there
        are others, one whose mean is above the limit at a look is not looked at again
    :param most: highest possible cost of an episode, for an exact bound; costs are at least 0
    :raises ValueError: the limit is no finite number, there are too few episodes, no step reports
        a cost, an episode costs more than ``most``, the normalisation of the model's observations
        is absent, all environments play the same episode whatever their seeds, or a wrapper of
        ``env`` is for training only, as ``EarlyTermination``
    """
    fit("n_episodes", n_episodes, int, LEAST, ends="[)")
    fit("tries", tries, int, 1, ends="[)")
    fit("error", error, float, 1e-12, 0.5)
    env = as_vec_env(env)
    refuse_training_only(env)
    keys = check_cost_keys(cost_keys_of(model, env) if cost_keys is None else cost_keys)
    limits = Limits.of(model, keys, cost_limit)
    if not limits:
        raise ValueError("the agent has no cost limit of its own: give cost_limit")
    seed = int(np.random.SeedSequence().generate_state(1)[0] if seed is None else seed)
    returns: list[np.ndarray] = []

    def play(episodes: int) -> np.ndarray:
        # Words of the seed's children, which training with the same seed has not drawn.
        child = np.random.SeedSequence(seed, spawn_key=(2, len(returns)))
        fresh = int(child.generate_state(1)[0] >> 1)
        played = _play(model, env, episodes, deterministic, fresh, keys)
        ended = ~np.isnan(played.limited).any(axis=1)
        returns.append(played.returns[ended])
        return played.limited

    judgement = decide(
        limits, play, n_episodes, error=error, tries=tries, most=most, rows=env.num_envs
    )
    return Certificate(
        **vars(judgement),
        mean_return=float(np.concatenate(returns).mean()),
        deterministic=deterministic,
        seed=seed,
        error=error,
        tries=tries,
        most=most,
        env=described(env),
        agent=agent_hash(model, env),
        versions={name: version(name) for name in PACKAGES},
    )


def refuse_training_only(env: VecEnv) -> None:
    """
    :raises ValueError: a wrapper is for training only, or has statistics that move: other costs
        would be certified
    """
    marks = [getattr(env, "training_only", False)]  # of any wrapper of a VecEnv
    with suppress(NotImplementedError):  # a vectorised environment need not tell
        if env.has_attr("training_only"):  # single environments
            marks += env.get_attr("training_only")
    if any(marks):
        raise ValueError("a wrapper of env is for training only: certify without it")
    if fault := own_statistics(env):
        raise ValueError(fault)


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

    :raises ValueError: one has no end, no step reports a cost, the observations lack the
        normalisation that the agent learnt with, or all are one episode
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
    if played.copies:
        raise ValueError(
            "the environments play copies of one episode: reset(seed=...) must draw another one "
            "for each seed (where nothing is random, one episode tells all)"
        )
    return played

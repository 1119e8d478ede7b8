"""Earlier rollouts in the cost surrogates, by importance weights.

A rollout says little about rare costs, and a step that follows what it says promises more than it
brings. Each of the last M rollouts is weighted so that it speaks of today's policy:

    w_n = π(a_n|s_n) / π_then(a_n|s_n),   W_n = w_n / Σ w,   size = 1 / Σ W²,

its cost advantages are estimated anew with today's critic, centred in these weights, and the
rollouts' surrogates ``Σ W_n (ratio_n - 1) A_n`` are averaged in proportion to their effective sizes
(Nguyen et al., 2014): a rollout whose policy is far away has few effective rows and counts little.
This rollout has N. The states remain those that the earlier policies visited; Queeney et al. (2021,
arXiv 2111.00072) bound what that may cost.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecNormalize

from sb3_guard.algorithms.common.actor import Actor
from sb3_guard.algorithms.common.advantage import gae
from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.batches import chunks, rows
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.costs import same_at_every_step
from sb3_guard.algorithms.common.trust_region import CostSurrogates, TrustRegion


class Rollout(NamedTuple):
    """What is kept of a rollout of T steps of n environments; observations are not normalised.

    Observations are arrays, or dictionaries of them.
    """

    number: int  # steps of the training at its end
    observations: Any  # [T, n, …]
    last_observations: Any  # [n, …], after the last step
    actions: np.ndarray  # [T, n, action_dim]
    log_probs: np.ndarray  # [T, n], when they were sampled
    costs: np.ndarray  # [T, n, m], raw
    episode_starts: np.ndarray  # [T, n]
    dones: np.ndarray  # [n], of the last step
    timeouts: np.ndarray  # [k, 2], step and environment of the episodes that a time limit cut
    timeout_observations: Any  # [k, …], at which they were


def importance(log_ratio: th.Tensor) -> tuple[th.Tensor, float]:
    """Self-normalised weights of rows, and how many equally weighted ones they are worth.

    :param log_ratio: log π(a|s) - log π_then(a|s), shape (N,)
    :return: W, which add up to 1, shape (N,), and 1 / Σ W², between 1 and N
    """
    weights = th.softmax(log_ratio, dim=0)
    return weights, 1.0 / float(weights.square().sum())


class _Part(NamedTuple):
    """An earlier rollout as an update sees it, N rows."""

    observations: Callable[[], PyTorchObs]  # made when they are needed: they take much memory
    actions: th.Tensor
    log_prob: th.Tensor  # of the old policy, (N,)
    weighted: th.Tensor  # W · A, (N, m)
    gradients: th.Tensor  # (m, P)
    size: float


class PooledSurrogates(CostSurrogates):
    """Cost surrogates of this rollout and earlier ones.

    :param actor: the policy on this rollout
    :param advantages: centred cost advantages of this rollout, shape (N, m)
    :param parts: the earlier rollouts
    """

    def __init__(self, actor: Actor, advantages: th.Tensor, parts: Sequence[_Part]) -> None:
        super().__init__(actor, advantages)
        self.parts = parts
        sizes = np.array([len(advantages), *(part.size for part in parts)])
        #: effective rows of all rollouts, in rollouts like this one
        self.rollouts = float(sizes.sum() / sizes[0])
        self.shares: list[float] = (sizes / sizes.sum()).tolist()

    def gradients(self) -> th.Tensor:
        gradients = [super().gradients(), *(part.gradients for part in self.parts)]
        return th.stack([s * g for s, g in zip(self.shares, gradients, strict=True)]).sum(dim=0)

    def changes(self, ratio: th.Tensor) -> th.Tensor:
        distribution = self.actor.policy.get_distribution
        changes = [self.shares[0] * super().changes(ratio)]
        for part, share in zip(self.parts, self.shares[1:], strict=True):
            observations = part.observations()
            log_prob = [
                distribution(rows(observations, index)).log_prob(part.actions[index])
                for index in chunks(len(part.log_prob))
            ]
            moved = th.exp(th.cat(log_prob) - part.log_prob) - 1.0
            changes.append(share * (moved @ part.weighted))
        return th.stack(changes).sum(dim=0)


def _each(function: Callable[..., Any], *observations: Any) -> Any:
    """A function of arrays, applied to each entry if they are dictionaries."""
    if isinstance(observations[0], dict):
        return {key: function(*(one[key] for one in observations)) for key in observations[0]}
    return function(*observations)


def _stack(observations: Sequence[Any], like: Any) -> Any:
    """[k, …] of k observations shaped like the rows of ``like``, also for k = 0."""
    if not observations:
        return _each(lambda array: array[:0], like)
    return _each(lambda *arrays: np.stack(arrays), *observations)


class Reuse(TrustRegion):
    """Trust-region steps whose cost surrogates also use earlier rollouts.

    :param reuse: number of earlier rollouts that the cost gradient and the line search's test of
        the cost use in addition to the last one; 0 for none, as in the papers. A loaded model
        begins without any, a resumed run has them
    """

    search_space: ClassVar[dict[str, Any]] = {"reuse": [0, 4, 9]}

    reuse: int = hyperparameter(0, low=0)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        #: the rollouts before this one, the latest last
        self.earlier: list[Rollout] = []
        self._raw: list[Any] = []  # observations of this rollout, one array per step
        self._raw_timeouts: list[Any] = []
        super().__init__(*args, **kwargs)

    def _check_hyperparameters(self) -> None:
        super()._check_hyperparameters()
        self._normalizer()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "earlier", "_raw", "_raw_timeouts"]

    def _normalizer(self) -> VecNormalize | None:
        """What normalises observations, None if nothing does.

        :raises ValueError: it can't normalise an observation of the model's anew
        """
        normalizer = self.get_vec_normalize_env()
        if not self.reuse or normalizer is None or not normalizer.norm_obs:
            return None
        if normalizer is not self.env:
            raise ValueError(
                f"reuse={self.reuse}: earlier observations are normalised with today's statistics, "
                "for which VecNormalize has to be the outermost wrapper; "
                f"{type(self.env).__name__} is around it. Take the one or the other away, or pass "
                "reuse=0"
            )
        return normalizer

    # Collecting

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> bool:
        normalizer = self._normalizer()
        self._raw_timeouts = []
        self._raw = [] if normalizer is None else [normalizer.get_original_obs()]
        return super().collect_rollouts(*args, **kwargs)

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: np.ndarray | None = None
    ) -> None:
        before = len(self._timeouts)
        super()._update_info_buffer(infos, dones)
        if not self.reuse:
            return
        normalizer = self._normalizer()
        # Where it was cut at ten standard deviations (``clip_obs``), it remains so.
        undo = (lambda obs: obs) if normalizer is None else normalizer.unnormalize_obs
        self._raw_timeouts += [undo(observation) for *_, observation in self._timeouts[before:]]
        if normalizer is not None:
            self._raw.append(normalizer.get_original_obs())

    def _rollout(self) -> Rollout:
        """The rollout just collected, before the buffer puts it in another order."""
        buffer, last = self.rollout_buffer, self._last_obs
        observations: Any = _each(np.copy, buffer.observations)
        if self._raw:
            *before, last = self._raw
            observations = _stack(before, last)
        assert self._last_episode_starts is not None
        return Rollout(
            self.num_timesteps,
            observations,
            last,
            buffer.actions.copy(),
            buffer.log_probs.copy(),
            buffer.costs.copy(),
            buffer.episode_starts.copy(),
            self._last_episode_starts.copy(),
            np.array([(step, i) for step, i, _ in self._timeouts], np.int64).reshape(-1, 2),
            _stack(self._raw_timeouts, last),
        )

    # Updating

    def train(self) -> None:
        if not self.reuse:
            return super().train()
        rollout = self._rollout()
        super().train()
        self.earlier = [*self.earlier, rollout][-self.reuse :]
        self._raw, self._raw_timeouts = [], []

    def cost_surrogates(self, actor: Actor, batch: CostRolloutBufferSamples) -> CostSurrogates:
        if not self.reuse:
            return super().cost_surrogates(actor, batch)
        parts = [self._part(rollout, type(actor)) for rollout in self.earlier]
        pooled = PooledSurrogates(actor, batch.cost_advantages, parts)
        self.logger.record("train/rollouts_used", pooled.rollouts)
        return pooled

    def _part(self, rollout: Rollout, kind: type[Actor]) -> _Part:
        """An earlier rollout's cost gradient at today's policy, and what its line search needs."""
        observations = self._today(rollout.observations, 2)
        flat = th.as_tensor(rollout.actions.reshape(rollout.log_probs.size, -1))
        actions = self._taken(flat.to(self.device))
        actor = kind(self.policy, observations, actions)
        log_ratio = actor.old_log_prob - th.as_tensor(rollout.log_probs.ravel()).to(self.device)
        weights, size = importance(log_ratio)
        traces = log_ratio.clamp(max=0.0).exp().cpu().numpy().reshape(rollout.log_probs.shape)
        advantages = self._cost_advantages(rollout, observations, traces).to(weights)
        weighted = weights[:, None] * (advantages - weights @ advantages)
        gradients = th.stack([actor.score(column) for column in weighted.unbind(dim=1)])
        again = partial(self._today, rollout.observations, 2)
        return _Part(again, actions, actor.old_log_prob, weighted, gradients, size)

    def _today(self, observations: Any, lead: int = 1) -> PyTorchObs:
        """Kept observations as the policy sees them today; ``lead`` axes become one of rows."""
        normalizer = self._normalizer()
        if normalizer is not None:
            observations = normalizer.normalize_obs(observations)
        flat = _each(lambda array: array.reshape(-1, *array.shape[lead:]), observations)
        return obs_as_tensor(flat, self.device)

    def _cost_advantages(
        self, rollout: Rollout, observations: PyTorchObs, traces: np.ndarray
    ) -> th.Tensor:
        """Cost advantages of an earlier rollout as today's critic sees it, shape (T · n, m)."""
        buffer, units = self.rollout_buffer, self.cost_units

        def values(of: PyTorchObs) -> np.ndarray:
            return units * self.cost_critic.predict(of).cpu().numpy()

        costs = rollout.costs.copy()
        if len(rollout.timeouts) and buffer.cost_gamma < 1.0:
            step, i = rollout.timeouts.T
            costs[step, i] += buffer.cost_gamma * values(self._today(rollout.timeout_observations))
        advantages = gae(
            costs,
            values(observations).reshape(costs.shape),
            rollout.episode_starts,
            values(self._today(rollout.last_observations)),
            rollout.dones,
            buffer.cost_gamma,
            buffer.cost_gae_lambda,
            traces,
        )
        if rollout.episode_starts[1:].sum() + rollout.dones.sum() == len(rollout.timeouts):
            advantages[..., same_at_every_step(rollout.costs)] = 0.0
        return th.as_tensor(advantages.reshape(-1, costs.shape[-1]))

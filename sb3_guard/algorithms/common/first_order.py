"""Epochs of minibatches, as in SB3's PPO, on a custom loss.

What differs from PPO is one hook, ``loss``. Critic, entropy bonus, gradient clipping and logs are
PPO's, bit for bit: with the loss it comes with and ``target_kl=None``, the class is PPO.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.utils import explained_variance
from torch.nn import functional as F

from sb3_guard.algorithms.common.actor import Before
from sb3_guard.algorithms.common.batches import chunks, rows
from sb3_guard.algorithms.common.buffers import CostRolloutBufferSamples
from sb3_guard.algorithms.common.rollouts import CALM, CostRollouts
from sb3_guard.algorithms.fast.optimizers import fuse

#: ``loss(batch, ratio, distribution)``, see :meth:`FirstOrder.loss`
Loss = Callable[[CostRolloutBufferSamples, th.Tensor, Distribution], th.Tensor]


class FirstOrder(CostRollouts, PPO):
    """SB3's PPO with a cost critic, whose loss a subclass replaces.

    :param target_kl: the passes over a rollout end with the first one after which the mean KL over
        the rollout exceeds it, where SB3's PPO looks at single minibatches; None for never
    """

    search_space: ClassVar[dict[str, Any]] = {
        "n_envs": [10, 20, 30],
        "gamma": [0.95, 0.98, 0.99, 0.995, 0.999],
        "gae_lambda": [0.9, 0.95, 0.97, 0.99],
        "learning_rate": {"low": 3e-5, "high": 3e-3, "log": True},
        "batch_size": [50, 250, 1000],
        "n_epochs": {"low": 3, "high": 40, "log": True},
        "policy_kwargs.net_arch": [{"pi": [n, n], "vf": [n, n]} for n in (64, 256)],
        "policy_kwargs.log_std_init": {"low": -1.5, "high": 0.0},
    }

    policy_defaults: ClassVar[dict[str, Any]] = CALM

    # λ = 0.97 and the stop by the KL of the rollout: what robots with episodes of 1,000 steps need.
    def __init__(
        self,
        *args: Any,
        gae_lambda: float = 0.97,
        target_kl: float | None = 0.02,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, gae_lambda=gae_lambda, target_kl=target_kl, **kwargs)

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.fuse_adam:
            fuse(self.policy.optimizer)

    # What an algorithm replaces

    #: Whether Adam takes its steps as one operation: faster, and PPO's up to rounding alone.
    fuse_adam: ClassVar[bool] = False

    def loss(
        self, batch: CostRolloutBufferSamples, ratio: th.Tensor, distribution: Distribution
    ) -> th.Tensor:
        """What the policy descends on a minibatch: here PPO's clipped objective.

        :param batch: B rows; reward advantages standardised within them if ``normalize_advantage``,
            cost advantages as the buffer has them
        :param ratio: π(a|s) / π_k(a|s), shape [B]
        :param distribution: π at the batch's observations
        :return: a scalar
        """
        clip = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        self.logger.record("train/clip_range", clip)
        clipped_ratios = th.mean((th.abs(ratio - 1) > clip).float())
        self.logger.record_mean("train/clip_fraction", clipped_ratios.item())
        unclipped = batch.advantages * ratio
        clipped = batch.advantages * th.clamp(ratio, 1 - clip, 1 + clip)
        return -th.min(unclipped, clipped).mean()

    # The update

    def train(self) -> None:
        """Passes over the rollout, then the cost critic."""
        self.descend(self.loss)
        values, returns = self.rollout_buffer.values, self.rollout_buffer.returns
        variance = explained_variance(values.flatten(), returns.flatten())
        self.logger.record("train/explained_variance", variance)
        self.fit_cost_critic()

    def snapshot(self) -> Before:
        """The policy as it is now on the rollout, to measure distances from while it learns."""
        batch = self.rollout_buffer.whole()
        return Before(self.policy, batch.observations, self._taken(batch.actions))

    def descend(
        self,
        loss: Loss,
        values: bool = True,
        start: Before | None = None,
        reach: float = 1.0,
    ) -> None:
        """Take passes of minibatches down a loss.

        :param loss: called as :meth:`loss` is
        :param values: whether the reward critic and the entropy bonus learn along; a step without
            them is logged as a projection
        :param start: the policy whose distance stops the passes; None for the one that acted
        :param reach: that distance, in ``target_kl``
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        history: dict[str, list[float]] = {}
        for _ in range(self.n_epochs):
            stop = self._descend_once(loss, values, history, start, reach)
            self._n_updates += 1
            if stop:
                break
        for name, numbers in history.items():
            self.logger.record(f"train/{name}", float(np.mean(numbers)))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", th.exp(self.policy.log_std).mean().item())

    def _descend_once(
        self,
        loss: Loss,
        values: bool,
        history: dict[str, list[float]],
        start: Before | None,
        reach: float,
    ) -> bool:
        """One pass; whether it was the last."""
        names = "policy_gradient_loss", "approx_kl"
        loss_name, kl_name = names if values else ("projection_loss", "projection_kl")
        history[kl_name] = []  # of the last pass alone, as SB3 logs it
        parameters = list(self.policy.parameters())
        for batch in self.rollout_buffer.get(self.batch_size):
            if values:
                predicted, log_prob, entropy = _evaluate(self, batch)
                distribution = self.policy.action_dist
            else:
                distribution = self.policy.get_distribution(batch.observations)
                log_prob = distribution.log_prob(self._taken(batch.actions))
            advantages = batch.advantages
            if self.normalize_advantage and len(advantages) > 1:
                advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
                batch = batch._replace(advantages=advantages)
            ratio = th.exp(log_prob - batch.old_log_prob)
            total = loss(batch, ratio, distribution)
            losses = {loss_name: total}
            if values:
                losses["entropy_loss"] = -th.mean(-log_prob if entropy is None else entropy)
                losses["value_loss"] = self._value_loss(batch, predicted.flatten())
                total = total + self.ent_coef * losses["entropy_loss"]
                total = total + self.vf_coef * losses["value_loss"]
                history["loss"] = [total.item()]  # of the last minibatch
            divergence = _divergence(batch, log_prob.detach(), start)
            for name, value in {**losses, kl_name: divergence}.items():
                history.setdefault(name, []).append(number := value.item())
                self._check_finite(name, number)
            self.policy.optimizer.zero_grad()
            total.backward()
            th.nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
            self.policy.optimizer.step()
        # The distance takes time.
        return self.target_kl is not None and mean_kl(self, start) > reach * self.target_kl

    def _value_loss(self, batch: CostRolloutBufferSamples, values: th.Tensor) -> th.Tensor:
        if self.clip_range_vf is not None:
            clip = self.clip_range_vf(self._current_progress_remaining)  # type: ignore[operator]
            self.logger.record("train/clip_range_vf", clip)
            change = th.clamp(values - batch.old_values, -clip, clip)
            values = batch.old_values + change
        return F.mse_loss(batch.returns, values)


@th.no_grad()
def mean_kl(model: CostRollouts, start: Before | None = None) -> float:
    """The mean over a rollout of KL(start ‖ policy), estimated on the actions taken as SB3 does.

    :param start: None for the policy that acted
    """
    batch = model.rollout_buffer.whole()
    total = 0.0
    for index in chunks(len(batch.actions)):
        part = CostRolloutBufferSamples(*(rows(field, index) for field in batch))
        _, log_prob, _ = _evaluate(model, part)
        total += float(_divergence(part, log_prob, start)) * len(log_prob)
    return total / len(batch.actions)


def _evaluate(model: CostRollouts, batch: CostRolloutBufferSamples) -> tuple[th.Tensor, ...]:
    """Values, log-probabilities and entropies; the distribution is ``policy.action_dist``."""
    return model.policy.evaluate_actions(batch.observations, model._taken(batch.actions))  # type: ignore


@th.no_grad()
def _divergence(
    batch: CostRolloutBufferSamples, log_prob: th.Tensor, start: Before | None
) -> th.Tensor:
    """KL(old ‖ new) from samples of the old one (Schulman, http://joschu.net/blog/kl-approx.html)."""
    log_ratio = log_prob - (batch.old_log_prob if start is None else start.log_prob[batch.places])
    return th.mean((th.exp(log_ratio) - 1) - log_ratio)

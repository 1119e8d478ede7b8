"""SAC's gradient step with costs, which SAC- and TQC-Lagrangian share."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.utils import polyak_update
from torch.nn import functional as F

from sb3_guard.algorithms.common.replay import CostReplay, descend
from sb3_guard.algorithms.common.replay_buffers import CostReplayBufferSamples


class SoftActorCritic(CostReplay):
    """For the classes that maximise E[Σ r + α H(π)].

    SB3 learns log α from 0, at ``learning_rate``: where a step's reward is 0.02, the policy stays
    random for the 14,000 gradient steps in which α falls from 1. With ``"auto_reward"`` α begins at
    the mean absolute reward of the steps before the first gradient step, divided by the number n
    of action dimensions. At SB3's target entropy, -n, a step's entropy then weighs as much as its
    reward, whatever the unit of reward.

    :param ent_coef: α: a number; or learnt from 1 (``"auto"``, SB3's default), from a number
        (``"auto_0.1"``), or from the size of the rewards (``"auto_reward"``)
    """

    ent_coef: str | float
    target_entropy: str | float
    batch_norm_stats: list[th.Tensor]
    batch_norm_stats_target: list[th.Tensor]
    target_update_interval: int
    actor: Any
    critic: Any
    critic_target: Any
    log_ent_coef: th.Tensor | None
    ent_coef_optimizer: th.optim.Adam | None
    ent_coef_tensor: th.Tensor

    def __init__(self, *args: Any, ent_coef: str | float = "auto_reward", **kwargs: Any) -> None:
        super().__init__(*args, ent_coef=ent_coef, **kwargs)

    def _setup_model(self) -> None:
        start = self.ent_coef
        if start == "auto_reward":
            self.ent_coef = "auto"  # as far as SB3 is concerned
        super()._setup_model()
        self.ent_coef = start

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        if self._n_updates == 0 and self.ent_coef == "auto_reward":
            self._start_at_the_rewards()
        super().train(gradient_steps, batch_size)

    @th.no_grad()
    def _start_at_the_rewards(self) -> None:
        """log α from the rewards in the buffer; 1 where there has been none."""
        rewards = self.replay_buffer.rewards[: self.replay_buffer.size()]
        if self._vec_normalize_env is not None:
            rewards = self._vec_normalize_env.normalize_reward(rewards)
        size = float(np.mean(np.abs(rewards), dtype=np.float64))
        if size > 0.0 and self.log_ent_coef is not None:
            self.log_ent_coef.fill_(np.log(size / get_action_dim(self.action_space)))

    # What the critics are: SAC's, one estimate a network

    def next_values(self, values: Any) -> th.Tensor:
        """Estimates of the next state's value that the critics learn from, shape [B, K].

        :param values: what the target critics say
        """
        return th.cat(values, dim=1).amin(dim=1, keepdim=True)

    def critic_loss(self, values: Any, target: th.Tensor) -> th.Tensor:
        """The loss of the critics' ``values`` against targets of shape [B, K]."""
        return 0.5 * sum(F.mse_loss(value, target) for value in values)  # type: ignore[return-value]

    def estimate(self, values: Any) -> th.Tensor:
        """What the actor climbs of the critics' ``values``, shape [B, 1]."""
        return th.min(th.cat(values, dim=1), dim=1, keepdim=True)[0]

    def expected(self, values: Any) -> th.Tensor:
        """An estimate of Q that the unit of rewards is measured by, shape [B, 1]."""
        return values[0]

    def learn_from(self, batch: CostReplayBufferSamples, step: int) -> dict[str, float]:
        """SB3's order: entropy coefficient, critics, actor, targets."""
        logs: dict[str, float] = {}
        if self.use_sde:
            self.actor.reset_noise()
        actions, log_prob = self.actor.action_log_prob(batch.observations)
        log_prob = log_prob.reshape(-1, 1)

        # Entropy coefficient α: one step of log α, if it is learnt
        if self.ent_coef_optimizer is None or self.log_ent_coef is None:
            alpha = self.ent_coef_tensor
        else:
            alpha = th.exp(self.log_ent_coef.detach())
            entropy = log_prob.detach() + float(self.target_entropy)
            alpha_loss = -(self.log_ent_coef * entropy).mean()
            descend(alpha_loss, self.ent_coef_optimizer)
            logs["ent_coef_loss"] = alpha_loss.item()
        logs["ent_coef"] = alpha.item()

        # Critics of the reward, Q ← r + γ (1 - done) (Q' - α log π'), and of the costs
        discounts = self.gamma if batch.discounts is None else batch.discounts  # of n-step returns
        with th.no_grad():
            next_actions, next_log_prob = self.actor.action_log_prob(batch.next_observations)
            after = self.next_values(self.critic_target(batch.next_observations, next_actions))
            after = after - alpha * next_log_prob.reshape(-1, 1)
            target = batch.rewards + (1 - batch.dones) * discounts * after
        values = self.critic(batch.observations, batch.actions)
        critic_loss = self.critic_loss(values, target)
        descend(critic_loss, self.critic.optimizer)
        logs["critic_loss"] = critic_loss.item()
        logs["cost_critic_loss"] = self.fit_cost_critic(batch, next_actions)

        # Actor: down (α log π - Q + Σ w_i Q_Ci) / (1 + Σ λ_i)
        weights = self.batch_weights(self.expected(values))
        loss = alpha * log_prob - self.estimate(self.critic(batch.observations, actions))
        if weights.any():
            costs = (self.cost_critic(batch.observations, actions) * weights).sum(1, keepdim=True)
            loss = (loss + costs) / (1.0 + float(self.prices.sum()))
        loss = loss.mean()
        descend(loss, self.actor.optimizer)
        logs["actor_loss"] = loss.item()

        # Targets
        if step % self.target_update_interval == 0:
            polyak_update(self._learners, self._targets, self.tau)
            polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)
        return logs

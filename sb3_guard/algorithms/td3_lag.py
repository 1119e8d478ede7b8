"""TD3-Lagrangian: TD3 with cost critics and a multiplier that follows the violation."""

import torch as th
from stable_baselines3 import TD3
from stable_baselines3.common.utils import polyak_update
from torch.nn import functional as F

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.replay import CostReplay, descend
from sb3_guard.algorithms.common.replay_buffers import CostReplayBufferSamples


class TD3Lag(CostReplay, TD3):
    """TD3 on the Lagrangian (Ray et al., 2019, with the learner of arXiv 1802.09477).

    ::

        max_π min_{λ ≥ 0}   J(π) - Σ λ_i (J_Ci(π) - d_i)

    Each cost has critics of its own, of which the larger value counts. Every ``policy_delay`` steps
    the actor descends ``(-Q + Σ λ_i Q_Ci) / (1 + Σ λ_i)``; the multipliers follow the mean
    cost of the latest episodes, exploration noise included. While no limit is exceeded the run
    equals SB3's TD3, bit for bit.
    """

    label, family, paper = "TD3-Lagrangian", "Lagrangian", "Ray et al. 2019"

    lambda_lr: float = hyperparameter(10.0)

    def learn_from(self, batch: CostReplayBufferSamples, step: int) -> dict[str, float]:
        """TD3's step: critics, and with a delay actor and targets."""
        discounts = self.gamma if batch.discounts is None else batch.discounts  # of n-step returns
        with th.no_grad():
            noise = th.empty_like(batch.actions).normal_(0, self.target_policy_noise)
            noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
            next_actions = (self.actor_target(batch.next_observations) + noise).clamp(-1, 1)
            after = th.cat(self.critic_target(batch.next_observations, next_actions), dim=1)
            after = after.amin(dim=1, keepdim=True)
            target = batch.rewards + (1 - batch.dones) * discounts * after
        values = self.critic(batch.observations, batch.actions)
        critic_loss = sum(F.mse_loss(value, target) for value in values)
        descend(critic_loss, self.critic.optimizer)  # type: ignore[arg-type]
        logs = {"critic_loss": critic_loss.item()}  # type: ignore[union-attr]
        logs["cost_critic_loss"] = self.fit_cost_critic(batch, next_actions)

        if self._n_updates % self.policy_delay == 0:
            actions = self.actor(batch.observations)
            weights = self.batch_weights(values[0])
            loss = -self.critic.q1_forward(batch.observations, actions)
            if weights.any():
                costs = (self.cost_critic(batch.observations, actions) * weights).sum(1, True)
                loss = (loss + costs) / (1.0 + float(self.prices.sum()))
            loss = loss.mean()
            descend(loss, self.actor.optimizer)
            logs["actor_loss"] = loss.item()
            polyak_update(self._learners, self._targets, self.tau)
            polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)
            polyak_update(self.critic_batch_norm_stats, self.critic_batch_norm_stats_target, 1.0)
            polyak_update(self.actor_batch_norm_stats, self.actor_batch_norm_stats_target, 1.0)
        return logs

"""SAC-Lagrangian: SAC with cost critics and a multiplier that follows the violation."""

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.utils import polyak_update
from torch.nn import functional as F

from sb3_guard.algorithms.common.replay import CostReplayBufferSamples, LagrangianReplay
from sb3_guard.algorithms.common.temperature import Temperature


class SACLag(Temperature, LagrangianReplay, SAC):
    """SAC on the Lagrangian (Ha et al., 2020, arXiv 2002.08550).

    ::

        max_π min_{λ ≥ 0}   J(π) + α H(π) - Σ λ_i (J_Ci(π) - d_i)

    Each cost has critics of its own, of which the larger value counts. The actor descends
    ``(α log π - min Q + Σ λ_i Q_Ci) / (1 + Σ λ_i)``; the multipliers follow the mean
    cost of the latest episodes. With ``ent_coef="auto"`` and while no limit is exceeded the run
    equals SB3's SAC, bit for bit.
    """

    label, family, paper = "SAC-Lagrangian", "Lagrangian", "Ha et al. 2020"

    def learn_from(self, batch: CostReplayBufferSamples, step: int) -> dict[str, float]:
        """SAC's step: temperature, critics, actor, targets."""
        if self.use_sde:
            self.actor.reset_noise()
        actions, log_prob = self.actor.action_log_prob(batch.observations)
        log_prob = log_prob.reshape(-1, 1)
        logs, alpha = self.fit_temperature(log_prob.detach())

        with th.no_grad():
            next_actions, next_log_prob = self.actor.action_log_prob(batch.next_observations)
            after = th.cat(self.critic_target(batch.next_observations, next_actions), dim=1)
            after = after.amin(dim=1, keepdim=True) - alpha * next_log_prob.reshape(-1, 1)
            target = batch.rewards + (1 - batch.dones) * self.gamma * after
        values = self.critic(batch.observations, batch.actions)
        critic_loss = 0.5 * sum(F.mse_loss(value, target) for value in values)
        self.critic.optimizer.zero_grad()
        critic_loss.backward()  # type: ignore[union-attr]
        self.critic.optimizer.step()
        logs["critic_loss"] = critic_loss.item()  # type: ignore[union-attr]
        logs["cost_critic_loss"] = self.fit_cost_critic(batch, next_actions)

        self.actor.optimizer.zero_grad()
        with self.critics_constant():
            chosen = th.cat(self.critic(batch.observations, actions), dim=1)
            chosen, _ = th.min(chosen, dim=1, keepdim=True)
            loss = self.penalized(alpha * log_prob - chosen, batch, actions, values[0]).mean()
            loss.backward()
        self.actor.optimizer.step()
        logs["actor_loss"] = loss.item()

        if step % self.target_update_interval == 0:
            polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
            polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)
            self.cost_critic.follow(self.tau)
        return logs

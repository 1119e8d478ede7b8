"""PPO-Lagrangian as docs/writing_an_algorithm.md has it."""

from stable_baselines3 import PPO

from sb3_guard.algorithms import CostRollouts, Lagrangian


class PPOLagrangian(Lagrangian, CostRollouts, PPO):
    """PPO on A - Σ λ_i A_Ci, where λ follows J_C - d."""

    def train(self):
        self.step()  # λ follows J_C
        buffer = self.rollout_buffer
        buffer.advantages = buffer.advantages - buffer.cost_advantages @ self.weights()
        super().train()  # SB3's own: at weight 0 the run equals SB3's PPO bit for bit
        self.fit_cost_critic()

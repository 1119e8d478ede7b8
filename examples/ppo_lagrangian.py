"""PPO-Lagrangian in six lines, with the bases for algorithms of your own."""

from stable_baselines3 import PPO

from sb3_guard import evaluate_policy, make_vec_env
from sb3_guard.algorithms import CostRollouts, Lagrangian


class PPOLagrangian(Lagrangian, CostRollouts, PPO):
    """PPO on A - Σ λ_i A_Ci, where λ follows J_C - d."""

    def train(self):
        self.step()  # λ follows J_C
        buffer = self.rollout_buffer
        buffer.advantages = buffer.advantages - buffer.cost_advantages @ self.weights()
        super().train()  # SB3's own: at weight 0 the run equals SB3's PPO bit for bit
        self.fit_cost_critic()


if __name__ == "__main__":
    env = make_vec_env("Goal_Point_8Hazards", n_envs=10, seed=0)
    model = PPOLagrangian("MlpPolicy", env, n_steps=1000, cost_limit=5.0, lambda_lr=0.02, seed=0)
    model.learn(300_000)
    outcome = evaluate_policy(model, env, n_eval_episodes=10, seed=1)
    print("return", outcome.returns.mean(), "cost", outcome.costs.mean(), "limit 5.0")

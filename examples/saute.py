"""Sauté RL: PPO and SAC, which ignore costs, learn to keep a budget that they observe."""

from stable_baselines3 import PPO, SAC

from sb3_guard import evaluate_policy, make_vec_env
from sb3_guard.common.vec_budgets import VecRemainingBudget


def make():
    """Add the remaining budget to the observation; overspending has a reward of -1 per step."""
    env = make_vec_env("Goal_Point_8Hazards", 10, seed=0)
    return VecRemainingBudget(env, budget=5.0, unsafe_reward=-1.0)


ppo = PPO("MlpPolicy", make(), n_steps=1000, batch_size=1000, seed=0)
sac = SAC("MlpPolicy", make(), learning_starts=100, buffer_size=100_000, gradient_steps=10, seed=0)
for model in (ppo, sac):
    model.learn(300_000)
    print(type(model).__name__, evaluate_policy(model, make(), n_eval_episodes=10))

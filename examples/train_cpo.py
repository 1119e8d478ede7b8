"""Train CPO, save it, load it, and print its return and cost."""

from sb3_guard import CPO, evaluate_policy, make_vec_env

# Ten robots at once, in one batch of simulations. An episode has 1000 steps, so every update sees
# ten whole episodes.
env = make_vec_env("Goal_Point_8Hazards", n_envs=10, seed=0)
model = CPO("MlpPolicy", env, n_steps=1000, cost_limit=5.0, seed=0, verbose=1)
model.learn(300_000)
model.save("cpo_point")

model = CPO.load("cpo_point")
print(evaluate_policy(model, env, n_eval_episodes=10, seed=1))  # with the limit beside the cost

"""Train on Safety-Gymnasium, as it is.

It needs older versions of MuJoCo and Gymnasium than sb3_guard's own environments do, so it lives
in a Python environment of its own, which scripts/check_safety_gymnasium.py sets up.
"""

from sb3_guard import CPO, evaluate_policy, make_vec_env

# Its ids are accepted as they are: the cost, the third of six values that its `step` returns,
# becomes info["cost"], and cost_hazards and the others stay where they are.
env = make_vec_env("SafetyPointGoal1-v0", n_envs=4, seed=0)
model = CPO("MlpPolicy", env, n_steps=1000, cost_limit=25.0, seed=0, verbose=1)
model.learn(300_000)

evaluation = evaluate_policy(model, env, n_eval_episodes=4, seed=1)
print("return", evaluation.estimate(evaluation.returns))
print("cost  ", evaluation.estimate(evaluation.costs))

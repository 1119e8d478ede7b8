"""Train on the original Safety-Gymnasium package.

It needs older versions of MuJoCo and Gymnasium, so scripts/safety_gymnasium/check.py installs it in
a Python environment of its own. Elsewhere the same lines train on sb3_guard's task of this name.
"""

from sb3_guard import CPO, evaluate_policy, make_vec_env

# The cost, which is the third of six values that the package's `step` returns, becomes
# info["cost"]; cost_hazards and the others stay in info.
env = make_vec_env("SafetyPointGoal1-v0", n_envs=4, seed=0)
model = CPO("MlpPolicy", env, n_steps=1000, cost_limit=25.0, seed=0, verbose=1)
model.learn(300_000)

evaluation = evaluate_policy(model, env, n_eval_episodes=4, seed=1)
print("return", evaluation.estimate(evaluation.returns))
print("cost  ", evaluation.estimate(evaluation.costs))

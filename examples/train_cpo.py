"""Train CPO, save it, load it, and print its return and cost."""

from sb3_guard import CPO, evaluate_policy, make_model

# The agent of `sb3-guard train --algo cpo --env Goal_Point_8Hazards -params cost_limit:5`: thirty
# robots in one batch of simulations, with an update after thirty whole episodes.
model = make_model("cpo", "Goal_Point_8Hazards", cost_limit=5.0, seed=0, verbose=1)
model.learn(300_000)
model.save("cpo_point")

env = model.get_env()
model = CPO.load("cpo_point")
# The line also has the limit, and whether these episodes keep it.
print(evaluate_policy(model, env, n_eval_episodes=10, seed=1))

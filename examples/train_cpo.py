"""How do I train an agent that keeps its cost limit, and how do I know that it does?"""

from sb3_guard import CPO, certify, make_model

# The agent of `sb3-guard train --algo cpo --env Goal_Point_8Hazards -params cost_limit:5`: thirty
# robots in one batch of simulations, with an update after thirty whole episodes.
model = make_model("cpo", "Goal_Point_8Hazards", cost_limit=5.0, seed=0, verbose=1)
model.learn(1_000_000)
model.save("cpo_point")

env = model.get_env()
model = CPO.load("cpo_point")
# "certified": the mean cost of an episode is at most 5, with a confidence of 95 %.
print(certify(model, env, seed=1))

"""How do I give two costs a limit each?"""

from sb3_guard import evaluate_policy, make_model

costs = ("cost_hazards", "cost_ghosts")  # each constraint reports its own; "cost" is the sum

model = make_model(
    "cpo",
    "Goal_Point_8Hazards",
    env_kwargs={"ghosts": {"num": 4, "speed": 0.002}},  # speed: m per control step
    cost_keys=costs,
    cost_limit=[5.0, 2.0],
    n_envs=10,
    seed=0,
)
env = model.learn(300_000).get_env()

print(evaluate_policy(model, env, n_eval_episodes=10, seed=1))

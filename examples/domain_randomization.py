"""Sizes, numbers, mass and delay that are drawn anew in each episode (domain randomisation)."""

from sb3_guard import CPO, evaluate_policy, make_vec_env

varied = {
    "hazards": {"num": {"low": 4, "high": 10}, "size": {"low": 0.2, "high": 0.4}},
    "goal": {"size": {"low": 0.3, "high": 0.6}},
    "robot": {"mass": {"low": 0.5, "high": 2.0}, "delay": {"low": 0, "high": 3}},
    "observe": {"drawn": True},  # info has what was drawn
}
env = make_vec_env("Goal_Point_8Hazards", n_envs=10, seed=0, env_kwargs=varied)
model = CPO("MlpPolicy", env, n_steps=1000, cost_limit=5.0, seed=0)
model.learn(300_000)

env.seed(1)
env.reset()
info = env.step(env.action_space.sample()[None].repeat(10, axis=0))[3][0]
print("drawn:", {name: info[name] for name in ("hazards.num", "hazards.size", "robot.mass")})

# the same agent at both ends of the range of one parameter
for mass in (0.5, 2.0):
    kwargs = {**varied, "robot": {**varied["robot"], "mass": mass}}
    test = make_vec_env("Goal_Point_8Hazards", n_envs=10, seed=1, env_kwargs=kwargs)
    evaluation = evaluate_policy(model, test, n_eval_episodes=20, seed=1)
    print(f"mass × {mass}: return", evaluation.estimate(evaluation.returns))
    print(f"mass × {mass}: cost", evaluation.estimate(evaluation.costs))

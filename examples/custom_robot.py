"""How do I use a robot of my own, from an MJCF file?"""

from pathlib import Path

from sb3_guard import evaluate_policy, make_model, register_robot

Path("puck.xml").write_text("""
<mujoco model="puck">
  <worldbody>
    <body name="robot" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0" damping="0.1"/>
      <joint name="y" type="slide" axis="0 1 0" damping="0.1"/>
      <geom type="cylinder" size="0.12 0.05" density="20" rgba="0.9 0.5 0.1 1"/>
      <site name="robot" size="0.01"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="push_x" joint="x" gear="0.1" ctrlrange="-1 1"/>
    <motor name="push_y" joint="y" gear="0.1" ctrlrange="-1 1"/>
  </actuator>
  <sensor>
    <velocimeter name="velocimeter" site="robot"/>
  </sensor>
</mujoco>
""")
register_robot("Puck", xml="puck.xml")

# Every task and every constraint knows it now, and so do `sb3_guard.make` and the commands.
model = make_model("cpo", "Goal_Puck_8Hazards", cost_limit=5.0, n_envs=10, seed=0)
env = model.get_env()
print(f"{env.observation_space.shape[0]} observations, {env.action_space.shape[0]} actions")
model.learn(300_000)
evaluation = evaluate_policy(model, env, n_eval_episodes=10, seed=1)
print(f"return {evaluation.returns.mean():.1f}, cost {evaluation.costs.mean():.2f}")

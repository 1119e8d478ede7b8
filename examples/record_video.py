"""Record a video of an agent, without a display."""

import gymnasium
import imageio_ffmpeg

from sb3_guard import load_pretrained

# camera: "fixed", "track" behind the robot, or "top"
env = gymnasium.make(
    "Goal_Point_8Hazards-v0", render_mode="rgb_array", width=640, height=480, camera="track"
)
model = load_pretrained("Goal_Point_8Hazards")  # or CPO.load, for a file of your own

video = imageio_ffmpeg.write_frames("point.mp4", (640, 480), fps=env.metadata["render_fps"])
video.send(None)
obs, _ = env.reset(seed=9)
for _ in range(500):
    action, _ = model.predict(obs, deterministic=True)
    obs, reward, terminated, truncated, info = env.step(action)
    video.send(env.render())
    if terminated or truncated:
        obs, _ = env.reset()
video.close()
env.close()
print("point.mp4")

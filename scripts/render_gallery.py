"""Draw and film every robot, task and constraint with a trained agent: fills docs/images.

``python scripts/render_gallery.py`` draws all; ``--only trained`` remakes one file. What is
filmed is an agent of the package's where there is one, else TRPO from a run in the log folder
``--agents``, trained now if it is not there.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard import ALGORITHMS, make_vec_env, train
from sb3_guard.envs import GuardVectorEnv, env_spec
from sb3_guard.envs.registry import CONSTRAINTS, ROBOTS, TASKS, guard
from sb3_guard.envs.suites.velocity import TABLE
from sb3_guard.zoo.agents.flags import AgentFlags
from sb3_guard.zoo.agents.playback import find_run, open_agent
from sb3_guard.zoo.agents.pretrained import load_pretrained
from sb3_guard.zoo.cli.usage import UsageError

TRAINED = "SafetyPointGoal1-v0"  # the suite of the animation
AGENTS = ("trpo", None)  # in it: the one without a limit, and the one with a limit
PERIOD = 2  # control steps, of 0.02 s, from frame to frame
FRAMES = 240
DELAY = 40  # ms that a frame is shown: as fast as it happens
TRAINING = "--algo trpo -n 5e5 --seed 0 --eval-freq -1 --verbose 0".split()  # of what is filmed
CLIP = 100  # frames of a clip
CLIP_FPS = 25  # as fast as it happens
# More pictures of a part, as it is elsewhere or can be made: <kind>_<part>_<how>
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "constraint_ghosts_spatial": ("Goal_Drone_8Ghosts", {}),
    "constraint_ghosts_solid": ("Goal_Point_8Ghosts", {"ghosts": {"solid": True}}),
    "task_chase_solid": ("Chase_Point_8Hazards", {"chase": {"solid": True}}),
    "task_push_box": ("Push_Point_8Hazards", {"push": {"object": "box"}}),
}
SAFETY = {
    f"safety_{task.lower()}": f"SafetyPoint{task}-v0"
    for task in ("Goal1", "Button1", "Push1", "Circle1", "Run0")
}
SAFETY |= {f"velocity_{robot.lower()}": f"Safety{robot}Velocity-v1" for robot in TABLE}
# Robots of other packages, of scripts/robots.py: filmed with CPO's runs in the log folder
FILES = {"file_go1": ("WalkingGo1-v0", 1.6), "file_yam": ("ReachingYam-v0", 2.2)}
# Small robots are shown nearer: the middle of a picture that is so many times as large
ZOOM = {"Arm3": 1.0, "Arm6": 1.0, "Humanoid": 1.3, "Hopper": 1.4}


def scenes() -> Iterator[tuple[str, str, str, float]]:
    """Stem, environment, camera and zoom of each robot, near, and each task and constraint."""
    for robot in guard(ROBOTS):
        yield f"robot_{robot.lower()}", f"Goal_{robot}_8Hazards-v0", "track", ZOOM.get(robot, 1.6)
    for task in guard(TASKS):
        yield f"task_{task.lower()}", f"{task}_Point_8Hazards-v0", "fixed", 1.0
    for constraint in guard(CONSTRAINTS):
        yield f"constraint_{constraint.lower()}", f"Goal_Point_8{constraint}-v0", "fixed", 1.0


def picture(
    env_id: str, path: Path, camera: str | None, seed: int, zoom: float = 1.0, **params: Any
) -> None:
    """Write a picture of an environment after a random step: the site shows it at half size."""
    # The speeds that MuJoCo writes into a picture have the same size in all: small in large ones.
    width, height = (360, 300) if "Velocity" in env_id else (720, 600)
    window = {"width": round(width * zoom), "height": round(height * zoom), "camera": camera}
    known = env_spec(env_id).kwargs
    env = GuardVectorEnv(1, render_mode="rgb_array", **{**known, **window, **params})
    env.reset(seed=seed)
    env.step(np.random.default_rng(seed).uniform(-0.2, 0.2, env.action_space.shape))
    (frame,) = env.render() or ()
    env.close()
    left, top = (frame.shape[1] - width) // 2, (frame.shape[0] - height) // 2
    whole = Image.fromarray(frame).crop((left, top, left + width, top + height))
    whole.quantize(96).save(path, optimize=True)
    print(f"{path} {path.stat().st_size / 1024:.0f} KiB")


def acts(model: BaseAlgorithm, obs: Any) -> np.ndarray:
    """The most likely actions of one of the package's agents, which may normalise observations."""
    normalizer = model.get_vec_normalize_env()
    seen = obs if normalizer is None else normalizer.normalize_obs(obs)
    return model.predict(seen, deterministic=True)[0]


def typical() -> int:
    """Of 100 seeds the one whose returns and costs are nearest to the means of both agents."""
    distance = np.zeros(100)
    for key in AGENTS:
        env = make_vec_env(TRAINED, 100, seed=0)  # row i as a lone environment with seed i
        model = load_pretrained(TRAINED, key, device="cpu")
        obs, got = env.reset(), np.zeros((2, 100))
        for _ in range(FRAMES * PERIOD):
            obs, rewards, _, infos = env.step(acts(model, obs))
            got += rewards, [info["cost"] for info in infos]
        env.close()
        name = type(model).__name__
        print(f"{name}: mean return {got[0].mean():.2f}, mean cost {got[1].mean():.2f}")
        distance += abs(got.T / got.mean(axis=1) - 1.0).sum(axis=1)
    return int(distance.argmin())


def film(key: str | None, seed: int) -> list[Image.Image]:
    """Frames of one of the package's own agents, with what it has got and paid so far."""
    window = {"width": 1200, "height": 834, "camera": "fixed"}
    env = make_vec_env(TRAINED, seed=seed, env_kwargs=window, render_mode="rgb_array")
    model = load_pretrained(TRAINED, key, device="cpu")
    font = ImageFont.load_default(15)
    frames, reward, cost = [], 0.0, 0.0
    obs = env.reset()
    for step in range(FRAMES * PERIOD):
        if step % PERIOD == 0:
            (pixels,) = env.get_images()
            frame = Image.new("RGB", (400, 304), "white")
            frame.paste(Image.fromarray(pixels).resize((400, 278)), (0, 26))  # drawn large: smooth
            draw = ImageDraw.Draw(frame)
            color = (200, 0, 0) if cost > 0 else (40, 40, 40)
            draw.text((2, 3), f"{model.label}   return {reward:z.1f}", (40, 40, 40), font)
            draw.text((398, 3), f"cost {cost:.0f}", color, font, anchor="ra")
            frames.append(frame)
        obs, rewards, _, infos = env.step(acts(model, obs))
        reward, cost = reward + rewards[0], cost + infos[0]["cost"]
    env.close()
    return frames


def animation(path: Path, seed: int) -> None:
    """Write a small film of two of the package's agents in the same place."""
    frames = [Image.new("RGB", (808, 304), "white") for _ in range(FRAMES)]
    for left, key in zip((0, 408), AGENTS, strict=True):
        for frame, half in zip(frames, film(key, seed), strict=True):
            frame.paste(half, (left, 0))
    save(frames, path)


def agent(env_id: str, folder: str) -> tuple[BaseAlgorithm, bool]:
    """Who is filmed, and whether without noise: a robot that has learnt little needs it."""
    if "_Point_" in env_id:  # docs/gallery.md says so of no other robot
        with suppress(UsageError):
            return load_pretrained(env_id, device="cpu"), True
    try:
        run = find_run(folder, "trpo", env_id)
    except UsageError:
        if train.main([*TRAINING, "--env", env_id, "-f", folder]):
            raise SystemExit(f"{env_id}: not trained") from None
        run = find_run(folder, "trpo", env_id)
    return ALGORITHMS["trpo"].load(run.model, device="cpu"), False


def clip(env_id: str, path: Path, camera: str, folder: str, seed: int, zoom: float = 1.0) -> None:
    """Write a small film of an agent, as fast as it happens."""
    model, deterministic = agent(env_id, folder)
    window = {"width": round(600 * zoom), "height": round(500 * zoom), "camera": camera}
    env = make_vec_env(env_id, seed=seed, env_kwargs=window, render_mode="rgb_array")
    write_clip(model, env, path, deterministic)


def write_clip(model: BaseAlgorithm, env: VecEnv, path: Path, deterministic: bool = True) -> None:
    """Write a small film of an agent in its environment, which is closed afterwards."""
    rate = env.envs.metadata["render_fps"]
    every = max(1, round(rate / CLIP_FPS))
    frames: list[np.ndarray] = []
    obs = env.reset()
    for step in range(10_000):
        if step % every == 0:
            frames += env.get_images()
        if len(frames) >= CLIP:
            break
        obs, *_ = env.step(model.predict(obs, deterministic=deterministic)[0])
    env.close()
    left, top = (frames[0].shape[1] - 600) // 2, (frames[0].shape[0] - 500) // 2
    whole = [Image.fromarray(frame).crop((left, top, left + 600, top + 500)) for frame in frames]
    first, *others = [frame.resize((300, 250)) for frame in whole[:CLIP]]
    first.save(path, save_all=True, append_images=others, duration=round(1000 * every / rate),
               loop=0, quality=50)  # fmt: skip
    print(f"{path} {path.stat().st_size / 1024:.0f} KiB", flush=True)


def file_clips(output: Path, folder: str, seed: int) -> None:
    """A clip of each robot of another package with a task in scripts/robots.py."""
    for stem, (env_id, zoom) in FILES.items():
        window = {"width": round(600 * zoom), "height": round(500 * zoom), "camera": "track"}
        flags = AgentFlags(env=env_id, folder=folder, seed=seed, env_kwargs=window,
                           gym_packages=["robots"])  # fmt: skip
        chosen = open_agent(flags, "rgb_array")
        write_clip(chosen.model, chosen.env, output / f"{stem}.webp")


def save(frames: list[Image.Image], path: Path) -> None:
    """Write a film with one palette for all frames, so that only what moves is written again."""
    palette = Image.fromarray(np.vstack([np.asarray(f) for f in frames[::12]])).quantize(
        96, Image.Quantize.FASTOCTREE
    )
    first, *others = [f.quantize(palette=palette, dither=Image.Dither.NONE) for f in frames]
    first.save(path, save_all=True, append_images=others, duration=DELAY, loop=0, optimize=True)
    print(f"{path} {path.stat().st_size / 1024:.0f} KiB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images"))
    parser.add_argument("--seed", type=int, default=3, help="of the pictures")
    parser.add_argument("--film-seed", type=int, help="of the film (default: a typical one)")
    parser.add_argument("--agents", default="logs/gallery", help="log folder")
    parser.add_argument(
        "--only", choices=["pictures", "clips", "files", "trained"], help="draw these only"
    )
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    if args.only in (None, "trained"):
        seed = typical() if args.film_seed is None else args.film_seed
        animation(args.output / "trained.gif", seed)
    if args.only in (None, "clips"):
        for stem, env_id, camera, zoom in scenes():
            clip(env_id, args.output / f"{stem}.webp", camera, args.agents, args.seed, zoom)
    if args.only in (None, "files"):
        file_clips(args.output, args.agents, args.seed)
    if args.only in (None, "pictures"):
        for stem, env_id, camera, zoom in scenes():
            picture(env_id, args.output / f"{stem}.png", camera, args.seed, zoom)
        for stem, env_id in SAFETY.items():
            picture(env_id, args.output / f"{stem}.png", None, args.seed)
        racecar = args.output / "safety_racecar.png"
        picture("SafetyRacecarGoal1-v0", racecar, "track", args.seed, 2.0)
        for stem, (env_id, params) in VARIANTS.items():
            picture(env_id, args.output / f"{stem}.png", "fixed", args.seed, **params)
        import_module("robots")  # scripts/robots.py fetches and registers them
        for stem, (env_id, zoom) in FILES.items():  # with seed 2 their goals are seen
            picture(env_id, args.output / f"{stem}.png", "track", 2, zoom)


if __name__ == "__main__":
    main()

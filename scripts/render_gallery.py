"""Draw every robot, task and constraint: ``python scripts/render_gallery.py`` fills docs/images."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from sb3_guard.envs import GuardVectorEnv
from sb3_guard.envs.registry import CONSTRAINTS, ROBOTS, TASKS


def picture(name: str, path: Path, camera: str, steps: int, seed: int) -> None:
    """Write a small picture of an environment after some random steps."""
    env = GuardVectorEnv(1, name, render_mode="rgb_array", width=360, height=300, camera=camera)
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        env.step(rng.uniform(-0.2, 0.2, env.action_space.shape))
    (frame,) = env.render() or ()
    env.close()
    Image.fromarray(frame).quantize(96).save(path, optimize=True)
    print(f"{path} {path.stat().st_size / 1024:.0f} KiB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images"))
    parser.add_argument("--seed", type=int, default=3)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    for robot in ROBOTS:
        path = args.output / f"robot_{robot.lower()}.png"
        picture(f"Goal_{robot}_8Hazards", path, "track", 1, args.seed)
    for task in TASKS:
        path = args.output / f"task_{task.lower()}.png"
        picture(f"{task}_Point_8Hazards", path, "fixed", 1, args.seed)
    for constraint in CONSTRAINTS:
        path = args.output / f"constraint_{constraint.lower()}.png"
        picture(f"Goal_Point_8{constraint}", path, "fixed", 1, args.seed)


if __name__ == "__main__":
    main()

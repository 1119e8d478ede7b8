"""One environment in full: ``sb3-guard show Goal_Ant_8Ghosts`` prints it and writes a picture."""

import sys
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import yaml

from sb3_guard.envs import GuardVectorEnv, env_spec
from sb3_guard.envs.check_part import exploded
from sb3_guard.envs.rendering import CAMERAS, RenderingError
from sb3_guard.zoo.flags import Command, command, flag
from sb3_guard.zoo.markdown import table
from sb3_guard.zoo.usage import UsageError, explained, import_packages


def observation_table(env: GuardVectorEnv) -> str:
    """Name, slice, bounds and unit of every component of the observation."""
    rows = []
    for name, where in env.observation_layout.items():
        channel = env.engine.channels[name]
        bounds = f"[{channel.low:g}, {channel.high:g}]"
        rows.append([name, f"{where.start}:{where.stop}", bounds, channel.unit])
    if env.engine.extras.camera is not None:
        width, height = env.engine.extras.camera
        rows.append(["camera", f"image {height} × {width} × 3", "[0, 255]", "red, green, blue"])
    return table(["observation", "slice", "bounds", "unit"], rows)


def action_table(env: GuardVectorEnv) -> str:
    """Index, actuator and control range of every action."""
    model = env.engine.model
    rows = []
    for i in range(model.nu):
        low, high = model.actuator_ctrlrange[i]
        name = model.actuator(i).name.removeprefix("robot/")
        least, most = (np.broadcast_to(b, model.nu)[i] for b in env.engine.robot.action_range)
        rows.append([str(i), name, f"[{least:g}, {most:g}]", f"[{low:g}, {high:g}]"])
    return table(["action", "actuator", "range", "control"], rows)


def unsteady(env: GuardVectorEnv) -> str | None:
    """What is wrong with a robot after a second alone, or of random actions: it falls, explodes."""
    return _watch(env, alone=True) or _watch(env, alone=False)


def _watch(env: GuardVectorEnv, alone: bool) -> str | None:
    engine, rng = env.engine, np.random.default_rng(0)
    how = "left alone" if alone else "given random actions"
    low, high = engine.robot.action_range
    shape = env.num_envs, engine.robot.action_size
    rest = np.broadcast_to((np.asarray(low) + high) / 2, shape)
    env.reset(seed=0)
    for step in range(1, round(1 / engine.control_step) + 1):
        outcome = engine.step(rest if alone else rng.uniform(low, high, shape))
        seconds = f"{step * engine.control_step:.2g} s"
        if exploded(engine, outcome):
            return (
                f"the robot, {how}, explodes within {seconds}: reduce its timestep (now "
                f"{engine.model.opt.timestep:g} s), or the stiffness of its joints and the gears "
                "and gains of its actuators, or move apart geoms that overlap"
            )
        if alone and engine.robot.position[0, 2] < -0.1:
            return (
                f"the robot, left alone, falls through the floor within {seconds}: its geoms need "
                "contype and conaffinity of 1, and its class floor=True"
            )
        if outcome.terminated[0]:
            break
    return None


@dataclass
class Flags(Command):
    """
    Print an environment's scenario, observations and actions; write a picture.

    :param env: an id of ours, or a scenario file (.yml)
    :param env_kwargs: change parameters
    :param output: picture to write (default: <env>.png)
    :param camera: fixed, track or top (default: fixed, or track where the robot runs far away)
    :param window: watch the robot act at random in MuJoCo's viewer instead: Space pauses, Tab opens
        menus, F shows contact forces
    :param seed: of the episode in the picture
    :param gym_packages: modules that add parts
    """

    prog: ClassVar[str] = "sb3-guard show"
    examples: ClassVar[str] = """examples:
  sb3-guard show Goal_Ant_8Ghosts
  sb3-guard show my_scenario.yml -o mine.png
  sb3-guard show Goal_Drone_8Hazards --env-kwargs "ghosts:{'num': 4}" --camera track
"""
    env: str = flag(positional=True)
    env_kwargs: dict[str, Any] | None = flag()
    output: str | None = flag("-o", metavar="FILE.png")
    camera: str | None = flag(choices=CAMERAS)
    window: bool = flag(default=False)
    seed: int = flag(default=0)
    gym_packages: list[str] = flag(default=[], metavar="MODULE")


def watch(flags: Flags) -> int:
    """Let a robot act at random in a window, until that is closed."""
    chosen = {"render_mode": "human", "camera": flags.camera, **(flags.env_kwargs or {})}
    with (
        explained("can't show it", ValueError, TypeError, RuntimeError),
        ExitStack() as last,
        suppress(KeyboardInterrupt),
    ):
        env = gymnasium.make(env_spec(flags.env), disable_env_checker=True, **chosen)
        last.callback(env.close)
        env.reset(seed=flags.seed)
        env.action_space.seed(flags.seed)
        while True:
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()
    return 0


def show(flags: Flags) -> int:
    """Print and draw an environment."""
    import_packages(flags.gym_packages)
    if flags.window:
        return watch(flags)
    file = Path(flags.env)
    with explained("can't show it", ValueError, TypeError, RuntimeError):
        spec = env_spec(flags.env)
        if "scenario" not in spec.kwargs:
            raise UsageError(
                f"{flags.env!r} is not an environment of sb3_guard's: see sb3-guard list"
            )
        kwargs: dict[str, Any] = {
            **spec.kwargs,
            "num_envs": 1,
            "render_mode": "rgb_array",
            "camera": flags.camera,
            "flatten": False,  # an image fits in no flat observation; the slices are the same
            **(flags.env_kwargs or {}),
        }
        env = GuardVectorEnv(**kwargs)
        env.begin([flags.seed])
    data = {key: value for key, value in env.scenario.to_dict().items() if value}
    print(yaml.safe_dump(data, sort_keys=False))
    print(observation_table(env), action_table(env), sep="\n\n")
    path = Path(flags.output) if flags.output else Path(f"{file.stem.removesuffix('-v0')}.png")
    with explained("no picture", RenderingError, OSError, ValueError):
        from matplotlib import image

        image.imsave(path, np.ascontiguousarray(env.frame(0)))
    print(f"\nwrote {path}")
    warning = unsteady(env)
    if warning is not None:
        print(f"warning: {warning}", file=sys.stderr)
    return 0


main = command(Flags, show)

if __name__ == "__main__":
    sys.exit(main())

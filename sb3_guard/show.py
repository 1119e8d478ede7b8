"""One environment in full: ``sb3-guard show Goal_Ant_8Ghosts`` prints it and writes a picture.

Or a robot's file, before it is registered: ``sb3-guard show go1.xml``.
"""

import re
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import yaml
from gymnasium.wrappers import Autoreset

from sb3_guard.envs import GuardVectorEnv, env_ids, env_spec
from sb3_guard.envs.check_part import unsteady
from sb3_guard.envs.registry import ROBOTS, robot_of_file
from sb3_guard.envs.rendering import RenderingError
from sb3_guard.list import summary
from sb3_guard.zoo.cli.flags import Command, command, flag
from sb3_guard.zoo.cli.markdown import table
from sb3_guard.zoo.cli.usage import UsageError, explained, import_packages
from sb3_guard.zoo.run.hyperparams import usual_limit


def observation_table(env: GuardVectorEnv) -> str:
    """Name, slice, bounds and unit of every component of the observation; joints one by one."""
    rows = []
    for name, start, stop, low, high, unit in env.components:
        where = str(start) if name.startswith(("qpos ", "qvel ")) else f"{start}:{stop}"
        rows.append([name, where, f"[{low:g}, {high:g}]", unit])
    if env.engine.extras.camera is not None:
        width, height = env.engine.extras.camera
        rows.append(["camera", f"image {height} × {width} × 3", "[0, 255]", "red, green, blue"])
    return table(["observation", "slice", "bounds", "unit"], rows)


def minutes(kwargs: Mapping[str, Any]) -> float:
    """Time that a million steps of random actions take here, in 30 environments, as in training."""
    with closing(GuardVectorEnv(**{**kwargs, "num_envs": 30})) as envs:
        envs.reset(seed=0)
        began = time.perf_counter()
        for _ in range(30):
            envs.step(envs.action_space.sample())
        return 1e6 / 60 * (time.perf_counter() - began) / 30**2


def action_table(env: GuardVectorEnv) -> str:
    """Index and actuator of every action, and which controls its least and greatest value set."""
    rows = [
        [
            str(i),
            actuator.name,
            f"[{actuator.low:g}, {actuator.high:g}]",
            "[{:g}, {:g}]".format(*actuator.control),
        ]
        for i, actuator in enumerate(env.actuators)
    ]
    return table(["action", "actuator", "range", "control"], rows)


def costs(env: GuardVectorEnv, env_id: str | None) -> Iterator[str]:
    """In words what costs, up to which limit if one is usual, and how long an episode is."""
    parts = env.engine.constraints
    for part in parts:
        yield f"info['cost_{part.name}']: {summary(type(part))}"
        yield f"    {part.per_step()}"
    how = "1 if any of these costs" if env.scenario.cost == "any" else "their sum"
    if len(parts) > 1:
        yield f"info['cost']: {how}."
    limit = usual_limit(env_id) if env_id in env_ids() else None
    if limit is not None and parts:
        yield f"Usual cost limit of an episode: {limit:g}."
    elif parts:
        yield "No cost limit is usual here: choose cost_limit."
    yield f"An episode has {env.max_episode_steps} steps of {env.engine.control_step:g} s."


@dataclass
class Flags(Command):
    """
    Print an environment's scenario, costs, observations and actions; write a picture.

    :param env: environment id, scenario file (.yml) or MJCF file of a robot (.xml)
    :param env_kwargs: arguments of the environment, e.g. "ghosts:{'num': 4}"
    :param robot_kwargs: arguments of register_robot, for a robot's MJCF file
    :param output: PNG file for the picture (default: <env>.png)
    :param camera: fixed, track, top, or a camera of the robot's file (default: fixed, or track
        where the robot runs far away)
    :param window: open MuJoCo's viewer with random actions instead: Space pauses, Tab opens menus,
        F shows contact forces
    :param seed: random seed of the episode in the picture (default: 0)
    :param gym_packages: modules to import first, which register parts
    """

    prog: ClassVar[str] = "sb3-guard show"
    examples: ClassVar[str] = """examples:
  sb3-guard show Goal_Ant_8Ghosts
  sb3-guard show my_scenario.yml -o mine.png
  sb3-guard show Goal_Drone_8Hazards --env-kwargs "ghosts:{'num': 4}" --camera track
  sb3-guard show go1.xml --robot-kwargs "root:'trunk'" "keyframe:'home'"
"""
    env: str = flag(default="", positional=True, nargs="?")
    env_kwargs: dict[str, Any] | None = flag()
    robot_kwargs: dict[str, Any] | None = flag()
    output: str | None = flag("-o", metavar="FILE.png")
    camera: str | None = flag(metavar="NAME")
    window: bool = flag(default=False)
    seed: int = flag(default=0)
    gym_packages: list[str] = flag(default=[], metavar="MODULE")


def watch(flags: Flags) -> int:
    """Let a robot act at random in a window, until that is closed."""
    chosen = {"render_mode": "human", "camera": flags.camera, **(flags.env_kwargs or {})}
    errors = ValueError, TypeError, RuntimeError
    with suppress(KeyboardInterrupt), explained("can't show it", *errors):
        env = gymnasium.make(env_spec(flags.env), disable_env_checker=True, **chosen)
        with closing(Autoreset(env)) as watched:
            watched.reset(seed=flags.seed)
            watched.action_space.seed(flags.seed)
            while True:
                watched.step(watched.action_space.sample())
    return 0


def show(flags: Flags) -> int:
    """Print and draw an environment."""
    if not flags.env and len(flags.gym_packages) < 2:
        raise UsageError("name an environment: sb3-guard show Goal_Ant_8Ghosts")
    flags.env = flags.env or flags.gym_packages.pop()  # which took what is behind it
    import_packages(flags.gym_packages)
    file = Path(flags.env)
    if file.suffix in (".xml", ".urdf"):
        stated = {**(flags.robot_kwargs or {})}
        name = re.sub(r"[^A-Za-z0-9]|^[0-9]+", "", file.stem).capitalize() or "Robot"
        if name.lower() in map(str.lower, ROBOTS):
            name += "File"
        with explained("can't show it", ValueError, TypeError, OSError):
            robot = robot_of_file(name, file, stated)
        ROBOTS[name] = robot  # for this process, also one that explodes: a warning says so
        flags.env = f"Goal_{name}_0Hazards"
        arguments = "".join(f", {key}={value!r}" for key, value in stated.items())
        print(f"sb3_guard.register_robot({name!r}, xml={str(file)!r}{arguments})\n")
        print(f"Left out of the file: {', '.join(robot.model_file().left_out) or 'nothing'}\n")
    elif flags.robot_kwargs:
        raise UsageError("--robot-kwargs goes with a robot's file: sb3-guard show go1.xml ...")
    if flags.window:
        return watch(flags)
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
        took = minutes(kwargs)
    data = {key: value for key, value in env.scenario.to_dict().items() if value}
    print(yaml.safe_dump(data, sort_keys=False))
    print(*costs(env, None if flags.env_kwargs else spec.id), "", sep="\n")
    print(observation_table(env), action_table(env), sep="\n\n")
    path = Path(flags.output) if flags.output else Path(f"{file.stem}.png")
    with explained("no picture", RenderingError, OSError, ValueError):
        from matplotlib import image

        image.imsave(path, np.ascontiguousarray(env.frame(0)))
    print(f"\nA million steps take {took:.1f} min on this machine, without learning.")
    print(f"wrote {path}")
    if (warning := unsteady(env.engine)) is not None:
        print(f"warning: {warning}", file=sys.stderr)
    return 0


main = command(Flags, show)

if __name__ == "__main__":
    sys.exit(main())

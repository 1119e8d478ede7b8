"""One environment in full: ``sb3-guard show Goal_Ant_8Ghosts`` prints it and writes a picture."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sb3_guard.envs import GuardVectorEnv, env_spec
from sb3_guard.envs.rendering import CAMERAS, RenderingError
from sb3_guard.spelling import did_you_mean
from sb3_guard.zoo.tables import table
from sb3_guard.zoo.usage import KeyValues, Parser, UsageError, import_packages, one_line, run

EXAMPLES = """examples:
  sb3-guard show Goal_Ant_8Ghosts
  sb3-guard show my_scenario.yml -o mine.png
  sb3-guard show Goal_Drone_8Hazards --env-kwargs "ghosts:{'num': 4}" --camera track
"""


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
        rows.append([str(i), name, "[-1, 1]", f"[{low:g}, {high:g}]"])
    return table(["action", "actuator", "range", "control"], rows)


def parser() -> Parser:
    """The flags."""
    result = Parser(
        prog="sb3-guard show",
        description="Print an environment's scenario, observations and actions; write a picture.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("env", help="an id of ours, or a scenario file (.yml)")
    result.add_argument(
        "--env-kwargs", nargs="+", action=KeyValues, metavar="KEY:VALUE", help="change parameters"
    )
    result.add_argument("-o", "--output", type=Path, help="picture to write (default: <env>.png)")
    result.add_argument("--camera", default="fixed", help=f"one of {', '.join(CAMERAS)}")
    result.add_argument("--seed", type=int, default=0, help="of the episode in the picture")
    result.add_argument("--gym-packages", nargs="+", default=[], help="modules that add parts")
    return result


def _show(argv: Sequence[str] | None) -> int:
    args = parser().parse_args(argv)
    import_packages(args.gym_packages)
    if args.camera not in CAMERAS:
        raise UsageError(f"unknown camera {args.camera!r}: {did_you_mean(args.camera, CAMERAS)}")
    file = Path(args.env)
    try:
        spec = env_spec(args.env)
        if "scenario" not in spec.kwargs:
            raise UsageError(
                f"{args.env!r} is not an environment of sb3_guard's: see sb3-guard list"
            )
        kwargs: dict[str, Any] = {
            **spec.kwargs,
            "num_envs": 1,
            "render_mode": "rgb_array",
            "camera": args.camera,
            "flatten": False,  # an image fits in no flat observation; the slices are the same
            **(args.env_kwargs or {}),
        }
        env = GuardVectorEnv(**kwargs)
        env.begin([args.seed])
    except (ValueError, TypeError, RuntimeError) as error:
        raise UsageError(one_line(error)) from None
    data = {key: value for key, value in env.scenario.to_dict().items() if value}
    print(yaml.safe_dump(data, sort_keys=False))
    print(observation_table(env), action_table(env), sep="\n\n")
    path = args.output or Path(f"{file.stem.removesuffix('-v0')}.png")
    try:
        frame = env.frame(0)
        from matplotlib import image

        image.imsave(path, np.ascontiguousarray(frame))
    except (RenderingError, OSError, ValueError) as error:
        raise UsageError(f"no picture: {one_line(error)}") from None
    print(f"\nwrote {path}")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param argv: arguments; None: those of the process
    :return: exit status: 0, or 2 for wrong usage
    """
    return run(lambda: _show(argv))


if __name__ == "__main__":
    sys.exit(main())

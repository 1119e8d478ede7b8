"""Play a trained agent: ``python -m sb3_guard.enjoy --algo cpo --env Goal_Point_8Hazards``."""

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any

from sb3_guard.zoo.usage import KeyValues, Parser, UsageError, positive, run

EXAMPLES = """examples:
  python -m sb3_guard.enjoy --pretrained
  python -m sb3_guard.enjoy --algo cpo --env Goal_Point_8Hazards -f logs
  python -m sb3_guard.enjoy --algo cpo --env Goal_Point_8Hazards --load-best --n-episodes 20
  python -m sb3_guard.enjoy --algo cpo --env Goal_Point_8Hazards --pretrained --record agent.mp4
"""

DEFAULTS: dict[str, Any] = {
    "algo": "cpo",
    "env": "Goal_Point_8Hazards-v0",
    "folder": "logs",
    "exp_id": 0,
    "pretrained": False,
    "load_best": False,
    "load_checkpoint": None,
    "load_last_checkpoint": False,
    "n_episodes": None,
    "n_timesteps": None,
    "stochastic": False,
    "deterministic": False,
    "seed": 0,
    "env_kwargs": None,
    "record": None,
    "json": None,
    "no_render": False,
    "device": "auto",
    "num_threads": -1,
    "gym_packages": [],
    "verbose": 1,
}


def parser() -> Parser:
    """The flags, RL-Zoo's where it has them. What is not given is absent from the result."""
    result = Parser(
        prog="sb3-guard enjoy",
        description="Play a trained agent and print return and cost of each episode.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    which = result.add_argument_group("which agent")
    which.add_argument("--algo", help="algorithm (default: cpo)")
    which.add_argument("--env", help="environment id (default: Goal_Point_8Hazards)")
    which.add_argument("-f", "--folder", metavar="DIR", help="log folder (default: logs)")
    which.add_argument(
        "--exp-id",
        type=int,
        metavar="K",
        help="number of the run; 0: the latest, -1: the folder itself (default: 0)",
    )
    model = which.add_mutually_exclusive_group()
    model.add_argument("--load-best", action="store_true", help="the best model, safe first")
    model.add_argument(
        "--pretrained", action="store_true", help="an agent that comes with the package"
    )
    model.add_argument(
        "--load-checkpoint", type=positive, metavar="STEPS", help="the model kept at so many steps"
    )
    model.add_argument(
        "--load-last-checkpoint", action="store_true", help="the last model that was kept"
    )

    play = result.add_argument_group("what is played")
    length = play.add_mutually_exclusive_group()
    length.add_argument(
        "--n-episodes", type=positive, metavar="N", help="episodes (default: 5, or 1 to record)"
    )
    length.add_argument("-n", "--n-timesteps", type=positive, metavar="N", help="steps instead")
    actions = play.add_mutually_exclusive_group()
    actions.add_argument(
        "--deterministic", action="store_true", help="the most likely actions (the default)"
    )
    actions.add_argument("--stochastic", action="store_true", help="sampled actions")
    play.add_argument("--seed", type=int, help="seed of the episodes (default: 0)")
    play.add_argument(
        "--env-kwargs",
        nargs="+",
        action=KeyValues,
        metavar="KEY:VALUE",
        help="arguments of the environment, over those of training",
    )
    play.add_argument(
        "--gym-packages",
        nargs="+",
        metavar="MODULE",
        help="modules to import first (default: those of training)",
    )

    output = result.add_argument_group("output")
    output.add_argument(
        "--record",
        nargs="?",
        const="",
        metavar="FILE.mp4",
        help="write a video; no display is needed (default: beside the model; of a pretrained "
        "agent in the current folder)",
    )
    output.add_argument("--json", metavar="FILE", help="write the statistics there as JSON")
    output.add_argument("--no-render", action="store_true", help="open no window")
    output.add_argument("--device", help="torch device (default: auto)")
    output.add_argument("--num-threads", type=int, metavar="N", help="threads of torch")
    output.add_argument("--verbose", type=int, choices=[0, 1], help="0: the means only")
    return result


def _has_display() -> bool:
    return sys.platform != "linux" or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )


def _enjoy(argv: Sequence[str] | None) -> int:
    given = vars(parser().parse_args(argv))
    args = {**DEFAULTS, **given}
    if args["pretrained"] and given.keys() & {"folder", "exp_id"}:
        raise UsageError(
            "--pretrained plays an agent that comes with the package: leave out --folder and "
            "--exp-id, or leave out --pretrained to play a run of your own"
        )
    if not 0 <= args["seed"] < 2**32:
        raise UsageError(f"--seed {args['seed']} is not allowed; it must be from 0 to 2**32 - 1")
    render_mode = "rgb_array" if args["record"] is not None else None
    if render_mode is None and not args["no_render"]:
        if _has_display():
            render_mode = "human"
        else:
            print("There is no display: nothing is shown. --record makes a video.", file=sys.stderr)

    from sb3_guard.zoo.playback import play

    return play(args, render_mode)


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param argv: arguments; None: those of the process
    :return: exit status: 0, or 2 for wrong usage
    """
    return run(lambda: _enjoy(argv))


if __name__ == "__main__":
    sys.exit(main())

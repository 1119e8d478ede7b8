"""Share trained agents on the Hugging Face hub: ``python -m sb3_guard.hub push --algo cpo …``."""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

from sb3_guard.enjoy import DEFAULTS as ENJOY
from sb3_guard.zoo.usage import Parser, UsageError, positive, run

EXAMPLES = """examples:
  sb3-guard hub push --algo cpo --env Goal_Point_8Hazards -f logs -orga me
  sb3-guard hub push --algo cpo --env Goal_Point_8Hazards -orga me --dry-run --to card
  sb3-guard hub load --algo cpo --env Goal_Point_8Hazards -orga me -f logs
"""

DEFAULTS: dict[str, Any] = {
    **ENJOY,
    "n_episodes": 10,
    "organization": None,
    "repo_name": None,
    "repo_id": None,
    "commit_message": "Upload a trained agent",
    "private": False,
    "no_video": False,
    "dry_run": False,
    "folder_on_disk": None,
}


def parser() -> Parser:
    """The flags, RL-Zoo's where it has them. What is not given is absent from the result."""
    result = Parser(
        prog="sb3-guard hub",
        description="Upload a trained agent to the Hugging Face hub, or download one. "
        "Downloaded agents are programs: load only from people you trust.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    result.add_argument("direction", choices=["push", "load"])
    result.add_argument("--algo", help="algorithm (default: cpo)")
    result.add_argument("--env", help="environment id (default: Goal_Point_8Hazards)")
    result.add_argument("-f", "--folder", metavar="DIR", help="log folder (default: logs)")
    result.add_argument("-orga", "--organization", metavar="NAME", help="user or organization")
    result.add_argument(
        "-name", "--repo-name", metavar="NAME", help="repository (default: <algo>-<env>)"
    )
    result.add_argument("--repo-id", metavar="USER/NAME", help="both in one")
    push = result.add_argument_group("push")
    push.add_argument("--exp-id", type=int, metavar="K", help="number of the run (default: latest)")
    push.add_argument("--load-best", action="store_true", help="the best model, safe first")
    push.add_argument(
        "--n-episodes", type=positive, metavar="N", help="episodes for the card (default: 10)"
    )
    push.add_argument("--stochastic", action="store_true", help="sampled actions")
    push.add_argument("--seed", type=int, help="seed of the episodes (default: 0)")
    push.add_argument("-m", "--commit-message", metavar="TEXT")
    push.add_argument("--private", action="store_true", help="make the repository private")
    push.add_argument("--no-video", action="store_true", help="do not film an episode")
    push.add_argument("--dry-run", action="store_true", help="write all files, upload nothing")
    push.add_argument(
        "--to", dest="folder_on_disk", metavar="DIR", help="where the files are written first"
    )
    push.add_argument("--gym-packages", nargs="+", metavar="MODULE", help="modules to import first")
    return result


def _hub(argv: Sequence[str] | None) -> int:
    args = {**DEFAULTS, **vars(parser().parse_args(argv))}
    if args["repo_id"] is not None:
        organization, slash, name = args["repo_id"].partition("/")
        if not (organization and slash and name) or "/" in name:
            raise UsageError(f"--repo-id {args['repo_id']!r} must be of the form user/name")
        args["organization"], args["repo_name"] = organization, name
    elif args["organization"] is None:
        raise UsageError("whose repository? give -orga NAME, or --repo-id user/name")

    from sb3_guard.zoo import hub
    from sb3_guard.zoo.environments import canonical_id

    args["env"] = canonical_id(args["env"])[0] if not args["gym_packages"] else args["env"]
    return hub.push(args) if args["direction"] == "push" else hub.load(args)


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param argv: arguments; None: those of the process
    :return: exit status: 0, or 2 for wrong usage or an unreachable hub
    """
    return run(lambda: _hub(argv))


if __name__ == "__main__":
    sys.exit(main())

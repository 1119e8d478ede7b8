"""``sb3-guard <command>``: the same commands as ``python -m`` with the command's module."""

import importlib
import sys
from collections.abc import Sequence

from sb3_guard.fields import did_you_mean

COMMANDS = {
    "train": "train an agent",
    "tune": "search hyperparameters under a cost limit",
    "benchmark": "train a grid of environments, algorithms and seeds",
    "reproduce": "train a row of the leaderboard again and compare",
    "enjoy": "play a trained agent, print return and cost, record a video",
    "certify": "say whether a trained agent keeps its limit, by fresh episodes",
    "export": "write a trained agent as one ONNX file",
    "plot": "make tables, figures and a page of trained runs",
    "hub": "write a trained agent and its card for the Hugging Face hub",
    "list": "print environments, robots, tasks, constraints and pretrained agents",
    "show": "describe an environment and draw it",
}


def module_of(command: str) -> str:
    """The module of a command; functions of the package are called like two of the commands."""
    return f"sb3_guard.{command}{'_agent' if command in ('certify', 'export') else ''}"


def _usage() -> str:
    rows = "\n".join(f"  {name:<10} {text}" for name, text in COMMANDS.items())
    return f"usage: sb3-guard <command> ...\n\n{rows}\n\nsb3-guard <command> --help lists its flags"


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a command; its module is imported only then.

    :param argv: arguments; None: those of the process
    :return: exit status
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage())
        return 0
    name, *rest = arguments
    if name == "--version":
        from sb3_guard import __version__

        print(__version__)
        return 0
    if name not in COMMANDS:
        print(f"error: unknown command {name!r}; {did_you_mean(name, COMMANDS)}", file=sys.stderr)
        return 2
    try:
        return importlib.import_module(module_of(name)).main(rest)
    except KeyboardInterrupt:  # while it is imported
        return 130


if __name__ == "__main__":
    sys.exit(main())

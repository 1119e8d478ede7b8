"""Flags that complete in the shell: ``eval "$(sb3-guard completion bash)"``."""

import argparse
import importlib
import sys
from collections.abc import Sequence

from sb3_guard.zoo.usage import Parser, UsageError, run

EXAMPLES = """examples:
  eval "$(sb3-guard completion bash)"
  sb3-guard completion zsh > ~/.zfunc/_sb3-guard
"""
SHELLS = ["bash", "zsh", "tcsh"]


def parser() -> Parser:
    """The flags."""
    result = Parser(
        prog="sb3-guard completion",
        description="Print a script that completes commands, flags, algorithms and suites.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("shell", choices=SHELLS)
    return result


def whole() -> argparse.ArgumentParser:
    """One parser of all commands, which knows the values of ``--algo`` and ``--env``."""
    from sb3_guard.cli import COMMANDS
    from sb3_guard.envs import env_ids
    from sb3_guard.zoo.algos import baselines, safe_algorithms

    algos = [*safe_algorithms(), *baselines()]
    known = {"algo": algos, "algos": algos, "env": env_ids(), "suites": env_ids()}
    result = argparse.ArgumentParser(prog="sb3-guard")
    commands = result.add_subparsers()
    for name, text in COMMANDS.items():
        own = importlib.import_module(f"sb3_guard.{name}").parser()
        for action in own._actions:
            if action.dest in known and action.choices is None:
                action.choices = known[action.dest]
        commands.add_parser(name, help=text, parents=[own], add_help=False)
    return result


def _completion(argv: Sequence[str] | None) -> int:
    args = parser().parse_args(argv)
    try:
        import shtab
    except ImportError:
        raise UsageError(
            "completion needs shtab; install it with: pip install 'sb3-guard[completion]'"
        ) from None
    print(shtab.complete(whole(), args.shell))
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param argv: arguments; None: those of the process
    :return: exit status: 0, or 2 for wrong usage
    """
    return run(lambda: _completion(argv))


if __name__ == "__main__":
    sys.exit(main())

"""Flags that complete in the shell: ``eval "$(sb3-guard completion bash)"``."""

import argparse
import importlib
import sys
from dataclasses import dataclass
from typing import ClassVar, Literal

from sb3_guard.zoo.flags import Command, command, flag
from sb3_guard.zoo.usage import explained


@dataclass
class Flags(Command):
    """
    Print a script that completes commands, flags, algorithms and suites.

    :param shell: whose script
    """

    prog: ClassVar[str] = "sb3-guard completion"
    examples: ClassVar[str] = """examples:
  eval "$(sb3-guard completion bash)"
  sb3-guard completion zsh > ~/.zfunc/_sb3-guard
"""
    shell: Literal["bash", "zsh", "tcsh"] = flag(positional=True)


def whole() -> argparse.ArgumentParser:
    """One parser of all commands, which knows the values of ``--algo`` and ``--env``."""
    from sb3_guard.cli import COMMANDS
    from sb3_guard.envs import env_ids
    from sb3_guard.zoo.algos import ALGORITHMS, baselines

    algos = [*ALGORITHMS, *baselines()]
    known = {"algo": algos, "algos": algos, "env": env_ids(), "suites": env_ids()}
    result = argparse.ArgumentParser(prog="sb3-guard")
    commands = result.add_subparsers()
    for name, text in COMMANDS.items():
        own = importlib.import_module(f"sb3_guard.{name}").main.flags.parser()
        for action in own._actions:
            if action.dest in known and action.choices is None:
                action.choices = known[action.dest]
        commands.add_parser(name, help=text, parents=[own], add_help=False)
    return result


def completion(flags: Flags) -> int:
    """Print the script."""
    fix = "install it with: pip install 'sb3-guard[completion]'"
    with explained("completion needs shtab", ImportError, fix=fix):
        import shtab
    print(shtab.complete(whole(), flags.shell))
    return 0


main = command(Flags, completion)

if __name__ == "__main__":
    sys.exit(main())

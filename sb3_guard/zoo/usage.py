"""What a command says when it can't do what was asked: one line, exit status 2, no traceback."""

import argparse
import difflib
import errno
import importlib
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

from sb3_guard.zoo.values import parse_value

LONGEST = 500  # characters of an error that are printed


class UsageError(Exception):
    """Something the user can put right; the message names the value, what is allowed, the fix."""


class ForeignError(UsageError):
    """Code of the user's raised its cause, whose traceback is printed below the message."""


def one_line(error: BaseException) -> str:
    """An exception's message on one line, its type where the message alone says too little."""
    text = " ".join(str(error).split())
    if isinstance(error, (UsageError, ValueError)) and text:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def import_packages(names: Sequence[str]) -> None:
    """
    Import modules that register environments (``--gym-packages``), the current folder's too.

    :raises UsageError: one can't be imported
    """
    if names and os.getcwd() not in sys.path:  # as with python -m, also for the script sb3-guard
        sys.path.insert(0, os.getcwd())
    for name in names:
        try:
            importlib.import_module(name)
        except (ImportError, TypeError, ValueError) as error:
            if not re.fullmatch(r"\w+(\.\w+)*", name):
                raise UsageError(
                    f"--gym-packages: {name!r} is no module's name; it must be like my_envs or "
                    "package.my_envs, importable from the current folder"
                ) from None
            if not isinstance(error, ImportError):
                raise  # from within the module
            raise UsageError(f"--gym-packages: can't import {name!r}: {one_line(error)}") from error


class Parser(argparse.ArgumentParser):
    """An argument parser that raises :class:`UsageError` and knows which flag was meant."""

    def __init__(self, *args: Any, **kwargs: Any):
        kwargs.setdefault("allow_abbrev", False)
        super().__init__(*args, **kwargs)

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing the usage, which would bury the message."""
        unknown = re.match(r"unrecognized arguments: (-\S+)", message)
        if unknown:
            flag = unknown[1].split("=")[0]
            flags = [one for one in self._option_string_actions if one.startswith("--")]
            near = difflib.get_close_matches(flag, flags, n=1)
            hint = f"did you mean {near[0]}?" if near else "see --help"
            raise UsageError(f"unknown flag {flag}; {hint}")
        extra = re.match(r"unrecognized arguments: (\S+)", message)
        if extra:
            raise UsageError(f"{extra[1]!r} belongs to no flag; see --help")
        raise UsageError(" ".join(message.split()))


def run(command: Callable[[], int]) -> int:
    """
    Run a command and turn what the user can put right into one line on stderr.

    :return: the exit status: the command's own, 130 for Ctrl-C, 141 if nobody reads its output any
        longer (``| head``), 2 for a :class:`UsageError` or a package that does not import
    """
    # OpenMP's idle threads spin by default: on a machine shared with other work, torch's threads
    # then wait for one another's time slices and training is ten times slower. Read when torch is
    # imported, which the commands do later.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # "±" on a terminal that is not UTF-8 becomes "?"
            stream.reconfigure(errors="replace")
    try:
        status = command()
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at exit
        return 141
    except (UsageError, ImportError, OSError) as error:
        # an absent package, or no backend for MuJoCo; a name too long, no room where output goes
        if isinstance(error, OSError) and error.errno not in (errno.ENAMETOOLONG, errno.ENOSPC):
            raise
        text = one_line(error)
        print(f"error: {text if len(text) <= LONGEST else text[:LONGEST] + ' …'}", file=sys.stderr)
        if isinstance(error, ForeignError):
            traceback.print_exception(error.__cause__)
        return 2
    except KeyboardInterrupt:
        return 130


@contextmanager
def interrupts(stop: Callable[[int], None]) -> Iterator[list[int]]:
    """
    Let Ctrl-C and SIGTERM ask for an end in good order; a second one ends at once.

    :param stop: called with the number of the first signal, between two steps of whatever runs
    :return: the numbers of the signals received
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    def handle(number: int, frame: Any) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt
        stop(number)

    before = {one: signal.signal(one, handle) for one in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def steps(text: str) -> int:
    """A number of steps: ``300000``, ``3e5``."""
    try:
        value = float(text)
    except ValueError:
        value = 0.5
    if not value.is_integer():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, such as 300000 or 3e5")
    return int(value)


def positive(text: str) -> int:
    """A number of at least 1, ``3e5`` allowed."""
    value = steps(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; it must be at least 1")
    return value


def parse_pairs(pairs: Sequence[str], what: str = "key:value") -> dict[str, Any]:
    """
    The mapping that ``["n_steps:512", "cost_limit:25.0"]`` stands for.

    :param what: what it is given to, for the message
    :raises UsageError: one has no colon
    """
    values = {}
    for pair in pairs:
        key, colon, value = str(pair).partition(":")
        if not colon or not key:
            raise UsageError(f"{what}: {pair!r} is not of the form key:value")
        values[key] = parse_value(value)
    return values


class KeyValues(argparse.Action):
    """
    ``key:value`` pairs, as RL-Zoo takes them: ``-params n_steps:512 cost_limit:25.0``.

    The flag may be repeated; what comes later wins.
    """

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Add the pairs to the dictionary; a pair without a colon is an error."""
        before = getattr(namespace, self.dest, None) or {}
        pairs = parse_pairs(values, option_string or self.dest)
        setattr(namespace, self.dest, {**before, **pairs})

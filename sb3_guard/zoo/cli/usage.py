"""What a command says when it can't do what was asked: one line, exit status 2, no traceback."""

import importlib
import os
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from sb3_guard.fields import load_yaml


class UsageError(Exception):
    """Something the user can put right; the message names the value, what is allowed, the fix."""

    status = 2  # the exit status of the command


class TrainingStopped(UsageError):
    """A reward, cost, observation or loss is not a number, or an episode can't begin."""

    status = 1


def one_line(error: BaseException) -> str:
    """An exception's message on one line, its type where the message alone says too little."""
    text = " ".join(str(error).split())
    if isinstance(error, (UsageError, ValueError)) and text:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


@contextmanager
def explained(what: str, *errors: type[BaseException], fix: str = "") -> Iterator[None]:
    """
    Say in one line what a block could not do, why, and how to mend it.

    :param what: what it could not do, e.g. ``can't read x.yml``
    :param errors: the errors meant; none: all, where the code is a user's
    :raises UsageError: instead of them
    """
    try:
        yield
    except UsageError:
        raise
    except Exception as error:
        if errors and not isinstance(error, errors):
            raise
        why = getattr(error, "strerror", None) or one_line(error)
        raise UsageError(f"{what}: {why}" + (fix and f"; {fix}")) from error


def read_mapping(path: str | Path, what: str, form: str) -> dict[Any, Any]:
    """
    The plain data of a YAML file.

    :param what: what the file is, for the message
    :param form: what it must be, for the message
    :raises UsageError: it can't be read, or is not a mapping
    """
    with explained(f"can't read {what} {path}", OSError, ValueError, TypeError, yaml.YAMLError):
        content = load_yaml(Path(path).read_bytes().decode())
    if not isinstance(content, dict):
        raise UsageError(f"{what} {path} is damaged: it must map {form}")
    return content


def import_packages(names: Sequence[str]) -> None:
    """
    Import modules that register environments (``--gym-packages``), the current folder's too.

    :raises UsageError: one can't be imported
    """
    if names and os.getcwd() not in sys.path:  # as with python -m, also for the script sb3-guard
        sys.path.insert(0, os.getcwd())
    for name in names:
        fix = (
            "name a module that Python can import, such as my_robots in the folder of my_robots.py"
        )
        with explained(f"--gym-packages: can't import {name!r}", fix=fix):
            importlib.import_module(name)


def packages_flag(modules: Sequence[str]) -> str:
    """The flag that names modules, for a command that is printed; empty: there are none."""
    return f" --gym-packages {shlex.join(map(str, modules))}" if modules else ""


def run(command: Callable[[], int]) -> int:
    """
    Run a command and turn what the user can put right into one line on stderr.

    :return: the exit status: the command's own, 130 for Ctrl-C, that of a :class:`UsageError`, 2
        for a package that does not import and a file that can't be written
    """
    # OpenMP's idle threads spin by default: on a machine shared with other work, torch's threads
    # then wait for one another's time slices and training is ten times slower. Read when torch is
    # imported, which the commands do later.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # "±" on a terminal that is not UTF-8 becomes "?"
            stream.reconfigure(errors="replace")
    warnings.formatwarning = lambda message, *_, **__: (
        f"warning: {' '.join(str(message).split())}\n"
    )
    try:
        status = command()
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # `list | head` has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 141  # as a process that SIGPIPE ends, which Windows has not
    except (UsageError, ImportError, OSError) as error:  # an absent package, a full disk
        print(f"error: {one_line(error)}", file=sys.stderr)
        return getattr(error, "status", 2)
    except KeyboardInterrupt:
        return 130


@contextmanager
def interrupts(stop: Callable[[int], None]) -> Iterator[list[int]]:
    """
    Let Ctrl-C and SIGTERM ask for an end in good order; Ctrl-C after that ends immediately.

    Another SIGTERM changes nothing: ``timeout`` and batch systems may send two at once. A signal
    that the process ignores, as workers do, is left alone.

    :param stop: called with the number of the first signal, between two steps of whatever runs
    :return: the numbers of the signals received
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    def handle(number: int, frame: Any) -> None:
        received.append(number)
        if len(received) == 1:
            stop(number)
        elif number == signal.SIGINT:
            raise KeyboardInterrupt

    before = {
        number: signal.signal(number, handle)
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

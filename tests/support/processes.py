"""Commands run as processes of their own that need not import everything again."""

import multiprocessing
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from subprocess import Popen
from typing import Any


def fresh(command: Callable[[list[str]], int], arguments: list[str], output: Path) -> BaseProcess:
    """
    Run a command in a process that has none of this one's threads, locks and memory.

    A fork of a process that has trained may find locks taken that nobody will give back, and Linux
    refuses it where memory that was reserved but never used is larger than the machine's.

    :param command: a function of a module, imported there
    :param output: where its standard output and errors go
    """
    output.touch()
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["sb3_guard.zoo.tuning.search"])
    process = context.Process(target=_run, args=(command, arguments, output))
    process.start()
    return process


def _run(command: Callable[[list[str]], int], arguments: list[str], output: Path) -> None:
    with open(output, "w", buffering=1) as handle:
        sys.stdout = sys.stderr = handle
        sys.exit(command(arguments))


def wait_for(
    condition: Callable[[], bool], seconds: float = 60.0, process: Popen[Any] | None = None
) -> None:
    """Wait until something is true, which it must be in time, and before ``process`` ends."""
    end = time.monotonic() + seconds
    while not condition():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)

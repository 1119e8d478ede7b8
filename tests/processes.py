"""Commands run as processes of their own that need not import everything again."""

import gc
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path


def fork(command: Callable[[list[str]], int], arguments: list[str], output: Path) -> int:
    """
    Run a command in a child process that has all of this one's patches; it must not train.

    :param output: where its standard output and errors go
    :return: the child's process id
    """
    output.touch()
    gc.collect()  # replay buffers of earlier tests, which the child's memory would have to hold too
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        with open(output, "w", buffering=1) as handle:
            sys.stdout = sys.stderr = handle
            status = command(arguments)
    finally:
        os._exit(status)


def fresh(command: Callable[[list[str]], int], arguments: list[str], output: Path) -> BaseProcess:
    """
    Run a command in a process that has none of this one's threads and locks.

    A fork of a process that has trained may find locks taken that nobody will give back.

    :param command: a function of a module, imported there
    :param output: where its standard output and errors go
    """
    output.touch()
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["sb3_guard.zoo.tuning"])
    process = context.Process(target=_run, args=(command, arguments, output))
    process.start()
    return process


def _run(command: Callable[[list[str]], int], arguments: list[str], output: Path) -> None:
    with open(output, "w", buffering=1) as handle:
        sys.stdout = sys.stderr = handle
        sys.exit(command(arguments))


def join(pid: int, seconds: float = 120.0) -> int:
    """The exit status of a child, negative for a signal."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    raise AssertionError(f"process {pid} did not end")


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait until something is true, which it must be in time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)

"""One run of a grid in a process of its own, whoever starts it: this machine or a Dask worker.

A process each, because random generators and thread counts are global to a process, and because
what kills a run (memory, a fault in a library) must not reach its neighbours. The process holds the
run's lock, and ends when whoever started it ends.
"""

import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from sb3_guard.zoo.run_folder import RunInUse, is_disk_error, run_path
from sb3_guard.zoo.usage import UsageError

IN_USE, NO_DISK = 75, 74  # exit statuses, as in sysexits.h
LINES = 200  # of a process's last words that are kept
ONE_THREAD = {
    name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
} | {"OMP_WAIT_POLICY": "PASSIVE"}

_processes: set[subprocess.Popen[bytes]] = set()


@dataclass(frozen=True)
class Task:
    """
    What a worker is told: the arguments of :func:`~sb3_guard.zoo.experiment.complete`.

    :param attempt: how often this grid has tried the run, this time included
    """

    args: dict[str, Any]
    values: dict[str, Any]
    number: int
    command: str
    permit: Path
    attempt: int

    @property
    def path(self) -> Path:
        """The run's folder."""
        return run_path(self.args["log_folder"], self.args["algo"], self.args["env"], self.number)

    @property
    def name(self) -> str:
        """What the run's lock says while this attempt is under way."""
        return f"{self.permit.name} {self.attempt}"


class Outcome(NamedTuple):
    """
    How an attempt ended.

    :param state: ``done``, ``failed``, ``stopped`` as it was asked to, ``in use`` by another
        process, or ``no disk``: full, read-only or broken
    :param text: last words if it failed: the traceback
    """

    state: str
    text: str = ""


def last_line(text: str) -> str:
    """The last of a failure's words: what went wrong, after the traceback that says where."""
    lines = text.strip().splitlines() or ["without a word"]
    return lines[-1].removeprefix(f"{UsageError.__module__}.{UsageError.__name__}: ")


def work(task: Task) -> Outcome:
    """
    Complete a run in a new process; failures are also written to the run's ``error.txt``.

    Called in a thread, of this process or of a Dask worker.
    """
    if not task.permit.exists():
        return Outcome("stopped")
    paths = os.pathsep.join(path for path in sys.path if path)
    process = subprocess.Popen(
        [sys.executable, "-m", "sb3_guard.zoo.worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env={**os.environ, **ONE_THREAD, "PYTHONPATH": paths},
        # Ctrl-C in a terminal reaches the grid only, which takes its runs' permit away.
        start_new_session=True,
    )
    assert process.stdin is not None and process.stdout is not None
    _processes.add(process)
    try:
        with suppress(BrokenPipeError):
            process.stdin.write(pickle.dumps(task))
            process.stdin.flush()
        # The pipe stays open: that it closes is how the process learns that we are gone.
        words = b"".join(deque(process.stdout, maxlen=LINES)).decode(errors="replace").strip()
        status = process.wait()
    finally:
        _processes.discard(process)
        with suppress(BrokenPipeError):
            process.stdin.close()
        process.stdout.close()
    if status == 0:
        return Outcome("done")
    if status == IN_USE:
        return Outcome("in use", words)
    if status == NO_DISK:
        return Outcome("no disk", words)
    if not task.permit.exists():
        return Outcome("stopped", words)
    text = "\n".join(filter(None, [words, _ending(status)]))
    _record(task, text)
    return Outcome("failed", text)


def looks(path: Path) -> tuple[str, bool]:
    """The version of the package that a worker has, and whether it sees a file."""
    from sb3_guard import __version__

    return __version__, path.exists()


def kill_all() -> None:
    """Kill the processes that :func:`work` has started here, at once."""
    for process in list(_processes):
        process.kill()


def _ending(status: int) -> str:
    """What an exit status says that the process itself did not."""
    if status == 1:
        return ""
    number = -status if status < 0 else status - 128
    try:
        name = signal.Signals(number).name
    except ValueError:
        return f"The process ended with status {status}."
    memory = "; the system does that when memory runs out" if name == "SIGKILL" else ""
    return f"The process was ended by {name}{memory}."


def _record(task: Task, text: str) -> None:
    now = time.strftime("%Y-%m-%d %H:%M:%S")
    # The grid's summary says it too, so a record that can't be written is no second failure.
    with suppress(OSError), open(task.path / "error.txt", "a") as file:
        file.write(f"--- {now}, {socket.gethostname()}, attempt {task.attempt}\n{text}\n")


def _end_with_parent() -> None:
    # The system's own read: one of Python's would hold a lock that the interpreter's end needs.
    while os.read(sys.stdin.fileno(), 1):
        pass
    os._exit(1)


def main() -> int:
    """Read a task from stdin and complete its run."""
    task: Task = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        from sb3_guard.zoo.experiment import complete

        return complete(task.args, task.values, task.number, task.command, task.permit, task.name)
    except RunInUse as error:
        print(error)
        return IN_USE
    except Exception as error:
        traceback.print_exc()
        return NO_DISK if is_disk_error(error) else 1


if __name__ == "__main__":
    sys.exit(main())

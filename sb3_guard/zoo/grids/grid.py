"""A grid of training runs, environments × algorithms × seeds: checked in full, then carried out.

A run of a grid is a training run like any other, in ``<folder>/<algo>/<env>_<seed + 1>/``, so it is
played, plotted and resumed like any other. An executor of :mod:`concurrent.futures` carries the
runs out, here or on a Dask cluster, and all that matters is in the run folders: the lock says that
a run is under way, ``result.json``, written last, that it is done. So a grid can be killed and
started again anywhere.
"""

import gc
import multiprocessing
import os
import shlex
import signal
import socket
import sys
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sb3_guard.fields import did_you_mean
from sb3_guard.zoo.cli.usage import UsageError, explained, interrupts, one_line
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder, RunInUse
from sb3_guard.zoo.run.hyperparams import annotations
from sb3_guard.zoo.run.run import Run


@dataclass(eq=False)
class GridRun(Run):
    """
    One run of a grid.

    :param state: at first ``done``, ``resume`` or ``new``; then as :func:`carry_out` returns it
    :param error: what went wrong, in a line
    """

    state: str = ""
    error: str = ""

    @property
    def steps(self) -> int:
        """Its length, environment steps."""
        return int(self.hyperparams["n_timesteps"])

    def __str__(self) -> str:
        return f"{self.flags.algo} on {self.flags.env}, seed {self.flags.seed}"

    def outcome(self) -> str:
        """What has become of the run, in a line."""
        line = f"{self.state}: {self}"
        result = (RunFolder(self.path).read_result() or {}) if self.state == "done" else {}
        if result.get("return") is not None:
            line += f", return {result['return']:.2f}, cost {result['cost']:.2f}"
        return f"{line}: {self.error}" if self.error else line


def summary(runs: Sequence[GridRun]) -> str:
    """The grid on one line: how many runs are in which state."""
    counts = Counter(run.state for run in runs)
    others = [f"{n} {state}" for state, n in counts.items() if state != "done"]
    return ", ".join([f"{counts['done']} of {len(runs)} done", *others])


def expand(
    pairs: Sequence[tuple[str, str]],
    seeds: Sequence[int],
    flags: RunFlags,
    scale: float = 1.0,
) -> list[GridRun]:
    """
    The runs of a grid, checked, and how far they are; those of the first seed come first.

    A hyperparameter given for the whole grid is passed to the algorithms that have it.

    :param pairs: environments and algorithms
    :param seeds: at least 0
    :param flags: what all runs share
    :param scale: factor of every run's length
    :raises UsageError: a name or value is wrong for any of the runs, or a folder holds another run
        than the one that belongs there
    """
    given = flags.hyperparams or {}
    taken = {algo: annotations(algorithm(algo)) for _, algo in pairs}
    names = sorted(set[str]().union(*taken.values()))
    for name in given.keys() - names:
        hint = did_you_mean(name, names)
        raise UsageError(f"none of the algorithms has a hyperparameter {name!r}; {hint}")
    first: dict[tuple[str, str], Run] = {}
    flags = replace(flags, progress=False, num_threads=max(flags.num_threads, 1))
    for env_id, algo in pairs:
        hyperparams = {name: value for name, value in given.items() if name in taken[algo]}
        run = Run.check(
            replace(flags, env=env_id, algo=algo, seed=0, hyperparams=hyperparams or None)
        )
        if ignored := given.keys() - hyperparams.keys():
            warnings.warn(f"{algo} has no {', '.join(ignored)}: left out there", stacklevel=2)
        steps = max(round(run.hyperparams["n_timesteps"] * scale), 1)
        run.flags.n_timesteps = run.hyperparams["n_timesteps"] = steps
        first[run.flags.env, algo] = run
    runs = [
        GridRun(replace(run.flags, seed=seed), run.hyperparams)
        for seed in dict.fromkeys(seeds)
        for run in first.values()
    ]
    for run in runs:
        run.state = run.standing()
    return runs


# In a worker

_one_at_a_time = threading.Lock()  # random generators and thread counts belong to the process


def carry_out(run: GridRun, command: str, stop: Path) -> tuple[str, str]:
    """
    Complete a run; what goes wrong is also written to ``error.txt`` in its folder.

    :param command: the command line, for the run folder
    :param stop: a file; once it is there, the run ends after the rollout under way
    :return: the state it is left in, ``done``, ``stopped``, ``failed``, ``waiting`` if it did not
        begin, or ``in use`` by another process; and what went wrong
    """
    if not stop.parent.is_dir():
        return "failed", f"{socket.gethostname()} does not see the folder {stop.parent}"
    with _one_at_a_time:
        if stop.exists():
            return "waiting", ""
        gc.collect()  # the run before: a model refers to itself, and Python seldom looks for that
        error_file = run.path / "error.txt"
        try:
            error_file.unlink(missing_ok=True)
            status = run.complete(command, stop.exists)
        except RunInUse as error:
            return "in use", one_line(error)
        except Exception as error:
            # The grid's summary says it too, so a record that can't be written is no failure.
            with suppress(OSError):
                error_file.write_text(traceback.format_exc(), encoding="utf-8")
            return "failed", one_line(error)
    return "stopped" if status else "done", ""


def _begin_worker() -> None:
    """Let a process of this machine's pool end when the grid's process does, however that ends."""
    warnings.simplefilter("ignore")  # which the process that checked the grid has shown
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is for the grid's process
    # A batch system sends it to all processes, and the file asks the runs to stop. It is not
    # ignored, as processes of environments, which are ended by it, would inherit that.
    signal.signal(signal.SIGTERM, lambda number, frame: None)
    grid = multiprocessing.parent_process()
    assert grid is not None

    def end_with(grid: Any) -> None:
        grid.join()
        os._exit(1)

    threading.Thread(target=end_with, args=(grid,), daemon=True).start()


# Executors

ASK_AGAIN = 2.0  # seconds between questions after runs that another process has


@contextmanager
def processes(number: int) -> Iterator[Executor]:
    """Processes of this machine; they are killed when the block is left by an exception."""
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(number, mp_context=context, initializer=_begin_worker)
    try:
        yield pool
    except BaseException:
        for process in multiprocessing.active_children():
            process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """
    The workers of a Dask cluster.

    :param address: of its scheduler
    :raises UsageError: Dask is not installed, or no scheduler answers
    """
    install = "install it with: pip install 'sb3-guard[cluster]'"
    with explained("--scheduler needs Dask's package distributed", ImportError, fix=install):
        from distributed import Client
    start = "start one with: dask scheduler"
    with explained(f"no Dask scheduler answers at {address}", OSError, ValueError, fix=start):
        client = Client(address, timeout=10, set_as_default=False)
    with client:
        yield client.get_executor(retries=0, pure=False)


def run_grid(
    runs: Sequence[GridRun],
    folder: Path,
    jobs: int | None = None,
    scheduler: str | None = None,
    verbose: int = 1,
) -> int:
    """
    Carry out what is not done, and say what has become of it.

    :param runs: expanded and tried out; their states follow
    :param folder: where they are
    :param jobs: runs at once on this machine; None: as many as there are cores for this process
    :param scheduler: address of a Dask cluster's scheduler; None: this machine
    :param verbose: 0: errors only
    :return: exit status: 0, 1 if runs are not done, or 128 + the signal's number when interrupted
    :raises UsageError: a worker or the scheduler is gone
    """

    def say(text: str, error: str = "") -> None:
        if verbose or error:
            print(text, file=sys.stderr if error else sys.stdout, flush=True)

    def ask_to_stop(number: int) -> None:
        stop_file.touch()
        say("Stopping after the rollouts under way; Ctrl-C again stops immediately.")

    say(f"{folder}: {summary(runs)}")
    status, stop_file, todo = 0, folder / "stop", [run for run in runs if run.state != "done"]
    if todo:
        folder.mkdir(parents=True, exist_ok=True)
        stop_file.unlink(missing_ok=True)
        cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
        command, number = shlex.join(sys.orig_argv), min(jobs or cores, len(todo))
        hosts = cluster(scheduler) if scheduler else processes(number)
        with hosts as executor, interrupts(ask_to_stop) as received:
            left = todo
            while left and not received:
                futures = {executor.submit(carry_out, run, command, stop_file): run for run in left}
                for future in as_completed(futures):
                    run = futures[future]
                    before = run.state
                    # Errors of runs are caught where they run.
                    with explained(
                        "a worker or scheduler is gone", fix="the same command continues"
                    ):
                        run.state, run.error = future.result()
                    if run.state not in ("waiting", before):
                        say(f"{time.strftime('%H:%M:%S')}  {run.outcome()}", run.error)
                # Those that another process has may be done, or free, in a while.
                left = [run for run in todo if run.state == "in use"]
                time.sleep(ASK_AGAIN if left else 0.0)
        status = 128 + received[0] if received else 0
        stop_file.unlink(missing_ok=True)
        say(f"{folder}: {summary(runs)}")
    if all(run.state == "done" for run in runs):
        say(f"See the results with: sb3-guard plot {shlex.quote(str(folder))}")
        return status
    say("The same command continues.")
    return status or 1

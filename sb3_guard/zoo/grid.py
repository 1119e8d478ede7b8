"""A grid of training runs, suites × algorithms × seeds: checked in full, then carried out.

A run of a grid is a training run like any other, in ``<folder>/<algo>/<env>_<seed + 1>/``, so it is
played, plotted and resumed like any other. Dask's workers carry them out, here or on a cluster; all
that matters is in the run folders: the lock says that a run is under way, ``result.json``, written
last, that it is done. So a grid can be killed and started again anywhere.
"""

import logging
import multiprocessing
import shlex
import sys
import threading
import time
import traceback
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_guard import __version__
from sb3_guard.spelling import did_you_mean
from sb3_guard.zoo.algos import algorithm
from sb3_guard.zoo.hyperparams import annotations
from sb3_guard.zoo.run import Experiment
from sb3_guard.zoo.run_flags import RunFlags
from sb3_guard.zoo.run_folder import RunInUse, is_disk_error
from sb3_guard.zoo.start import complete, path_of, prepare, standing
from sb3_guard.zoo.usage import UsageError, explained, interrupts, one_line

if TYPE_CHECKING:
    from distributed import Client, Future

    from sb3_guard.zoo.live import Board

RETRIES = 2  # of a run that fails
POLL = 0.5  # seconds between looks at what runs


@dataclass(eq=False)
class Run:
    """
    One run of a grid.

    :param flags: all flags, as its folder states them
    :param values: all hyper-parameters, likewise
    :param ignored: those given for the grid that its algorithm does not have
    """

    flags: RunFlags
    values: dict[str, Any]
    ignored: list[str]
    #: at first done · resume · new; later waiting · running · in use · done · failed · stopped
    state: str
    attempts: int = 0
    #: what went wrong last, in a line
    error: str = ""

    @property
    def path(self) -> Path:
        """Its folder."""
        return path_of(self.flags)

    @property
    def steps(self) -> int:
        """Its length, environment steps."""
        return int(self.values["n_timesteps"])

    def __str__(self) -> str:
        return f"{self.flags.algo} on {self.flags.env}, seed {self.flags.seed}"


def expand(
    pairs: Sequence[tuple[str, str]],
    seeds: Sequence[int],
    flags: RunFlags,
    scale: float = 1.0,
) -> list[Run]:
    """
    The runs of a grid, checked, and how far they are; those of the first seed come first.

    A hyper-parameter given for the whole grid is passed to the algorithms that have it.

    :param pairs: environments and algorithms
    :param seeds: at least 0
    :param flags: what all runs share
    :param scale: factor of every run's length
    :raises UsageError: a name or value is wrong for any of the runs, or a folder holds another run
        than the one that belongs there
    """
    given = flags.hyperparams or {}
    known = {
        algo: annotations(algorithm(algo)) for algo in dict.fromkeys(algo for _, algo in pairs)
    }
    every = sorted(set[str]().union(*known.values()))
    for name in given.keys() - every:
        hint = did_you_mean(name, every)
        raise UsageError(f"none of the algorithms has a hyper-parameter {name!r}; {hint}")
    first = {}
    flags = replace(flags, progress=False, num_threads=max(flags.num_threads, 1))
    for env_id, algo in pairs:
        own = {name: value for name, value in given.items() if name in known[algo]}
        mine = replace(flags, env=env_id, algo=algo, seed=0, hyperparams=own or None)
        one, values = prepare(mine)
        one.n_timesteps = values["n_timesteps"] = max(round(values["n_timesteps"] * scale), 1)
        first[one.env, algo] = one, values, sorted(given.keys() - own.keys())
    runs = []
    for seed in dict.fromkeys(seeds):
        for one, values, ignored in first.values():
            mine = replace(one, seed=seed)
            runs.append(Run(mine, values, ignored, standing(mine, values)))
    return runs


def try_out(runs: Sequence[Run]) -> None:
    """
    Make each suite and each algorithm once, so that a value that is refused only there ends the
    grid before it begins.

    :raises UsageError: one is refused
    """
    import torch as th

    seen: set[str] = set()
    for run in runs:
        flags = run.flags
        if run.state == "done" or {flags.env, flags.algo} <= seen:
            continue
        seen |= {flags.env, flags.algo}
        here = replace(flags, device="cpu", num_threads=1, tensorboard_log="", track=False)
        if flags.vec_env == "subproc":
            here.vec_env = "dummy"
        try:
            if flags.device != "auto":
                th.device(flags.device)
            Experiment(here, run.values).close()
        except (UsageError, RuntimeError) as error:
            raise UsageError(f"{flags.algo} on {flags.env}: {one_line(error)}") from error


# In a worker

_stopped: set[str] = set()  # the grids that have asked their runs to stop
_one_at_a_time = threading.Lock()  # random generators and thread counts belong to the process


def carry_out(run: Run, command: str, grid: str) -> tuple[str, str]:
    """
    Complete a run; what goes wrong is also written to ``error.txt`` in its folder.

    :param command: the command line, for the run folder
    :param grid: the name under which :func:`ask_to_stop` is called
    :return: the state it is left in, ``done``, ``stopped``, ``failed``, ``in use`` by another
        process, or ``no disk``: full, read-only or broken; and what went wrong
    """
    with _one_at_a_time:
        try:
            if grid in _stopped:
                return "stopped", ""
            asked = lambda: grid in _stopped  # noqa: E731
            status = complete(run.flags, run.values, command, asked)
        except RunInUse as error:
            time.sleep(POLL)
            return "in use", one_line(error)
        except Exception as error:
            if is_disk_error(error):
                return "no disk", one_line(error)
            _record(run, traceback.format_exc())
            return "failed", one_line(error)
    return "stopped" if status else "done", ""


def ask_to_stop(grid: str) -> None:
    """Let a worker's run end after the rollout under way, if it belongs to a grid."""
    _stopped.add(grid)


def _record(run: Run, text: str) -> None:
    now = time.strftime("%Y-%m-%d %H:%M:%S")
    # The grid's summary says it too, so a record that can't be written is not a second failure.
    with suppress(OSError), open(run.path / "error.txt", "a") as file:
        file.write(f"--- {now}\n{text}\n")


# Workers


@contextmanager
def workers(jobs: int | None, scheduler: str | None, folder: Path) -> Iterator["Client"]:
    """
    Dask's workers: processes of this machine, or those of a cluster.

    :param jobs: how many on this machine; None: as many as there are cores for this process
    :param scheduler: address of the cluster's scheduler; None: this machine
    :param folder: the grid's, which must exist on all of them
    :raises UsageError: no scheduler answers, or a worker can't do the work
    """
    import dask
    from dask.system import CPU_COUNT
    from distributed import Client, LocalCluster

    # What goes wrong is said here, in a line; Dask's own words would bury that.
    for name in ("distributed", "distributed.client", "distributed.nanny"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if scheduler is not None:
        what = f"no Dask scheduler answers at {scheduler}"
        with explained(what, OSError, ValueError, fix="start one with: dask scheduler"):
            client = Client(scheduler, timeout=10, set_as_default=False)
        with client:
            _check(client, folder)
            yield client
        return
    # Dask has workers return every freed array to the system, which a training's updates pay with a
    # third of their time.
    environment = dict(dask.config.get("distributed.nanny.pre-spawn-environ"))
    environment.pop("MALLOC_TRIM_THRESHOLD_", None)
    settings = {
        "distributed.nanny.pre-spawn-environ": environment,
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.interval": "1s",
        # Whatever ends a run's process counts as one of its failures.
        "distributed.scheduler.allowed-failures": 0,
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
    }
    with (
        dask.config.set(settings),
        LocalCluster(
            n_workers=jobs or CPU_COUNT,
            threads_per_worker=1,
            memory_limit=None,
            dashboard_address="127.0.0.1:0",
            security=True,  # else whoever has an account on this machine may give it work
            silence_logs=logging.CRITICAL,
            preload=[LONE],
            env={"PYTHONWARNINGS": "ignore"},
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        try:
            yield client
        except KeyboardInterrupt:  # do not let the runs finish their rollouts
            for worker in multiprocessing.active_children():
                worker.kill()
            raise


# Ctrl-C in a terminal reaches a whole group of processes; here, it is for the grid alone.
LONE = "import os; getattr(os, 'setpgrp', int)()"


def _check(client: "Client", folder: Path) -> None:
    """Refuse a cluster whose workers have another version, or do not see the folder."""
    with explained("a Dask worker can't use sb3_guard", fix="install it there"):
        seen = client.run(_looks, folder)
    for worker, (version, visible) in seen.items():
        if version != __version__:
            why = f"has sb3_guard {version}, this is {__version__}; install the same version"
        elif not visible:
            why = f"does not see the folder {folder}; choose one that all workers share, with -f"
        else:
            continue
        raise UsageError(f"Dask worker {worker} {why}")


def _looks(path: Path) -> tuple[str, bool]:
    return __version__, path.exists()


# Here


class Execution:
    """
    The runs of a grid being carried out.

    :param runs: as :func:`expand` returns them
    :param client: of the workers, which see the runs' folders
    :param board: shows how it goes
    """

    def __init__(self, runs: Sequence[Run], client: "Client", board: "Board"):
        self.runs, self.client, self.board = runs, client, board
        self.name = uuid.uuid4().hex
        self.signal = 0
        self.no_disk = ""
        self._waiting = [run for run in runs if run.state != "done"]
        self._flight: dict[Future, Run] = {}
        self._slots = len(client.nthreads())
        for run in self._waiting:
            run.state = "waiting"

    def carry_out(self) -> int:
        """
        Train what is not done yet.

        :return: exit status: 0, 1 if runs failed, or 128 + the signal's number when interrupted
        :raises UsageError: the workers are gone
        """
        with interrupts(self._stop):
            while self._waiting or self._flight:
                self._submit()
                self.board.update(self.runs)
                time.sleep(POLL)
                self._collect()
        if self.signal:
            return 128 + self.signal
        return int(any(run.state != "done" for run in self.runs))

    def _stop(self, number: int) -> None:
        self.signal = number
        self.board.say("Stopping after the rollouts under way; Ctrl-C again stops immediately.")

    def _submit(self) -> None:
        """Give each idle worker a run, so that what ends a worker is blamed on one run."""
        if self.signal or self.no_disk:
            for run in self._waiting:
                run.state = "stopped"
            self._waiting.clear()
            # Every time, since a worker may have died and another taken its run over.
            self.client.run(ask_to_stop, self.name, on_error="ignore")
        if self.client.status != "running":
            raise UsageError("the Dask scheduler is gone; the runs keep their checkpoints")
        if self.client.cluster is not None:
            self.client.cluster.scale(self._slots)  # replaces workers that did not come back
        else:
            self._slots = len(self.client.nthreads())
        while self._waiting and len(self._flight) < max(self._slots, 1):
            run = self._waiting.pop(0)
            if run.state != "in use":
                run.state = "running"
                self.board.note("retrying" if run.attempts else "started", run)
            arguments = run, shlex.join(sys.orig_argv), self.name
            future = self.client.submit(carry_out, *arguments, pure=False)
            self._flight[future] = run

    def _collect(self) -> None:
        for future in [one for one in self._flight if one.done()]:
            run = self._flight.pop(future)
            if future.status == "finished":
                run.state, text = future.result()
            elif future.status == "error":
                # Those of runs are caught where they run: this is Dask's, of a dead worker.
                error = one_line(future.exception() or RuntimeError())
                run.state, text = "failed", f"its process died, perhaps out of memory: {error}"
                _record(run, text)
            else:
                raise UsageError("the Dask scheduler is gone; the runs keep their checkpoints")
            if run.state == "no disk":
                run.state, self.no_disk = "stopped", text
            elif run.state == "failed":
                run.attempts, run.error = run.attempts + 1, text
            if run.state in ("done", "failed"):
                self.board.note(run.state, run)
            again = run.attempts <= RETRIES and not (self.signal or self.no_disk)
            if run.state == "in use" or (run.state == "failed" and again):
                self._waiting.append(run)


def run_grid(
    runs: Sequence[Run],
    folder: Path,
    again: str,
    jobs: int | None = None,
    scheduler: str | None = None,
    verbose: int = 1,
) -> int:
    """
    Carry out what is not done, and say what has become of it.

    :param runs: expanded and tried out
    :param folder: where they are
    :param again: how to continue when interrupted, for the message
    :param jobs: see :func:`workers`
    :param scheduler: likewise
    :param verbose: 0: errors only
    :return: exit status, see :meth:`Execution.carry_out`
    :raises UsageError: the workers are gone, or can't do the work
    """
    from sb3_guard.zoo.live import Board, summary

    status, no_disk = 0, ""
    board = Board(str(folder), verbose)
    with board.bars:
        for algo, names in {run.flags.algo: run.ignored for run in runs if run.ignored}.items():
            board.say(f"{algo} has no {', '.join(names)}: left out there")
        if any(run.state != "done" for run in runs):
            board.say(f"{folder}: {summary(runs)}")
            with workers(jobs, scheduler, folder) as client:
                execution = Execution(runs, client, board)
                try:
                    status = execution.carry_out()
                except UsageError as error:
                    raise UsageError(f"{one_line(error)}; {again}") from error
                no_disk = execution.no_disk
    board.say(f"{folder}: {summary(runs)}")
    if any(run.state != "done" for run in runs):
        board.say(again[0].upper() + again[1:])
    for run in runs:
        if run.state == "failed":
            print(f"failed: {run}: {run.error}\n  {run.path / 'error.txt'}", file=sys.stderr)
    if no_disk:
        print(f"error: {no_disk}", file=sys.stderr)
    return status

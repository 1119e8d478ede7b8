"""A grid of training runs, suites × algorithms × seeds: checked in full, then carried out.

A run of a grid is a training run like any other, in ``<folder>/<algo>/<env>_<seed + 1>/``, so it is
played, plotted and resumed like any other. All that a grid knows about its runs it reads from their
folders, so it can be killed and started again anywhere, and runs on any
:class:`concurrent.futures.Executor` whose workers see the folder.
"""

import os
import shlex
import sys
import time
import uuid
from collections.abc import Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_guard.spelling import did_you_mean
from sb3_guard.zoo.algos import algorithm
from sb3_guard.zoo.config import NOISE_KEYS, RUN_KEYS, arguments
from sb3_guard.zoo.experiment import Experiment, prepare, refuse_another
from sb3_guard.zoo.live import Board
from sb3_guard.zoo.run_folder import RunFolder, in_use, is_run, owner, run_path
from sb3_guard.zoo.usage import UsageError, interrupts, one_line
from sb3_guard.zoo.worker import Outcome, Task, kill_all, last_line, work

RETRIES = 2  # of a run that fails
POLL = 0.5  # seconds between looks at what runs
PATIENCE = 30.0  # seconds a shared disk may take to show a result that a worker has written


class LocalExecutor(ThreadPoolExecutor):
    """
    Runs on this machine, each in a process with one thread: the threads here only wait for them.

    :param jobs: how many at once; None: as many as there are cores for this process
    """

    def __init__(self, jobs: int | None = None):
        super().__init__(jobs or cores())


def cores() -> int:
    """The number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        return os.cpu_count() or 1


@dataclass(eq=False)
class Run:
    """
    One run of a grid.

    :param args: all flags, as its folder states them
    :param values: all hyper-parameters, likewise
    """

    args: dict[str, Any]
    values: dict[str, Any]
    #: done · resume · new (planned); waiting · running · in use · done · failed · stopped (later)
    state: str = "new"
    attempts: int = 0
    error: str = ""
    ignored: list[str] = field(default_factory=list)

    @property
    def number(self) -> int:
        """Of its folder."""
        return int(self.args["seed"]) + 1

    @property
    def path(self) -> Path:
        """Its folder."""
        return run_path(self.args["log_folder"], self.args["algo"], self.args["env"], self.number)

    @property
    def steps(self) -> int:
        """Its length, environment steps."""
        return int(self.values["n_timesteps"])

    def __str__(self) -> str:
        return f"{self.args['algo']} on {self.args['env']}, seed {self.args['seed']}"


def expand(
    pairs: Sequence[tuple[str, str]],
    seeds: Sequence[int],
    args: Mapping[str, Any],
    scale: float = 1.0,
) -> list[Run]:
    """
    The runs of a grid, checked; those of the first seed come first.

    A hyper-parameter given for the whole grid is passed to the algorithms that have it.

    :param pairs: environments and algorithms
    :param seeds: at least 0
    :param args: all flags of training, with their defaults
    :param scale: factor of every run's length
    :raises UsageError: a name or value is wrong for any of the runs
    """
    for seed in seeds:
        if not 0 <= seed < 2**32 - 1:
            raise UsageError(f"--seeds: {seed} is not allowed; it must be from 0 to 2**32 - 2")
    given = dict(args["hyperparams"] or {})
    known = {algo: _hyperparams(algo) for algo in dict.fromkeys(algo for _, algo in pairs)}
    for name in given:
        if not any(name in names for names in known.values()):
            every = sorted(set().union(*known.values()))
            who = next(iter(known)) if len(known) == 1 else "none of the algorithms"
            raise UsageError(f"{who} has a hyper-parameter {name!r}; {did_you_mean(name, every)}")
    prepared = {}
    args = {**args, "progress": False, "num_threads": max(args["num_threads"], 1)}
    for env_id, algo in pairs:
        own = {name: value for name, value in given.items() if name in known[algo]}
        one, values = prepare(
            {**args, "env": env_id, "algo": algo, "seed": 0, "hyperparams": own or None}
        )
        values["n_timesteps"] = max(round(values["n_timesteps"] * scale), 1)
        one["n_timesteps"] = values["n_timesteps"]
        prepared[one["env"], algo] = one, values, sorted(given.keys() - own.keys())
    return [
        Run({**one, "seed": seed}, dict(values), ignored=ignored)
        for seed in dict.fromkeys(seeds)
        for one, values, ignored in prepared.values()
    ]


def _hyperparams(algo: str) -> set[str]:
    """The names of the hyper-parameters that an algorithm's runs may have."""
    names = {*arguments(algorithm(algo)), *RUN_KEYS}
    return names | NOISE_KEYS.keys() if "action_noise" in names else names


def plan(runs: Sequence[Run]) -> None:
    """
    Find out how far each run is: done, to be resumed, or new.

    :raises UsageError: a folder holds another run than the one that belongs there
    """
    for run in runs:
        run.state = "new"
        if not is_run(run.path):
            continue
        folder = RunFolder(run.path)
        refuse_another(folder, run.args, run.values)
        if folder.read_result() is not None:
            run.state = "done"
        elif folder.checkpoint.exists():
            run.state = "resume"


def try_out(runs: Sequence[Run]) -> None:
    """
    Make each suite and each algorithm once and take a step, so that a value that is refused only
    there ends the grid before it begins.

    :raises UsageError: one is refused
    """
    import torch as th

    suites: set[str] = set()
    algos: set[str] = set()
    for run in runs:
        if run.state == "done":
            continue
        args = {
            **run.args,
            "device": "cpu",
            "num_threads": 1,
            "tensorboard_log": "",
            "track": False,
        }
        if args["env"] in suites and args["algo"] in algos:
            continue
        suites.add(args["env"])
        algos.add(args["algo"])
        if args["vec_env"] == "subproc":
            args["vec_env"] = "dummy"
        try:
            if run.args["device"] != "auto":
                th.device(run.args["device"])
            Experiment(args, run.values).close()
        except (UsageError, RuntimeError) as error:
            raise UsageError(f"{args['algo']} on {args['env']}: {one_line(error)}") from error


@dataclass
class Execution:
    """
    The runs of a grid being carried out.

    :param runs: planned
    :param executor: its workers see the runs' folders
    :param board: shows how it goes
    :param command: the command line, for the run folders
    :param folder: where the runs' permit lies: they end when it is gone
    """

    runs: Sequence[Run]
    executor: Executor
    board: Board
    command: str
    folder: Path

    def __post_init__(self) -> None:
        self.permit = self.folder / f".grid-{uuid.uuid4().hex[:12]}"
        self.signal = 0
        self._asked = False  # the runs to stop
        self.no_disk = ""
        self._flight: dict[Future[Outcome], tuple[Run, Task]] = {}

    def carry_out(self) -> int:
        """
        Train what is not done yet.

        :return: exit status: 0, 1 if runs failed, or 128 + the signal's number when interrupted
        :raises UsageError: the workers are gone
        """
        try:
            self.permit.parent.mkdir(parents=True, exist_ok=True)
            self.permit.touch()
        except OSError as error:
            raise UsageError(
                f"can't write to log folder {str(self.folder)!r}: {error.strerror}; "
                "choose another with -f"
            ) from error
        with interrupts(self._stop):
            try:
                for run in self.runs:
                    if run.state != "done":
                        self._submit(run)
                self.board.update(self.runs)
                while self._flight or self._others():
                    self._look()
            except BaseException:
                # A second Ctrl-C, or the workers are gone: what runs here ends at once.
                self._withdraw()
                for future in self._flight:
                    future.cancel()
                kill_all()
                raise
        self._withdraw()
        if self.signal:
            return 128 + self.signal
        return int(any(run.state != "done" for run in self.runs))

    def _withdraw(self) -> None:
        """Let all runs end after the rollout under way, and those not begun not begin."""
        self._asked = True
        try:
            self.permit.unlink(missing_ok=True)
        except OSError:  # a disk that became read-only: there is nothing more to save
            for future in self._flight:
                future.cancel()
            kill_all()

    def _others(self) -> list[Run]:
        return [run for run in self.runs if run.state == "in use"]

    def _submit(self, run: Run) -> None:
        run.state = "waiting"
        task = Task(run.args, run.values, run.number, self.command, self.permit, run.attempts + 1)
        self._flight[self.executor.submit(work, task)] = run, task

    def _look(self) -> None:
        if self._stopping and not self._asked:
            self._withdraw()
        if self._flight:
            ended, _ = wait(self._flight, timeout=POLL, return_when=FIRST_COMPLETED)
        else:
            time.sleep(POLL)
            ended = set()
        for future in ended:
            self._ended(self._flight.pop(future)[0], future)
        for run, task in self._flight.values():
            if run.state == "waiting" and owner(run.path).get("grid") == task.name:
                run.state = "running"
                self.board.note("started" if run.attempts == 0 else "started again", run)
        for run in self._others():
            if self._stopping:
                run.state = "stopped"
            elif not in_use(run.path):
                self._submit(run)
        self.board.update(self.runs)

    def _ended(self, run: Run, future: "Future[Outcome]") -> None:
        try:
            state, text = future.result()
        except CancelledError:
            if not self._stopping:
                raise UsageError(
                    "the workers are gone, or the scheduler is; the runs keep their checkpoints: "
                    "start it again"
                ) from None
            state, text = "stopped", ""
        except Exception as error:  # a worker died, or can't do the work at all
            state, text = "failed", one_line(error)
        result = run.path / "result.json"
        if state == "done" and not self._has_result(run):
            state, text = (
                "failed",
                (
                    f"A worker reports the run as done, but there is no {result}: "
                    "the folder must be on a disk that all workers share."
                ),
            )
        run.state = state
        if state == "done":
            self.board.note("done", run)
        elif state == "no disk":
            run.state, self.no_disk = "stopped", self.no_disk or text
        elif state == "failed":
            run.attempts += 1
            run.error = text
            again = run.attempts <= RETRIES and not self._stopping
            self.board.note("failed, is tried again" if again else "failed", run)
            if again:
                self._submit(run)

    def _has_result(self, run: Run) -> bool:
        end = time.monotonic() + PATIENCE
        # A shared disk may show the folder itself as late as the result in it.
        while not is_run(run.path) or RunFolder(run.path).read_result() is None:
            if time.monotonic() > end or self._stopping:
                return False
            time.sleep(POLL)
        return True

    @property
    def _stopping(self) -> bool:
        return bool(self.signal or self.no_disk)

    def _stop(self, number: int) -> None:
        self.signal = number
        self.board.say(
            "Stopping after the rollouts under way; once more to stop at once.", sys.stderr
        )


def run_grid(runs: Sequence[Run], executor: Executor, args: Mapping[str, Any], go_on: str) -> int:
    """
    Carry out what is not done, and say what has become of it.

    :param runs: expanded, planned and tried out
    :param executor: see :class:`Execution`
    :param args: all flags
    :param go_on: how to go on when interrupted, for the message
    :return: exit status, see :meth:`Execution.carry_out`
    :raises UsageError: the workers are gone
    """
    folder = Path(args["log_folder"])
    states = [run.state for run in runs]
    with Board(str(folder), args["verbose"]) as board:
        board.say(
            f"{len(runs)} runs in {folder}: {states.count('done')} are done, "
            f"{states.count('resume')} go on from their checkpoints, {states.count('new')} are new"
        )
        for algo, names in {run.args["algo"]: run.ignored for run in runs if run.ignored}.items():
            board.say(f"{algo} has no {', '.join(names)}: left out there")
        execution = Execution(runs, executor, board, shlex.join(sys.orig_argv), folder)
        try:
            status = execution.carry_out()
        except UsageError as error:
            raise UsageError(f"{one_line(error)}; {go_on}") from error
    failed = [run for run in runs if run.state == "failed"]
    done = sum(run.state == "done" for run in runs)
    board.say(f"{done} of {len(runs)} runs are done in {folder}")
    for run in failed:
        print(f"failed: {run}: {last_line(run.error)}\n  {run.path / 'error.txt'}", file=sys.stderr)
    if execution.no_disk:
        print(f"error: {last_line(execution.no_disk)}", file=sys.stderr)
    if done < len(runs):
        board.say(go_on[0].upper() + go_on[1:])
    return status

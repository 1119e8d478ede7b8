"""Runs, grids and tuners killed at random moments; ``scripts/chaos.py`` does it for longer.

A run or a grid has to end with the bits of an undisturbed one; a study must lose no trial.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise
from multiprocessing.process import BaseProcess
from pathlib import Path

import optuna
import pandas as pd
import psutil
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from postgres import Server
from processes import fresh, wait_for

from sb3_guard import tune

RUN = (
    "-n 40000 -params n_envs:4 n_steps:500 --eval-freq -1 --checkpoint-every 0 --device cpu "
    "--num-threads 1"
).split()
FLAGS = {
    "train": ["--algo", "cpo", "--env", "Goal_Point_8Hazards", "--seed", "3", *RUN],
    "grid": ["--envs", "Goal_Point_8Hazards", "--algos", "cpo", "trpo", "--seeds", "0", *RUN],
}
MODULES = {"train": "sb3_guard.train", "grid": "sb3_guard.benchmark"}
CLOCKS = {"t", "time/fps", "time/time_elapsed"}
NOT_COMPARED = {"seconds", "commit"}
STUDY = "kills"
DONE = (TrialState.COMPLETE, TrialState.PRUNED)
TUNE = (
    "--algo trpo_lag --gym-packages instant_training --env Still-v0 -params n_envs:1 n_steps:10 "
    f"cost_limit:1 -n 40 --eval-episodes 1 --device cpu --num-threads 1 --study-name {STUDY}"
).split()


class Campaign:
    """
    A command that is killed until it has survived enough.

    :param what: ``train`` or ``grid``
    :param flags: of the command
    :param folder: its log folder
    :param rng: when to kill, and whom
    """

    def __init__(self, what: str, flags: list[str], folder: Path, rng: random.Random):
        self.what, self.folder, self.rng = what, folder, rng
        self.flags = [*FLAGS[what], *flags]
        self.kills = {"main": 0, "worker": 0}

    def start(self) -> psutil.Popen:
        """Give the command, or give it again."""
        begun = [path.parent for path in self.folder.glob("*/*/checkpoint.zip")]
        flags = [*self.flags, "-f", str(self.folder)]
        if self.what == "train" and begun:  # a single run is continued, not begun again
            flags = ["-i", str(begun[0])]
            if "--gym-packages" in self.flags:
                named = self.flags.index("--gym-packages")
                flags += self.flags[named : named + 2]
        elif self.what == "train":
            shutil.rmtree(self.folder, ignore_errors=True)
        return psutil.Popen(
            [sys.executable, "-m", MODULES[self.what], *flags],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def episodes(self) -> int:
        """How many lines all monitor files have."""
        files = self.folder.glob("*/*/0.monitor.csv")
        return sum(file.read_bytes().count(b"\n") for file in files)

    def wait(self, process: psutil.Popen, whom: str, patience: float) -> bool:
        """Wait for the moment of the next kill; False if the command has done its work before."""
        end = time.monotonic() + self.rng.uniform(0.5, patience)
        goal = self.episodes() + self.rng.randint(1, 20) if self.rng.random() < 0.5 else None
        while process.poll() is None:
            if whom == "worker" and self.what == "grid" and not workers(process):
                end = time.monotonic() + 0.5
            elif self.episodes() >= goal if goal is not None else time.monotonic() > end:
                return True
            time.sleep(0.05)
        return process.returncode != 0

    def kill(self, process: psutil.Popen, whom: str) -> None:
        """Kill the main process or a worker; without the main one, all workers must end, too."""
        children = workers(process)
        if children and whom == "worker":
            self.kills["worker"] += 1
            os.kill(self.rng.choice(children).pid, signal.SIGKILL)
            return
        self.kills["main"] += 1
        process.kill()
        process.wait()
        _, alive = psutil.wait_procs(children, timeout=30)
        if alive:
            raise SystemExit(f"{alive} outlived the command")

    def run(self, kills: Sequence[str] = (), patience: float = 15.0) -> None:
        """
        Kill these, ``main`` or ``worker``, then let the command end.

        Runs that were killed too often make it fail; it may do so a few times.
        """
        process = self.start()
        for whom in kills:
            if not self.wait(process, whom, patience):
                break
            with suppress(ProcessLookupError, psutil.NoSuchProcess):  # ended meanwhile
                self.kill(process, whom)
            if process.poll() is not None:
                process = self.start()
        for _ in range(5):
            if process.wait() == 0:
                return
            process = self.start()
        process.kill()
        raise SystemExit("the command does not come to its end")


def workers(process: psutil.Popen) -> list[psutil.Process]:
    """The processes that a command has started, except for multiprocessing's own."""
    started = []
    for child in process.children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # ended meanwhile
            if "resource_tracker" not in " ".join(child.cmdline()):
                started.append(child)
    return started


def outcome(run: Path) -> tuple[dict[str, object], list[pd.DataFrame]]:
    """All that a run computed: its result, episodes and log, clocks left out."""
    result = json.loads((run / "result.json").read_text())
    tables = [pd.read_csv(run / "0.monitor.csv", skiprows=1), pd.read_csv(run / "progress.csv")]
    return (
        {name: value for name, value in result.items() if name not in NOT_COMPARED},
        [table[sorted({*table} - CLOCKS)] for table in tables],
    )


def differences(folder: Path, other: Path) -> list[str]:
    """In which runs two log folders differ, to the last bit."""
    runs = [{run.parent.relative_to(f) for run in f.rglob("result.json")} for f in (folder, other)]
    lines = [f"{run} is in one folder only" for run in sorted(runs[0] ^ runs[1])]
    for run in sorted(runs[0] & runs[1]):
        (result, tables), (result2, tables2) = outcome(folder / run), outcome(other / run)
        if result != result2:
            lines.append(f"{run}: {result} is not {result2}")
        if not all(a.equals(b) for a, b in zip(tables, tables2, strict=True)):
            lines.append(f"{run}: episodes or log differ")
    return lines if runs[0] else ["there are no results"]


def work(arguments: list[str]) -> int:
    """Run the command, in a process of its own."""
    return tune.main(arguments)


def load(storage: str) -> optuna.Study:
    """The study, read as anybody can."""
    if "://" in storage:
        return optuna.load_study(
            study_name=STUDY, storage=storage.replace("postgresql:", "postgresql+psycopg:")
        )
    return optuna.load_study(study_name=STUDY, storage=JournalStorage(JournalFileBackend(storage)))


def _at_work(workers: Mapping[Path, BaseProcess]) -> list[Path]:
    """Outputs of the workers that have printed their header and not ended."""
    return [
        output
        for output, process in workers.items()
        if process.is_alive() and output.read_text().count("\n") >= 5
    ]


def campaign(
    storage: str,
    folder: Path,
    n_trials: int,
    n_workers: int,
    kills: int,
    server: Server | None = None,
    say: Callable[[str], object] = lambda text: None,
) -> optuna.Study:
    """
    Run a study whose workers are killed.

    :param storage: for ``tune --storage``
    :param folder: where reports and the workers' output go
    :param n_trials: trials of the study
    :param n_workers: how many work at a time
    :param kills: after so many, the workers are left alone
    :param server: of the database; it is stopped, or crashed, after every fourth kill
    :param say: told what happens
    :return: the study at its end
    :raises AssertionError: a worker printed a traceback or did not end, or there are fewer finished
        trials, or more than one more for each further worker
    """
    number = 0
    workers: dict[Path, BaseProcess] = {}

    def start() -> None:
        nonlocal number
        number += 1
        output = folder / f"worker-{number}.txt"
        arguments = [*TUNE, "-f", str(folder), "--storage", storage, "--n-trials", str(n_trials)]
        workers[output] = fresh(work, arguments, output)

    def replace_ended() -> bool:
        """Replace workers that ended with a line; whether one has done its work."""
        for output, process in list(workers.items()):
            if process.exitcode == 2:
                assert "Traceback" not in output.read_text(), output.read_text()
                say(output.read_text().splitlines()[-1])
                workers.pop(output)
                start()
        return any(process.exitcode == 0 for process in workers.values())

    for _ in range(n_workers):
        start()
    for kill in range(kills):
        wait_for(lambda: bool(_at_work(workers)) or replace_ended(), 600.0)
        time.sleep(random.uniform(0.0, 0.4))
        if replace_ended():
            break  # the study is at its end
        if not _at_work(workers):
            continue
        output = random.choice(_at_work(workers))
        workers.pop(output).kill()
        start()
        if server is not None and kill % 4 == 3:
            mode = random.choice(["fast", "immediate"])
            server.stop(mode)
            time.sleep(random.uniform(0.0, 3.0))
            server.start()
            say(f"the database was stopped ({mode}) and started again")
        say(f"{kill + 1} workers killed")

    def all_done() -> bool:
        replace_ended()
        return not any(process.exitcode is None for process in workers.values())

    wait_for(all_done, 900.0)
    done = len(load(storage).get_trials(deepcopy=False, states=DONE))
    assert n_trials <= done < n_trials + n_workers, f"{done} trials are finished, not {n_trials}"
    # Trials whose workers were killed last are repeated by whoever starts next, after the silence.
    time.sleep(4.0)
    left = (TrialState.RUNNING, TrialState.WAITING)
    n_trials = done + len(load(storage).get_trials(deepcopy=False, states=left))
    start()
    wait_for(all_done, 900.0)
    for output, process in workers.items():
        assert process.exitcode == 0, f"{output}: {process.exitcode}\n{output.read_text()}"
        assert "Traceback" not in output.read_text(), output.read_text()
    return load(storage)


def faults(study: optuna.Study) -> list[str]:
    """
    Trials of a study at its end that were lost, done twice or left, a line each.

    A trial and its repetitions have the same hyperparameters, and no others have.
    """
    trials = study.get_trials(deepcopy=False)
    done = [trial for trial in trials if trial.state in DONE]
    wrong = [
        f"trial {trial.number} is {trial.state.name.lower()} forever"
        for trial in trials
        if trial.state in (TrialState.RUNNING, TrialState.WAITING)
    ]
    for i, trial in enumerate(done):
        if any(trial.params == other.params for other in done[:i]):
            wrong.append(f"trial {trial.number} was done before")
    # A trial and its repetitions, by the first one's number. One that was killed while its
    # hyperparameters were drawn has some of them, and the next draws the others.
    lines: dict[int, list[FrozenTrial]] = {}
    for trial in trials:
        first = trial.system_attrs.get("retry_history", [trial.number])[0]
        lines.setdefault(first, []).append(trial)
    for line in lines.values():
        # A trial that takes down four workers is given up.
        if len(line) < 4 and not any(trial.state in DONE for trial in line):
            wrong.append(f"trial {line[0].number} was lost")
        for trial, later in pairwise(line):
            if later.state in DONE and not trial.params.items() <= later.params.items():
                wrong.append(f"trial {later.number} is not a repetition of {trial.number}")
    return wrong

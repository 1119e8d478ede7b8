"""Kill a tuner's workers, and its database, again and again: is no trial lost?

``python scripts/kill_tuner.py --trials 40`` starts three workers on one study in a journal file and
kills one of them with SIGKILL every second or so; each is replaced by a new one.
``--storage postgresql`` has the study in a PostgreSQL server of its own, which is stopped, or
crashed, and started again in between; workers that end for want of a database are replaced, too.
The trainings are stand-ins of a quarter of a second (``tests/instant_training.py``). At the end the
study must have the finished trials that were asked for, and at most one more for each further
worker; none was done twice, and each one whose worker was killed was done again.
"""

import argparse
import multiprocessing
import random
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from itertools import pairwise
from multiprocessing.process import BaseProcess
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState
from postgres import Server, running
from processes import fresh, wait_for

from sb3_guard import tune

STUDY = "kills"
DONE = (TrialState.COMPLETE, TrialState.PRUNED)
FLAGS = (
    "--algo trpo_lag --gym-packages instant_training --env Still-v0 -params n_envs:1 n_steps:10 "
    f"-n 40 --eval-episodes 1 --device cpu --num-threads 1 --study-name {STUDY}"
).split()


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
    :raises AssertionError: a worker printed a traceback, or did not end
    """
    number = 0
    workers: dict[Path, BaseProcess] = {}

    def start() -> None:
        nonlocal number
        number += 1
        output = folder / f"worker-{number}.txt"
        arguments = [*FLAGS, "-f", str(folder), "--storage", storage, "--n-trials", str(n_trials)]
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
    for output, process in workers.items():
        assert process.exitcode == 0, f"{output}: {process.exitcode}\n{output.read_text()}"
        assert "Traceback" not in output.read_text(), output.read_text()
    return load(storage)


def faults(study: optuna.Study, n_trials: int, n_workers: int) -> list[str]:
    """
    What is wrong with a study at its end.

    A trial and its repetitions have the same hyperparameters, and no others have.
    """
    trials = study.get_trials(deepcopy=False)
    done = [trial for trial in trials if trial.state in DONE]
    wrong = []
    if not n_trials <= len(done) < n_trials + n_workers:
        wrong.append(f"{len(done)} trials are finished, not {n_trials}")
    wrong += [
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


def main() -> int:
    """Run a campaign and say what it came to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--storage", choices=["journal", "postgresql"], default="journal")
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills")
    args = parser.parse_args()
    random.seed(args.seed)
    numbers = (args.trials, args.workers, args.kills)
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        server, storage = None, str(folder / "study.journal")
        if args.storage == "postgresql":
            server = stack.enter_context(running())
            storage = server.url
        study = campaign(storage, folder, *numbers, server=server, say=print)
        wrong = faults(study, args.trials, args.workers)
        again = len(study.get_trials(deepcopy=False, states=(TrialState.FAIL,)))
        done = len(study.get_trials(deepcopy=False, states=DONE))
    print(
        f"{done} of {args.trials} trials; workers were killed in {again}: {wrong or 'none is lost'}"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    multiprocessing.set_forkserver_preload(["sb3_guard.zoo.tuning"])
    sys.exit(main())

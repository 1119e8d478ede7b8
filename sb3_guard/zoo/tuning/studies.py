"""Optuna's storages for studies that many processes share, and the trials whose worker is gone.

A worker on PostgreSQL gives signs of life, and Optuna queues the trial of a silent one again. A
journal file is for one machine: there, whoever starts asks the operating system which are gone.
"""

import os
import socket
import time
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path

import optuna
from optuna.exceptions import StorageInternalError, UpdateFinishedTrialError
from optuna.storages import (
    JournalStorage,
    RDBStorage,
    RetryHeartbeatStaleTrialCallback,
    fail_stale_trials,
)
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, IntegrityError, ProgrammingError, SQLAlchemyError

from sb3_guard.zoo.cli.usage import UsageError, explained

HEARTBEAT, GRACE = 10, 30  # seconds between signs of life; after how many without one it is lost
# Trials that took down so many workers and one, for example for lack of memory, are given up.
MOST_REPEATS = 3
WORKER = "worker"  # attribute of a trial: host-pid of its process
DATABASE_ERRORS = (SQLAlchemyError, StorageInternalError)
# How Optuna begins each line of a journal.
_START = b'{"op_code":'

Storage = RDBStorage | JournalStorage


class Database(RDBStorage):
    """Optuna's storage for databases, whose heartbeat outlives an outage."""

    def record_heartbeat(self, trial_id: int) -> None:
        """Give a sign of life; a database that is gone is reported by the worker's next call."""
        with suppress(*DATABASE_ERRORS):
            super().record_heartbeat(trial_id)


def open_storage(address: str | None, journal: Path) -> tuple[Storage, str]:
    """
    The storage that ``--storage`` names, and its address without a password.

    :param address: of a database, or path of a journal file; None: ``journal``
    :param journal: the study's own journal file
    :raises UsageError: the address is wrong, or the file is not a journal or can't be written
    """
    if address is not None and "://" in address:
        return _open_database(address)
    path = (journal if address is None else Path(address)).absolute()
    damage = ValueError, KeyError, TypeError, AttributeError
    with (
        explained(f"can't write the study {path}", OSError, fix="choose another with -f"),
        explained(f"{path} is not a study, or damaged", *damage),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = JournalFileOpenLock(str(path))
        lock.acquire()
        try:
            with path.open("ab+") as file:
                file.seek(0)
                content = file.read()
                if content and not content.startswith(_START):
                    raise ValueError("it is not an Optuna journal")
                file.truncate(content.rfind(b"\n") + 1)  # a last line that a full disk has cut
        finally:
            lock.release()
        return JournalStorage(JournalFileBackend(str(path), lock)), str(path)


def _open_database(address: str) -> tuple[Storage, str]:
    url, shown = None, address.partition("@")[2] or "…"
    with suppress(ArgumentError, ValueError):
        url = make_url(address)
        shown = url.render_as_string(hide_password=True)
    if url is None or url.get_backend_name() != "postgresql":
        raise UsageError(
            f"--storage {shown} is not allowed; it must be "
            "postgresql://user:password@host/database, or the path of a journal file"
        )
    if url.drivername == "postgresql":
        url = url.set(drivername="postgresql+psycopg")

    def connect() -> Database:
        return Database(
            url.render_as_string(hide_password=False),
            # A connection that a restart has cut is renewed.
            engine_kwargs={"pool_pre_ping": True, "connect_args": {"connect_timeout": 10}},
            heartbeat_interval=HEARTBEAT,
            grace_period=GRACE,
            heartbeat_stale_trial_callback=repeat,
        )

    install = "install it with: pip install 'sb3-guard[postgres]'"
    with explained("--storage postgresql://… needs psycopg", ImportError, fix=install):
        try:
            return connect(), shown
        except (IntegrityError, ProgrammingError, StorageInternalError):
            time.sleep(1.0)  # another worker is making the same tables at this moment
            return connect(), shown


def database_error(error: BaseException | None) -> str | None:
    """
    What a database's driver says, without the statement and the links around it.

    :param error: an exception; Optuna may raise another while it handles the database's
    :return: None: no database has to do with it
    """
    while error is not None and not isinstance(error, SQLAlchemyError):
        error = error.__cause__ or error.__context__
    return None if error is None else " ".join(str(getattr(error, "orig", None) or error).split())


def repeat(study: optuna.Study, trial: FrozenTrial, most: int | None = MOST_REPEATS) -> None:
    """
    Queue a trial again, with its hyperparameters and the seeds that are done, unless it is queued.

    :param trial: a copy
    :param most: give it up after so many repetitions; None: never
    """
    history = RetryHeartbeatStaleTrialCallback.retry_history
    # A worker may die, or lose its database, after it has queued its trial and before it fails it.
    if not any(trial.number in history(other) for other in study.get_trials(deepcopy=False)):
        trial.user_attrs.pop(WORKER, None)
        RetryHeartbeatStaleTrialCallback(most)(study, trial)


def repeat_lost_trials(study: optuna.Study, storage: Storage) -> None:
    """Queue the trials again whose worker is gone."""
    fail_stale_trials(study)
    for trial in study.get_trials(states=(TrialState.RUNNING, TrialState.FAIL)):
        if _is_lost(trial, storage):
            # Another worker may do the same at the same moment.
            with suppress(ValueError, UpdateFinishedTrialError):
                if trial.state == TrialState.RUNNING:
                    study.tell(trial.number, state=TrialState.FAIL)
                repeat(study, trial)


def _is_lost(trial: FrozenTrial, storage: Storage) -> bool:
    host, _, process = trial.user_attrs.get(WORKER, "").rpartition("-")
    if trial.state == TrialState.FAIL or not host:
        # Killed between two writes: before it said who it is, or before it queued what it failed.
        moment = trial.datetime_complete or trial.datetime_start
        return moment is not None and datetime.now() - moment > timedelta(seconds=GRACE)
    local = isinstance(storage, JournalStorage) and host == socket.gethostname()
    return local and not _is_alive(int(process))


def _is_alive(process: int) -> bool:
    if os.name != "posix":  # elsewhere the signal 0 is not a question
        return True
    try:
        os.kill(process, 0)
    except OSError as error:
        return isinstance(error, PermissionError)
    return process != os.getpid()  # which has not begun, so its number was given again

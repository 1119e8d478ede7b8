"""Optuna's storages for studies that many processes share, and the trials whose worker is gone.

A worker on PostgreSQL gives signs of life, and Optuna queues the trial of a silent one again. A
journal file is for one machine: there, whoever starts asks the operating system which are gone.
"""

import os
import socket
import time
from contextlib import suppress
from pathlib import Path

import optuna
from optuna.exceptions import StorageInternalError, UpdateFinishedTrialError
from optuna.storages import JournalStorage, RDBStorage, RetryHeartbeatStaleTrialCallback
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
    damage = OSError, ValueError, KeyError, TypeError, AttributeError
    with explained(f"can't use {path} as a study", *damage, fix="choose another with -f"):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = JournalFileOpenLock(str(path))
        return JournalStorage(JournalFileBackend(str(path), lock)), str(path)


def _open_database(address: str) -> tuple[Storage, str]:
    form = "postgresql://user:password@host/database, or the path of a journal file"
    with explained("--storage", ArgumentError, ValueError, fix=f"it must be {form}"):
        url = make_url(address)
    shown = url.render_as_string(hide_password=True)
    if url.get_backend_name() != "postgresql":
        raise UsageError(f"--storage {shown} is not allowed; it must be {form}")
    url = url.set(drivername="postgresql+psycopg")

    def connect() -> Database:
        return Database(
            url.render_as_string(hide_password=False),
            # A connection that a restart has cut is renewed.
            engine_kwargs={"pool_pre_ping": True, "connect_args": {"connect_timeout": 10}},
            heartbeat_interval=HEARTBEAT,
            grace_period=GRACE,
            heartbeat_stale_trial_callback=RetryHeartbeatStaleTrialCallback(MOST_REPEATS),
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


def repeat_lost_trials(study: optuna.Study) -> None:
    """Queue the trials of a journal again whose process is gone; Optuna does so for a database."""
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        if _is_lost(trial):
            # Another worker may do the same at the same moment.
            with suppress(ValueError, UpdateFinishedTrialError):
                study.tell(trial.number, state=TrialState.FAIL)
                RetryHeartbeatStaleTrialCallback(MOST_REPEATS)(study, trial)


def _is_lost(trial: FrozenTrial) -> bool:
    host, _, process = trial.user_attrs.get(WORKER, "").rpartition("-")
    if not host:  # killed before it said who it is
        return True
    if host != socket.gethostname() or os.name != "posix":  # elsewhere signal 0 is no question
        return False
    try:
        os.kill(int(process), 0)
    except OSError as error:
        return not isinstance(error, PermissionError)
    return int(process) == os.getpid()  # which has not begun, so its number was given again

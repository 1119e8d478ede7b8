"""Studies that many processes share and of which no trial is lost, on Optuna's storages.

Optuna finds trials whose worker is gone by heartbeats. What is added here: the heartbeat of a
journal file is a lock, which the operating system drops however a process ends; a database that
goes away is waited for; trials are taken one at a time, so that their number is exact; and a
failed trial is repeated whoever failed it, and whenever.
"""

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from copy import deepcopy
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import optuna
from filelock import FileLock, Timeout
from optuna.distributions import BaseDistribution
from optuna.exceptions import StorageInternalError
from optuna.storages import (
    BaseStorage,
    JournalStorage,
    RDBStorage,
    RetryHeartbeatStaleTrialCallback,
)
from optuna.storages._heartbeat import BaseHeartbeat
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from sb3_guard.zoo.usage import UsageError, explained

Result = TypeVar("Result")
# Trials that took down so many workers, for example by running out of memory, are given up.
MOST_REPEATS = 3
# How often a trial was stopped on purpose, which does not count.
STOPPED = "stopped"
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
# How Optuna begins each line of a journal.
_START = b'{"op_code":'


class StorageLost(Exception):
    """The storage refuses to work, or went away and did not come back in time."""


class Outage(Exception):
    """The storage went away while a trial was taken: take it again."""


class NoneLeft(Exception):
    """
    All trials of a study are finished, or others work on the last ones.

    :param running: how many are under way
    """

    def __init__(self, running: int):
        super().__init__(running)
        self.running = running


class Study(optuna.Study):
    """
    A study of a given number of trials, whichever processes work on it.

    :param name: of a study that is in the storage
    :param storage: where it is
    :param n_trials: finished trials that it is to have in all
    """

    def __init__(self, name: str, storage: "Storage", n_trials: int):
        super().__init__(study_name=name, storage=storage)
        self.shared, self.n_trials = storage, n_trials

    def ask(self, fixed_distributions: dict[str, BaseDistribution] | None = None) -> optuna.Trial:
        """
        Take a trial; ``optimize`` calls it.

        :raises NoneLeft: there is none to take
        :raises Outage: the storage went away meanwhile
        """
        with self.shared.exclusive():
            self._repeat_lost_trials()
            states = Counter(one.state for one in self.get_trials(deepcopy=False))
            finished, running = sum(states[one] for one in FINISHED), states[TrialState.RUNNING]
            if finished + running >= self.n_trials:
                raise NoneLeft(running if finished < self.n_trials else 0)
            if not states[TrialState.WAITING]:
                # Every trial waits before it runs, so that a heart beats whenever one runs.
                self.enqueue_trial({})
            return super().ask(fixed_distributions)

    def _repeat_lost_trials(self) -> None:
        """Queue failed trials again, with all that is known of them, unless somebody has."""
        trials = self.get_trials(deepcopy=False)
        history = {one.number: one.system_attrs.get("retry_history", []) for one in trials}
        repeated = {number for numbers in history.values() for number in numbers}
        for one in trials:
            if one.state != TrialState.FAIL or one.number in repeated:
                continue
            if len(history[one.number]) - one.user_attrs.get(STOPPED, 0) < MOST_REPEATS:
                RetryHeartbeatStaleTrialCallback()(self, deepcopy(one))


class Journal(JournalStorage, BaseHeartbeat):
    """
    Studies in a file, shared by processes of one machine.

    :param path: the file; it is made if it is not there
    :raises UsageError: it can't be written, or is not a journal
    """

    lost = None

    def __init__(self, path: Path):
        path = path.absolute()
        self.shown = str(path)
        self._locks = path.with_name(f"{path.name}.locks")
        self._mine: FileLock | None = None
        damage = ValueError, KeyError, TypeError, AttributeError
        with (
            explained(f"can't write the study {path}", OSError, fix="choose another with -f"),
            explained(f"{path} is not a study, or damaged", *damage),
        ):
            if path.exists():
                _read_journal(path)
            self._locks.mkdir(parents=True, exist_ok=True)
            lock = FileLock(self._locks / "journal", poll_interval=0.01)
            with lock:
                rest = _read_journal(path) if path.exists() else b""
                if rest:  # a full disk cut the last line, which would make the journal unreadable
                    os.truncate(path, path.stat().st_size - len(rest))
            super().__init__(JournalFileBackend(str(path), lock))  # type: ignore[arg-type]
            self._claim = FileLock(self._locks / "claim", poll_interval=0.01)

    def exclusive(self) -> AbstractContextManager[Any]:
        """Be the only process that takes a trial."""
        return self._claim

    def set_trial_state_values(self, trial_id: int, state: TrialState, values: Any = None) -> bool:
        """As in Optuna; a trial that runs has a lock, from before it does."""
        if state == TrialState.RUNNING:
            self.close()
            self._mine = FileLock(self._lock_of(trial_id))
            self._mine.acquire()
        return super().set_trial_state_values(trial_id, state, values)

    def _lock_of(self, trial_id: int) -> Path:
        return self._locks / f"trial-{trial_id}"

    def record_heartbeat(self, trial_id: int) -> None:
        """Nothing to do: the lock says that this process lives."""

    def get_heartbeat_interval(self) -> int | None:
        """How often :meth:`record_heartbeat` is called, seconds."""
        return 3600

    def get_heartbeat_stale_trial_callback(self) -> None:
        """What happens to lost trials is for :class:`Study` to say."""
        return None

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        with self._claim:
            running = self.get_all_trials(study_id, deepcopy=False, states=(TrialState.RUNNING,))
            return [one._trial_id for one in running if self._is_lost(one._trial_id)]

    def _is_lost(self, trial_id: int) -> bool:
        path = self._lock_of(trial_id)
        if self._mine is not None and self._mine.lock_file == str(path):
            return False
        try:
            with FileLock(path).acquire(blocking=False):
                pass
        except Timeout:
            return False
        path.unlink(missing_ok=True)
        return True

    def close(self) -> None:
        """Give back the lock of the last trial."""
        if self._mine is not None:
            self._mine.release()
            Path(self._mine.lock_file).unlink(missing_ok=True)
            self._mine = None


def _read_journal(path: Path) -> bytes:
    """
    Make sure that a file is a journal, since nothing here may change another one.

    :return: what comes after the last whole line
    :raises ValueError: it is another kind of file
    """
    *lines, rest = path.read_bytes().split(b"\n")
    if rest[: len(_START)] != _START[: len(rest)] or not all(
        line.startswith(_START) and json.loads(line) for line in lines
    ):
        raise ValueError("it is not an Optuna journal")
    return rest


class Database(RDBStorage):
    """
    Studies in a PostgreSQL database, shared by any number of machines.

    Every call waits while the database is away.

    :param url: ``postgresql://user:password@host:port/database``
    :param heartbeat: seconds between two signs of life of a trial; after three times as many
        without one it is given to another worker
    :param patience: how long to wait for a database that is away, seconds
    :raises UsageError: the driver is absent, or the address is wrong
    :raises StorageLost: the database refuses, or nobody answers for as long
    """

    #: why it is given up; Optuna hides that where it can't tell a trial
    lost: StorageLost | None = None

    def __init__(self, url: str, heartbeat: int = 60, patience: float = 300.0):
        from sqlalchemy.engine import create_engine, make_url
        from sqlalchemy.exc import ArgumentError, SQLAlchemyError

        self._errors = (SQLAlchemyError, StorageInternalError)
        self._grace, self._patience = 3 * heartbeat, patience
        self._exclusive, self._away = False, False
        self.shown, parsed = url.partition("@")[2] or "…", None
        with suppress(ArgumentError, ValueError):
            parsed = make_url(url)
            self.shown = parsed.render_as_string(hide_password=True)
        if parsed is None or parsed.get_backend_name() != "postgresql":
            raise UsageError(
                f"--storage {self.shown} is not allowed; it must be "
                "postgresql://user:password@host/database, or the path of a journal file"
            )
        if parsed.drivername == "postgresql":
            parsed = parsed.set(drivername="postgresql+psycopg")
        address = parsed.render_as_string(hide_password=False)
        install = "install it with: pip install 'sb3-guard[postgres]'"
        with explained("--storage postgresql://… needs psycopg", ImportError, fix=install):
            self._claims = create_engine(address, **_ENGINE)
            # Whoever was here before an outage needs a moment until all hearts beat again.
            self._trusted_from = time.monotonic() + self._grace
            self._wait_for(self._make_tables, address, heartbeat)

    def _make_tables(self, address: str, heartbeat: int) -> None:
        with self.exclusive():
            super().__init__(
                address,
                engine_kwargs=_ENGINE,
                heartbeat_interval=heartbeat,
                grace_period=self._grace,
            )

    @contextmanager
    def exclusive(self) -> Iterator[None]:
        """
        Be the only process that takes a trial.

        :raises Outage: the database went away meanwhile, and with it the right to be the only one
        """
        from sqlalchemy import text

        try:
            with self._claims.begin() as connection:
                connection.execute(text("SELECT pg_advisory_xact_lock(761)"))
                self._exclusive = True
                yield
        except self._errors as error:
            if not _is_outage(error):
                raise StorageLost(f"{self.shown} refuses: {_cause(error)}") from error
            raise Outage(_cause(error)) from error
        finally:
            self._exclusive = False

    def _wait_for(self, function: Callable[..., Result], *args: Any, **kwargs: Any) -> Result:
        """Do something that may be repeated, until the database is there."""
        began, pause = time.monotonic(), 0.25
        while True:
            if self.lost is not None:
                raise self.lost
            try:
                result = function(*args, **kwargs)
            except (*self._errors, Outage) as error:
                if self._exclusive:
                    raise
                if not _is_outage(error):
                    raise StorageLost(f"{self.shown} refuses: {_cause(error)}") from error
                away = time.monotonic() - began
                if away >= self._patience:
                    self.lost = StorageLost(
                        f"{self.shown} has been out of reach for {away:.0f} s: {_cause(error)}; "
                        "its trials are intact: the same command continues the study"
                    )
                    raise self.lost from error
                self._trusted_from = time.monotonic() + self._grace
                if not self._away:
                    self._away = True
                    print(f"{self.shown} is out of reach, trying again: {_cause(error)}")
                time.sleep(min(pause, self._patience - away))
                pause = min(2 * pause, 10.0)
            else:
                if self._away:
                    self._away = False
                    print(f"{self.shown} is back after {time.monotonic() - began:.0f} s")
                return result

    def set_trial_state_values(self, trial_id: int, state: TrialState, values: Any = None) -> bool:
        """As in Optuna; the heart of a trial that runs beats, from before it does."""
        if state == TrialState.RUNNING:
            self.record_heartbeat(trial_id)
        return super().set_trial_state_values(trial_id, state, values)

    def record_heartbeat(self, trial_id: int) -> None:
        """A sign of life; what else fails for want of a database says so."""
        with suppress(StorageLost):
            self._wait_for(super().record_heartbeat, trial_id)

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        if time.monotonic() < self._trusted_from:
            return []
        return super()._get_stale_trial_ids(study_id)

    def close(self) -> None:
        """Close the connections."""
        self.engine.dispose()
        self._claims.dispose()


# Connections that a restart has cut are renewed; a server that no longer hears from a machine
# frees what that held.
_ENGINE: dict[str, Any] = {
    "pool_pre_ping": True,
    "connect_args": {
        "connect_timeout": 10,
        "options": "-c tcp_keepalives_idle=30 -c tcp_keepalives_interval=10 "
        "-c tcp_keepalives_count=3 -c idle_in_transaction_session_timeout=60000",
    },
}


def _patient(method: Callable[..., Result]) -> Callable[..., Result]:
    @wraps(method)
    def call(self: Database, *args: Any, **kwargs: Any) -> Result:
        return self._wait_for(method, self, *args, **kwargs)

    return call


# What Optuna calls, directly or through its cache.
_CALLS = {"_create_new_trial", "_set_trial_param", "_get_trials", "_get_best_trial_id"}
_CALLS |= BaseStorage.__abstractmethods__ | {"_get_stale_trial_ids"}
for _name in _CALLS:
    setattr(Database, _name, _patient(getattr(Database, _name)))

Storage = Journal | Database


def open_storage(storage: str | None, journal: Path, heartbeat: int, patience: float) -> Storage:
    """
    The storage that ``--storage`` names.

    :param storage: address of a database, or path of a journal file; None: ``journal``
    :param journal: the study's own journal file
    :param heartbeat: see :class:`Database`
    :param patience: see :class:`Database`
    :raises UsageError: it can't be opened
    """
    if storage is not None and "://" in storage:
        return Database(storage, heartbeat, patience)
    return Journal(journal if storage is None else Path(storage))


def _root(error: BaseException) -> BaseException:
    while isinstance(error, StorageInternalError | Outage) and error.__cause__ is not None:
        error = error.__cause__
    return error


def _cause(error: BaseException) -> str:
    """What a database driver says, without the statement and the links around it."""
    error = _root(error)
    return " ".join(str(getattr(error, "orig", None) or error).split())


def _is_outage(error: BaseException) -> bool:
    """Whether the database is away, rather than refusing what it was asked."""
    from sqlalchemy.exc import (
        DBAPIError,
        InterfaceError,
        OperationalError,
        PendingRollbackError,  # the connection was cut within a transaction, as noticed later
    )

    error = _root(error)
    if any(words in _cause(error) for words in ("authentication failed", "does not exist")):
        return False
    if isinstance(error, OperationalError | InterfaceError | PendingRollbackError):
        return True
    return isinstance(error, DBAPIError) and error.connection_invalidated

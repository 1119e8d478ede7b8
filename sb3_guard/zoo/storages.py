"""Where a study lives: a journal file for one machine, PostgreSQL for many.

Workers share nothing but the storage. Each takes its next trial inside :meth:`claim`, one at a
time, and marks the trial as its own; so the number of trials is exact, and a trial that nobody
works on any more is found: by the lock of its worker, which the operating system drops however the
worker ends, or, across machines, by its heartbeats.
"""

import copy
import os
import socket
import threading
import time
import uuid
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TypeVar

import optuna
from optuna.exceptions import ExperimentalWarning, StorageInternalError, UpdateFinishedTrialError
from optuna.storages import JournalStorage, RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import FrozenTrial, TrialState

from sb3_guard.zoo.usage import UsageError, one_line

try:
    import fcntl
except ImportError:  # Windows has no file locks of this kind
    fcntl = None  # type: ignore[assignment]

Result = TypeVar("Result")
# Trials that killed so many workers, e.g. for want of memory, are given up.
MOST_RETRIES = 3
OWNER = "worker"
# The number of the interrupted trial that a trial does again.
REPEATS = "repeats"


class StorageLost(UsageError):
    """The storage refuses to work, or went away and did not come back in time."""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock between processes of one machine, waiting for it; a dead process holds none."""
    with open(path, "a") as handle:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield


class _FileLock(JournalFileOpenLock):
    """
    A journal's lock that dies with its process; Optuna's own outlive it by half a minute.

    :param path: of the lock file, to which ``.lock`` is added
    """

    def __init__(self, path: str):
        super().__init__(path)
        self._handle: IO[str] | None = None

    def acquire(self) -> bool:
        """Wait for the lock."""
        handle = open(self._lock_file, "a")
        fcntl.flock(handle, fcntl.LOCK_EX)
        self._handle = handle
        return True

    def release(self) -> None:
        """Give it back."""
        if self._handle is not None:
            self._handle.close()
            self._handle = None


def _mend(path: Path, lock: JournalFileOpenLock) -> None:
    """Cut off what a full disk left of the last line, which would make the journal unreadable."""
    lock.acquire()
    try:
        content = path.read_bytes()
        end = content.rfind(b"\n") + 1
        if end < len(content):
            os.truncate(path, end)
    finally:
        lock.release()


class Journal:
    """
    A study in a file, shared by processes of one machine.

    :param path: the file; it is made if it is not there
    :raises UsageError: it can't be written
    """

    def __init__(self, path: Path):
        self.path = path.absolute()
        self.shown = str(path)
        self._workers = self.path.with_name(f"{self.path.name}.workers")
        self._worker = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        try:
            self._workers.mkdir(parents=True, exist_ok=True)
            kind = JournalFileOpenLock if fcntl is None else _FileLock
            lock = kind(str(self._workers / "journal"))
            if self.path.exists():
                _mend(self.path, lock)
            self.storage = JournalStorage(JournalFileBackend(str(self.path), lock))
            with locked(self._workers / "claim.lock"):
                for one in self._workers.glob(f"{socket.gethostname()}-*"):
                    self._is_gone(one.name)
                self._mine = open(self._workers / self._worker, "w")
                if fcntl is not None:
                    fcntl.flock(self._mine, fcntl.LOCK_EX)
        except OSError as error:
            raise UsageError(
                f"can't write the study {path}: {error.strerror}; choose another folder with -f"
            ) from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UsageError(f"{path} is not a study, or damaged: {one_line(error)}") from error

    def call(self, function: Callable[..., Result], *args: Any, **kwargs: Any) -> Result:
        """
        Do something with the storage.

        :raises StorageLost: the file can't be written
        """
        try:
            return function(*args, **kwargs)
        except OSError as error:
            raise StorageLost(
                f"can't write the study {self.path}: {error.strerror or one_line(error)}; what is "
                "in it is intact: the same command continues it"
            ) from error

    @contextmanager
    def claim(self, study: optuna.Study) -> Iterator[None]:
        """Be the only worker that takes a trial; trials of lost workers wait to be taken."""
        with locked(self._workers / "claim.lock"):
            for trial in _running(study):
                if not _has_owner(trial) or self._is_gone(trial.user_attrs[OWNER]["name"]):
                    _give_back(study, trial)
            yield

    def _is_gone(self, worker: str) -> bool:
        """Whether a worker has ended; what it left is tidied up."""
        if fcntl is None:
            return False
        path = self._workers / worker
        try:
            with open(path) as handle:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except FileNotFoundError:
            return True
        except OSError:
            return False
        path.unlink(missing_ok=True)
        return True

    def own(self, trial: optuna.Trial) -> None:
        """Mark a trial as taken by this process."""
        _set_owner(trial, self._worker)

    @contextmanager
    def working_on(self, trial: optuna.Trial) -> Iterator[None]:
        """Nothing to do here: the lock says that this process lives."""
        yield

    def close(self) -> None:
        """Give the worker's lock back."""
        self._mine.close()
        (self._workers / self._worker).unlink(missing_ok=True)


class Database:
    """
    A study in a PostgreSQL database, shared by any number of machines.

    :param url: ``postgresql://user:password@host:port/database``
    :param heartbeat: seconds between two signs of life of a trial; after three times as many
        without one it is given to another worker
    :param patience: how long to wait for a database that has gone away, seconds
    :raises UsageError: the driver is absent, the address is wrong, or nobody answers there
    """

    def __init__(self, url: str, heartbeat: int = 60, patience: float = 300.0):
        from sqlalchemy.engine import make_url
        from sqlalchemy.exc import (
            ArgumentError,
            IntegrityError,
            ProgrammingError,
            SQLAlchemyError,
        )

        self._errors = (SQLAlchemyError, StorageInternalError)
        self.heartbeat, self.patience = heartbeat, patience
        try:
            parsed = make_url(url)
        except (ArgumentError, ValueError) as error:
            raise UsageError(_not_an_address(url.partition("@")[2] or "…")) from error
        self.shown = parsed.render_as_string(hide_password=True)
        if parsed.get_backend_name() != "postgresql":
            raise UsageError(_not_an_address(self.shown))
        if parsed.drivername == "postgresql":
            parsed = parsed.set(drivername="postgresql+psycopg")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ExperimentalWarning)
                for attempt in range(5):
                    try:
                        self.storage = RDBStorage(
                            parsed.render_as_string(hide_password=False),
                            # Connections that a restart has cut are renewed; a server that
                            # no longer hears from a machine frees what that held.
                            engine_kwargs={
                                "pool_pre_ping": True,
                                "connect_args": {
                                    "connect_timeout": 10,
                                    "options": "-c tcp_keepalives_idle=30 "
                                    "-c tcp_keepalives_interval=10 "
                                    "-c tcp_keepalives_count=3",
                                },
                            },
                            heartbeat_interval=heartbeat,
                            grace_period=3 * heartbeat,
                            heartbeat_stale_trial_callback=_retry(),
                        )
                        break
                    except (IntegrityError, ProgrammingError):
                        # Another worker is making the tables of a new database at this moment.
                        if attempt == 4:
                            raise
                        time.sleep(1.0)
        except ImportError as error:
            raise UsageError(
                "--storage postgresql://… needs psycopg; install it with: "
                "pip install 'sb3-guard[postgres]'"
            ) from error
        except self._errors as error:
            raise UsageError(f"--storage: can't reach {self.shown}: {_cause(error)}") from error
        self._back_at = -float("inf")  # when the database last came back

    def call(self, function: Callable[..., Result], *args: Any, **kwargs: Any) -> Result:
        """
        Do something with the storage, again and again while the database is away.

        :param function: something that may be repeated
        :raises StorageLost: it stayed away for longer than ``patience``, or refuses
        """
        began, pause = time.monotonic(), 0.25
        while True:
            try:
                result = function(*args, **kwargs)
            except self._errors as error:
                away = time.monotonic() - began
                if not _is_outage(error):
                    raise StorageLost(f"{self.shown} refuses: {_cause(error)}") from error
                if away >= self.patience:
                    raise StorageLost(
                        f"{self.shown} has been out of reach for {away:.0f} s: {_cause(error)}; "
                        "its trials are intact: the same command continues the study"
                    ) from error
                if pause == 0.25:
                    print(f"{self.shown} is out of reach, trying again: {_cause(error)}")
                time.sleep(min(pause, self.patience - away))
                pause = min(2 * pause, 10.0)
            else:
                if pause > 0.25:
                    self._back_at = time.monotonic()
                    print(f"{self.shown} is back after {self._back_at - began:.0f} s")
                return result

    @contextmanager
    def claim(self, study: optuna.Study) -> Iterator[None]:
        """Be the only worker that takes a trial; trials of lost workers wait to be taken."""
        from sqlalchemy import text

        key = zlib.crc32(study.study_name.encode())
        with self.storage.engine.begin() as connection:
            connection.execute(text(f"SET LOCAL lock_timeout = '{max(int(self.patience), 1)}s'"))
            connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": key})
            # After an outage nobody's heart has beaten for a while: let them come back first.
            if time.monotonic() - self._back_at > 3 * self.heartbeat:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", ExperimentalWarning)
                    optuna.storages.fail_stale_trials(study)
            for trial in _running(study):
                if not _has_owner(trial):
                    _give_back(study, trial)
            yield

    def own(self, trial: optuna.Trial) -> None:
        """Mark a trial as taken by this process."""
        self.storage.record_heartbeat(trial._trial_id)
        _set_owner(trial, f"{socket.gethostname()}-{os.getpid()}")

    @contextmanager
    def working_on(self, trial: optuna.Trial) -> Iterator[None]:
        """Let the heart of a trial beat."""
        done = threading.Event()

        def beat() -> None:
            while not done.wait(self.heartbeat):
                try:
                    self.storage.record_heartbeat(trial._trial_id)
                except self._errors:
                    pass  # the next one may get through; the worker itself will notice an outage

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()

    def close(self) -> None:
        """Close the connections."""
        self.storage.engine.dispose()


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
    if storage is None:
        return Journal(journal)
    if "://" in storage:
        return Database(storage, heartbeat, patience)
    return Journal(Path(storage))


def _not_an_address(shown: str) -> str:
    return (
        f"--storage {shown} is not allowed; it must be postgresql://user:password@host/database, "
        "or the path of a journal file"
    )


def _cause(error: BaseException) -> str:
    """What a database driver says, without the statement and the links around it."""
    while isinstance(error, StorageInternalError) and error.__cause__ is not None:
        error = error.__cause__
    return " ".join(str(getattr(error, "orig", None) or error).split())


def _is_outage(error: BaseException) -> bool:
    """Whether the database is away, rather than refusing what it was asked."""
    from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError

    while isinstance(error, StorageInternalError) and error.__cause__ is not None:
        error = error.__cause__
    if isinstance(error, OperationalError | InterfaceError):
        return True
    return isinstance(error, DBAPIError) and error.connection_invalidated


def _running(study: optuna.Study) -> list[FrozenTrial]:
    return study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))


def _set_owner(trial: optuna.Trial, name: str) -> None:
    # With the number: a trial that is tried again inherits the attributes of the first.
    trial.set_user_attr(OWNER, {"name": name, "trial": trial.number})


def _has_owner(trial: FrozenTrial) -> bool:
    return trial.user_attrs.get(OWNER, {}).get("trial") == trial.number


def _retry() -> Callable[[optuna.Study, FrozenTrial], None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        return RetryHeartbeatStaleTrialCallback(max_retry=MOST_RETRIES)


def _give_back(study: optuna.Study, trial: FrozenTrial) -> None:
    """Queue a trial again whose worker is lost, and fail it."""
    # In this order: whoever dies in between leaves it as it was, not lost.
    if not _is_repeated(study, trial):
        _retry()(study, copy.deepcopy(trial))  # which writes to it
    with suppress(ValueError, UpdateFinishedTrialError):
        study.tell(trial.number, state=TrialState.FAIL)


def _is_repeated(study: optuna.Study, trial: FrozenTrial) -> bool:
    """Whether another trial is there to do it again."""
    return any(
        trial.number in (*one.system_attrs.get("retry_history", ()), one.system_attrs.get(REPEATS))
        for one in study.get_trials(deepcopy=False)
    )


def queue_again(study: optuna.Study, trial: FrozenTrial) -> None:
    """
    Queue a trial that is interrupted, with all it knows, unless that was done.

    This does not count as a retry. The trial is to be failed after that, see :func:`_give_back`.
    """
    if _is_repeated(study, trial):
        return
    study.add_trial(
        optuna.create_trial(
            state=TrialState.WAITING,
            params=trial.params,
            distributions=trial.distributions,
            user_attrs=trial.user_attrs,
            system_attrs={**trial.system_attrs, REPEATS: trial.number},
        )
    )

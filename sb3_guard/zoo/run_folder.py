"""One training run on disk, laid out as RL-Zoo lays it out, and owned by one process at a time."""

import glob
import json
import os
import socket
import tempfile
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from sb3_guard.common.files import replacing
from sb3_guard.zoo.usage import UsageError, one_line

try:
    import fcntl
except ImportError:  # Windows has no file locks of this kind: runs there are not guarded
    fcntl = None  # type: ignore[assignment]

CHECKPOINT = "checkpoint.zip"


def folder_name(env_id: str) -> str:
    """An environment id as part of a path: no module prefix, no slashes (RL-Zoo's rule)."""
    return env_id.rsplit(":", 1)[-1].replace("/", "-")


def require_writable(folder: Path, flag: str) -> None:
    """
    Find out whether a folder can be made or written to before work is lost; nothing is left there.

    :param folder: it need not exist yet
    :param flag: the flag that names it, for the message
    :raises UsageError: no file can be made in it, or in what exists of the path to it
    """
    try:
        existing = folder.absolute()
        while not existing.exists():
            existing = existing.parent
        # Permission bits mean little to root and on special file systems: only trying tells.
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise UsageError(
            f"{flag}: can't write to folder {str(folder)!r}: {error.strerror}; choose another"
        ) from error


class RunFolder:
    """
    The files of one run.

    ``<log folder>/<algo>/<env>_<k>/`` holds ``<env>/config.yml`` (hyper-parameters),
    ``<env>/args.yml`` (flags), ``<env>/command.txt``, ``0.monitor.csv``, ``progress.csv``,
    ``evaluations.npz``, ``best_model.zip``, ``rl_model_<steps>_steps.zip`` if asked for, the final
    model ``<env>.zip``, ``checkpoint.zip`` to resume from, and, once the run is complete,
    ``result.json``.

    :param path: the folder
    """

    def __init__(self, path: Path):
        self.path = path
        arguments = sorted(path.glob("*/args.yml"))
        if len(arguments) != 1:
            raise UsageError(f"{path} is not a run folder: it should hold one <env>/args.yml")
        self.params = arguments[0].parent
        self.name = self.params.name

    @classmethod
    def create(
        cls,
        log_folder: str,
        algo: str,
        env_id: str,
        args: Mapping[str, Any],
        hyperparams: Mapping[str, Any],
        command: str,
        unique: bool = False,
    ) -> "RunFolder":
        """
        Take the next free number and write down what the run is.

        :param args: all flags, plain data
        :param hyperparams: all hyper-parameters, plain data
        :param command: the command line
        :param unique: append a unique id to the name (``--uuid``)
        :raises UsageError: the folder can't be written to, or there is more than plain data
        """
        name = folder_name(env_id)
        files = _dump(args, hyperparams)
        parent = Path(log_folder) / algo
        suffix = f"_{uuid.uuid4()}" if unique else ""
        try:
            parent.mkdir(parents=True, exist_ok=True)
            number = latest_run(parent, name) + 1
            while True:
                path = parent / f"{name}_{number}{suffix}"
                try:
                    # Making the folder is what claims the number: another process may be here too.
                    path.mkdir()
                    break
                except FileExistsError:
                    number += 1
            params = path / name
            params.mkdir()
            (params / "command.txt").write_text(command)
            _write(params, files)
        except OSError as error:
            raise UsageError(
                f"can't write to log folder {log_folder!r}: {error.strerror}; "
                "choose another with -f"
            ) from error
        return cls(path)

    @classmethod
    def open(cls, path: str | Path) -> "RunFolder":
        """
        The run in a folder, or the one that a ``checkpoint.zip`` belongs to.

        :raises UsageError: it is not there, or it is not a run
        """
        path = Path(path)
        if not path.exists():
            raise UsageError(f"there is no run folder or file {path}")
        return cls(path if path.is_dir() else path.parent)

    @property
    def monitor(self) -> Path:
        """The csv of all training episodes."""
        return self.path / "0.monitor.csv"

    @property
    def checkpoint(self) -> Path:
        """What a killed run resumes from."""
        return self.path / CHECKPOINT

    @property
    def model(self) -> Path:
        """The final model."""
        return self.path / f"{self.name}.zip"

    @property
    def normalizer(self) -> Path:
        """Observation statistics of the final model, if it was trained with VecNormalize."""
        return self.params / "vecnormalize.pkl"

    @property
    def result(self) -> Path:
        """Written last: its presence says that the run is complete."""
        return self.path / "result.json"

    def args(self) -> dict[str, Any]:
        """The flags the run was started with."""
        return self._read("args.yml")

    def hyperparams(self) -> dict[str, Any]:
        """The hyper-parameters the run was started with."""
        return self._read("config.yml")

    def _read(self, name: str) -> dict[str, Any]:
        path = self.params / name
        try:
            content = yaml.safe_load(path.read_text())
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise UsageError(f"can't read {path}: {one_line(error)}") from error
        if not isinstance(content, dict):
            raise UsageError(f"{path} is damaged: it should be a mapping")
        return content

    def write_config(self, args: Mapping[str, Any], hyperparams: Mapping[str, Any]) -> None:
        """Replace what :meth:`create` wrote, e.g. when a finished run is to go on for longer."""
        _write(self.params, _dump(args, hyperparams))

    def write_result(self, result: Mapping[str, Any]) -> None:
        """Mark the run as complete."""
        with replacing(self.result) as file:
            file.write(json.dumps(result, indent=2).encode())

    @contextmanager
    def owned(self) -> Iterator[None]:
        """
        Hold the run's lock, so that no other process writes to it meanwhile.

        The operating system drops the lock of a process that dies, however it dies; the file then
        still names it, and the next process takes over.

        :raises UsageError: another process has it, or a process on another host may have it
        """
        if fcntl is None:
            yield
            return
        path = self.path / ".lock"
        me = {"host": socket.gethostname(), "pid": os.getpid()}
        try:
            handle = open(path, "a+")
        except OSError as error:
            raise UsageError(f"can't write to {self.path}: {error.strerror}") from error
        with handle:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                free = True
            except OSError:
                free = False
            handle.seek(0)
            try:
                owner = json.loads(handle.read() or "{}")
            except json.JSONDecodeError:
                owner = {}
            if not free or owner.get("host", me["host"]) != me["host"]:
                # Locks may not reach other hosts: there, only a person can know.
                raise UsageError(
                    f"{self.path} is in use by process {owner.get('pid')} on {owner.get('host')}; "
                    f"if that is gone, remove {path}"
                )
            handle.truncate(0)
            handle.write(json.dumps(me))
            handle.flush()
            try:
                yield
            finally:
                handle.truncate(0)


def _dump(args: Mapping[str, Any], hyperparams: Mapping[str, Any]) -> dict[str, bytes]:
    """The configuration files, by name."""
    files = {}
    for name, content in (("config.yml", hyperparams), ("args.yml", args)):
        try:
            files[name] = yaml.safe_dump(dict(content)).encode()
        except yaml.YAMLError as error:
            raise UsageError(
                f"{name} can hold plain data only; write classes and calls as text, such as "
                f"policy_kwargs: dict(activation_fn=nn.ReLU) ({one_line(error)})"
            ) from error
    return files


def _write(params: Path, files: Mapping[str, bytes]) -> None:
    # args.yml is what makes a folder a run, so it comes last.
    for name, content in files.items():
        with replacing(params / name) as file:
            file.write(content)


def latest_run(parent: Path, name: str) -> int:
    """The greatest number of the runs of an environment, 0 if there is none."""
    from rl_zoo3.utils import get_latest_run_id

    return int(get_latest_run_id(glob.escape(str(parent)), name))

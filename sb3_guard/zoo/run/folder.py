"""One training run on disk, laid out as RL-Zoo lays it out, and owned by one process at a time."""

import csv
import glob
import hashlib
import json
import shlex
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import yaml
from filelock import SoftFileLock, Timeout

from sb3_guard.common.files import replacing
from sb3_guard.zoo.cli.usage import UsageError, explained, packages_flag, read_mapping
from sb3_guard.zoo.run.flags import RunFlags

CHECKPOINT = "checkpoint.zip"
# What a result measures: return, episode cost and cost rate; null where no episode has ended.
MEASURES = ("return", "cost", "cost_rate")
# What is played after training, by its name in a result, in words.
PLAYED = {"stochastic": "sampled actions", "greedy": "most likely actions"}
EPOCH = 30_000  # steps, the paper's; of algorithms whose rollouts are a few steps long
PATIENCE = 1.0  # seconds after which a lock that says nothing is that of a process that died


class RunInUse(UsageError):
    """Another process has the run."""


def folder_name(env_id: str) -> str:
    """An environment id as part of a path: no module prefix, no slashes (RL-Zoo's rule)."""
    return env_id.rsplit(":", 1)[-1].replace("/", "-")


def run_path(log_folder: str, algo: str, env_id: str, number: int) -> Path:
    """The folder of a run: ``<log folder>/<algo>/<env>_<number>``."""
    return Path(log_folder) / algo / f"{folder_name(env_id)}_{number}"


def claim(parent: Path, name: str, suffix: str = "") -> Path:
    """
    Make a folder with the next free number.

    :param parent: the algorithm's folder, which exists
    :param name: the environment's, see :func:`folder_name`
    """
    number = latest_run(parent, name) + 1
    while True:
        path = parent / f"{name}_{number}{suffix}"
        try:
            # Making the folder claims the number: another process may be here too.
            path.mkdir()
            return path
        except FileExistsError:
            number += 1


def is_run(path: Path) -> bool:
    """Whether a folder holds a run, rather than nothing yet or what was left half made."""
    return any(path.glob("*/args.yml"))


class RunFolder:
    """
    The files of one run.

    ``<log folder>/<algo>/<env>_<k>/`` holds ``<env>/config.yml`` (hyperparameters),
    ``<env>/args.yml`` (flags), ``<env>/command.txt``, ``0.monitor.csv``, ``progress.csv``,
    ``evaluations.npz``, ``best_model.zip``, ``rl_model_<steps>_steps.zip`` if asked for, the final
    model ``<env>.zip``, ``checkpoint.zip`` to resume from, and, once the run is complete,
    ``result.json``.

    :param path: the folder, or the ``checkpoint.zip`` in it
    :raises UsageError: it is not there, or it is not a run
    """

    def __init__(self, path: Path):
        path = path.parent if path.name == CHECKPOINT else path
        if not path.exists():
            raise UsageError(f"there is no run folder {path}")
        self.path = path
        arguments = sorted(path.glob("*/args.yml"))
        if len(arguments) != 1:
            raise UsageError(f"{path} is not a run folder: it should hold one <env>/args.yml")
        self.params = arguments[0].parent
        self.name = self.params.name
        #: the csv of all training episodes
        self.monitor = path / "0.monitor.csv"
        #: what a killed run resumes from
        self.checkpoint = path / CHECKPOINT
        #: the final model, and its observation statistics if it was trained with VecNormalize
        self.model, self.normalizer = path / f"{self.name}.zip", self.params / "vecnormalize.pkl"
        #: written last: its presence says that the run is complete
        self.result = path / "result.json"

    @classmethod
    def create(
        cls,
        flags: RunFlags,
        hyperparams: Mapping[str, Any],
        command: str,
        path: Path | None = None,
    ) -> "RunFolder":
        """
        Take a folder and write down what the run is.

        :param flags: all flags
        :param hyperparams: all hyperparameters, plain data
        :param command: the command line
        :param path: its folder, on which the caller has :func:`lock`; None: the next free number
        :raises UsageError: the folder can't be written to
        """
        name = folder_name(flags.env)
        parent = Path(flags.log_folder) / flags.algo
        with explained(f"can't write to {path or parent}", OSError):
            if path is None:
                parent.mkdir(parents=True, exist_ok=True)
                path = claim(parent, name, f"_{uuid.uuid4()}" if flags.uuid else "")
            params = path / name
            params.mkdir(parents=True, exist_ok=True)
            (params / "command.txt").write_text(command, encoding="utf-8")
            write_config(params, flags, hyperparams)
        return cls(path)

    def args(self) -> dict[str, Any]:
        """The flags the run was started with."""
        return read_mapping(self.params / "args.yml", "the run's file", "names to values")

    def flags(self) -> RunFlags:
        """
        The flags the run was started with.

        :raises UsageError: one has a value that it can't have
        """
        return RunFlags.read(self.args(), self.params / "args.yml")

    def hyperparams(self) -> dict[str, Any]:
        """The hyperparameters the run was started with."""
        return read_mapping(self.params / "config.yml", "the run's file", "names to values")

    def events(self, flags: RunFlags) -> Path:
        """The folder of its TensorBoard events, with its number: a resumed run finds it again."""
        name = f"{flags.algo}{self.path.name[len(self.name) :]}"
        return Path(flags.tensorboard_log) / self.name / name

    def again(self) -> str:
        """The command that continues the run, for messages."""
        named = {"tensorboard_log", "track"}  # the command line names them again
        flags = {name: value for name, value in self.args().items() if name in named and value}
        words = map(shlex.quote, RunFlags.of(flags).words(named))
        return " ".join([self._command("train -i"), *words])

    def play(self) -> str:
        """The command that plays the agent, for messages."""
        return self._command("enjoy -f")

    def _command(self, words: str) -> str:
        path, packages = shlex.quote(str(self.path)), self.args().get("gym_packages") or ()
        return f"sb3-guard {words} {path}{packages_flag(packages)}"

    def curve_hash(self) -> str:
        """SHA-256 of step, return and cost of all training episodes: runs alike have the same."""
        digest, step = hashlib.sha256(), 0
        with self.monitor.open(newline="") as file:
            next(file, "")  # SB3's header, which has the time
            for episode in csv.DictReader(file):
                step += int(episode["l"])
                digest.update(f"{step},{episode['r']},{episode['c']}\n".encode())
        return digest.hexdigest()

    def write_result(self, result: Mapping[str, Any]) -> None:
        """Mark the run as complete."""
        with replacing(self.result) as file:
            file.write(json.dumps(result, indent=2).encode())

    def checked_result(self) -> dict[str, Any]:
        """
        The result of a complete run.

        :raises UsageError: the run is not finished, or the file is damaged
        """
        if not self.result.exists():
            raise UsageError(f"unfinished: {self.again()} continues it")
        fix = f"{self.again()} writes it again"
        with explained("result.json is damaged", fix=fix):
            result: dict[str, Any] = json.loads(self.result.read_bytes())
            _ = result["costs"]  # every result has them
        return result

    def read_result(self) -> dict[str, Any] | None:
        """The result of a complete run; None if there is none, or it is damaged."""
        try:
            return self.checked_result()
        except UsageError:
            return None


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """
    Hold a run's lock, so that no other process writes to it meanwhile.

    The lock of a process that died on this host is taken over; that of another host, of which
    nothing is known, stays until somebody removes it.

    :param folder: it exists, and is a run or about to become one
    :raises RunInUse: another process has it
    :raises UsageError: the folder can't be written to
    """
    path = folder / ".lock"
    held = SoftFileLock(path, timeout=PATIENCE, is_singleton=False)
    with explained(f"can't write to {folder}", OSError):
        try:
            held.acquire()
        except Timeout:
            with TemporaryFile(dir=folder) as room:  # on a full disk no lock can be taken over
                room.write(b"room")
            owner = path.read_text().split("\n")
            if owner != [""]:
                raise RunInUse(
                    f"{folder} is in use by process {owner[0]} on {owner[1]}; if that is gone, "
                    f"remove {path}"
                ) from None
            path.unlink()  # its process died before it wrote who it is
            held.acquire()
    try:
        yield
    finally:
        held.release()


def write_config(params: Path, flags: RunFlags, hyperparams: Mapping[str, Any]) -> None:
    """Write down what a run is; ``args.yml``, which makes a folder a run, comes last."""
    for name, content in (("config.yml", dict(hyperparams)), ("args.yml", flags.values())):
        with replacing(params / name) as file:
            file.write(yaml.safe_dump(content).encode())


def latest_run(parent: Path, name: str) -> int:
    """The greatest number of the runs of an environment, 0 if there is none."""
    from rl_zoo3.utils import get_latest_run_id

    return int(get_latest_run_id(glob.escape(str(parent)), name))

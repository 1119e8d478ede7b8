"""A PostgreSQL server of one's own on loopback, for tests; Debian: apt-get install postgresql."""

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Server:
    """
    A server, which refuses to run as root.

    :param programs: folder of ``initdb`` and ``pg_ctl``
    :param folder: of its data
    """

    def __init__(self, programs: Path, folder: Path):
        self.programs, self.data, self.port = programs, folder / "data", free_port()
        self.prefix = ["runuser", "-u", "postgres", "--"] if os.getuid() == 0 else []
        self.url = f"postgresql://tuner:secret@127.0.0.1:{self.port}/postgres"
        self._run("initdb", "-U", "tuner", "-A", "trust", "--no-sync", "-D", str(self.data))

    def _run(self, program: str, *arguments: str) -> None:
        command = [*self.prefix, str(self.programs / program), *arguments]
        with open(self.data.parent.parent / "log", "ab") as log:
            subprocess.run(command, check=True, timeout=60, stdout=log, stderr=log, cwd="/")

    def start(self) -> None:
        """Start it and wait until it answers."""
        options = f"-p {self.port} -c listen_addresses=127.0.0.1 -k {self.data} -c fsync=off"
        log = str(self.data.parent / "server.log")
        self._run("pg_ctl", "start", "-w", "-D", str(self.data), "-o", options, "-l", log)

    @property
    def runs(self) -> bool:
        """Whether it was started and not stopped."""
        return (self.data / "postmaster.pid").exists()

    def stop(self, mode: str = "fast") -> None:
        """
        Stop it.

        :param mode: ``"immediate"`` is a crash: it recovers from its log at the next start
        """
        self._run("pg_ctl", "stop", "-w", "-m", mode, "-D", str(self.data))


def programs() -> Path | None:
    """Where PostgreSQL's programs are; None if they are not installed."""
    found = shutil.which("initdb")
    if found:
        return Path(found).parent
    return max(Path("/usr/lib/postgresql").glob("*/bin"), default=None)


@contextmanager
def running() -> Iterator[Server]:
    """A running server, removed at the end."""
    where = programs()
    assert where is not None, "PostgreSQL is not installed"
    outer = Path(tempfile.mkdtemp(prefix="postgres-"))
    try:
        outer.chmod(0o755)
        folder = outer / "cluster"
        folder.mkdir()
        if os.getuid() == 0:
            shutil.chown(folder, "postgres")
        one = Server(where, folder)
        one.start()
        try:
            yield one
        finally:
            if one.runs:
                one.stop()
    finally:
        shutil.rmtree(outer)

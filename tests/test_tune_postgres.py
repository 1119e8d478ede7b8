"""Workers that share a study through a real PostgreSQL server on loopback."""

import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import optuna
import pandas as pd
import pytest
from processes import fresh, wait_for

from sb3_guard import tune
from sb3_guard.zoo import storages, tuning

pytest.importorskip("psycopg", reason="psycopg is not installed")

TOY = (
    "--algo trpo_lag --gym-packages registered_envs --env CostPoint-v0 --env-kwargs "
    "episode_length:20 -params n_envs:2 n_steps:30 n_critic_updates:3 --eval-episodes 2 "
    "--device cpu --num-threads 1 --pruner none --heartbeat 1"
).split()


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Server:
    """A PostgreSQL server of its own, which refuses to run as root."""

    def __init__(self, programs: Path, folder: Path):
        self.programs, self.data, self.port = programs, folder / "data", free_port()
        self.prefix = ["runuser", "-u", "postgres", "--"] if os.getuid() == 0 else []
        self.url = f"postgresql://tuner:secret@127.0.0.1:{self.port}/postgres"
        self.run("initdb", "-U", "tuner", "-A", "trust", "--no-sync", "-D", str(self.data))

    def run(self, program: str, *arguments: str) -> None:
        command = [*self.prefix, str(self.programs / program), *arguments]
        with open(self.data.parent.parent / "log", "ab") as log:
            subprocess.run(command, check=True, timeout=60, stdout=log, stderr=log, cwd="/")

    def start(self) -> None:
        options = f"-p {self.port} -c listen_addresses=127.0.0.1 -k {self.data} -c fsync=off"
        log = str(self.data.parent / "server.log")
        self.run("pg_ctl", "start", "-w", "-D", str(self.data), "-o", options, "-l", log)

    def stop(self) -> None:
        self.run("pg_ctl", "stop", "-w", "-m", "fast", "-D", str(self.data))


def programs() -> Path | None:
    """Where the server's programs are."""
    found = shutil.which("initdb")
    if found:
        return Path(found).parent
    return max(Path("/usr/lib/postgresql").glob("*/bin"), default=None)


@pytest.fixture
def server() -> Iterator[Server]:
    where = programs()
    if where is None:
        pytest.skip("there is no PostgreSQL server here (no initdb)")
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
            if (one.data / "postmaster.pid").exists():
                one.stop()
    finally:
        shutil.rmtree(outer)


def load(server: Server) -> optuna.Study:
    url = server.url.replace("postgresql:", "postgresql+psycopg:")
    return optuna.load_study(study_name="trpo_lag_CostPoint-v0", storage=url)


def owners(study: optuna.Study, state: optuna.trial.TrialState) -> list[int]:
    """Process ids of the workers whose trials are in a state."""
    trials = study.get_trials(deepcopy=False, states=(state,))
    names = [one.user_attrs.get(storages.OWNER, {}).get("name", "-0") for one in trials]
    return [int(name.rsplit("-", 1)[1]) for name in names]


def arguments(server: Server, folder: Path, *more: str) -> list[str]:
    return [*TOY, "--storage", server.url, "-f", str(folder), *more]


@pytest.mark.slow  # two trainings at once, half a minute
def test_a_killed_workers_trial_is_done_by_the_other(server, tmp_path):
    command = arguments(server, tmp_path, "-n", "1920", "--n-trials", "5")
    first = fresh(tune.main, command, tmp_path / "first.txt")
    second = fresh(tune.main, command, tmp_path / "second.txt")
    wait_for(lambda: "Study" in (tmp_path / "first.txt").read_text())
    study = load(server)
    running, done = optuna.trial.TrialState.RUNNING, optuna.trial.TrialState.COMPLETE
    both = {first.pid, second.pid}
    wait_for(lambda: both <= {*owners(study, running), *owners(study, done)})
    wait_for(lambda: first.pid in owners(study, running))
    first.kill()
    first.join(60)
    second.join(120)
    assert first.exitcode == -signal.SIGKILL
    assert second.exitcode == 0, (tmp_path / "second.txt").read_text()
    states = Counter(one.state.name for one in study.trials)
    assert states == {"COMPLETE": 5, "FAIL": 1}
    (lost,) = (one for one in study.trials if one.state.name == "FAIL")
    (again,) = (one for one in study.trials if one.system_attrs.get("failed_trial") == lost.number)
    assert lost.params.items() <= again.params.items()
    assert again.state.name == "COMPLETE"
    table = pd.read_csv(tmp_path / "trpo_lag" / "CostPoint-v0_tune" / "trials.csv")
    assert table["retry_of"].dropna().tolist() == [lost.number]
    output = (tmp_path / "second.txt").read_text()
    for word in ("Traceback", "Warning", "secret"):
        assert word not in output
    assert f"optuna-dashboard postgresql://tuner:***@127.0.0.1:{server.port}" in output


@pytest.mark.filterwarnings("ignore:Heartbeat of storage")
def test_hearts_beat_and_silence_is_forgiven_after_an_outage(server):
    one, other = (storages.Database(server.url, heartbeat=1) for _ in range(2))
    study = optuna.create_study(study_name="beats", storage=one.storage)

    def claimed() -> dict[str, int]:
        seen = optuna.load_study(study_name="beats", storage=other.storage)
        with other.claim(seen):
            return dict(Counter(trial.state.name for trial in seen.trials))

    with one.claim(study):
        trial = study.ask()
        one.own(trial)
    with one.working_on(trial):
        time.sleep(4.5)  # longer than the three beats of grace
        assert claimed() == {"RUNNING": 1}
    time.sleep(4.5)
    other._back_at = time.monotonic()
    assert claimed() == {"RUNNING": 1}
    other._back_at = -float("inf")
    assert claimed() == {"FAIL": 1, "WAITING": 1}
    for storage in (one, other):
        storage.close()


def interrupt_at(monkeypatch, steps: int, action: Callable[[], object]) -> None:
    """Do something once, in the middle of the first training."""
    whole, done = tuning.Evaluations._on_step, []

    def step(self):
        if self.num_timesteps >= steps and not done:
            done.append(True)
            action()
        return whole(self)

    monkeypatch.setattr(tuning.Evaluations, "_on_step", step)


def test_an_outage_is_waited_for(server, tmp_path, monkeypatch, capsys):
    def restart() -> None:
        server.stop()
        threading.Timer(1.0, server.start).start()

    interrupt_at(monkeypatch, 70, restart)
    assert tune.main(arguments(server, tmp_path, "-n", "240", "--n-trials", "2")) == 0
    out = capsys.readouterr().out
    assert "is out of reach, trying again" in out and "is back after" in out
    assert Counter(one.state.name for one in load(server).trials) == {"COMPLETE": 2}


def test_gone_for_good_is_a_clear_error(server, tmp_path, monkeypatch, capsys):
    interrupt_at(monkeypatch, 70, server.stop)
    command = arguments(server, tmp_path, "-n", "240", "--n-trials", "2")
    assert tune.main([*command, "--storage-timeout", "1"]) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err and "secret" not in out + err
    (line,) = err.splitlines()
    assert line.startswith("error: postgresql://tuner:***@127.0.0.1")
    assert "out of reach for" in line and "the same command continues the study" in line
    server.start()
    assert tune.main(command) == 0
    assert Counter(one.state.name for one in load(server).trials) == {"COMPLETE": 2, "FAIL": 1}


@pytest.mark.parametrize(
    ("url", "parts"),
    [
        ("postgresql://me:secret@127.0.0.1:{port}/x", ["can't reach", "me:***@127.0.0.1"]),
        ("mysql://me:secret@127.0.0.1/x", ["must be postgresql://", "me:***@127.0.0.1"]),
        ("postgresql://me:secret@127.0.0.1:port/x", ["must be postgresql://"]),
    ],
)
def test_wrong_addresses(tmp_path, capsys, url, parts):
    command = [*TOY, "--storage", url.format(port=free_port()), "-f", str(tmp_path), "-n", "60"]
    assert tune.main(command) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err and "secret" not in out + err
    assert len(err.splitlines()) == 1
    for part in parts:
        assert part in err
    assert list(tmp_path.iterdir()) == []

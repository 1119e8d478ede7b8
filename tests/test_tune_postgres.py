"""Workers that share a study through a real PostgreSQL server on loopback."""

import copy
import itertools
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import optuna
import pytest
from kill_tuner import campaign, faults
from optuna.trial import TrialState
from postgres import Server, free_port, programs, running
from sqlalchemy import create_engine, text
from sqlalchemy.exc import PendingRollbackError

from sb3_guard import tune
from sb3_guard.zoo import studies, trials
from sb3_guard.zoo.studies import Database, Study

psycopg = pytest.importorskip("psycopg", reason="psycopg is not installed")
pytestmark = pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")

TOY = (
    "--algo trpo_lag --gym-packages registered_envs --env CostPoint-v0 --env-kwargs "
    "episode_length:20 -params n_envs:2 n_steps:30 n_critic_updates:3 --eval-episodes 2 "
    "--device cpu --num-threads 1 --pruner none --heartbeat 1 -n 240 --n-trials 2"
).split()


NUMBERS = itertools.count()


@pytest.fixture(scope="module")
def cluster() -> Iterator[Server]:
    if programs() is None:
        pytest.skip("there is no PostgreSQL server here (no initdb)")
    with running() as one:
        yield one


@pytest.fixture
def server(cluster: Server) -> Iterator[Server]:
    """A new database of the server, which may be stopped."""
    one, name = copy.copy(cluster), f"test_{next(NUMBERS)}"
    execute(cluster, f"CREATE DATABASE {name}")
    one.url = cluster.url.replace("/postgres", f"/{name}")
    yield one
    if not one.runs:
        one.start()


def execute(server: Server, statement: str) -> None:
    with psycopg.connect(server.url, autocommit=True) as connection:
        connection.execute(statement)


def states(server: Server) -> Counter[str]:
    url = server.url.replace("postgresql:", "postgresql+psycopg:")
    study = optuna.load_study(study_name="trpo_lag_CostPoint-v0", storage=url)
    return Counter(one.state.name for one in study.trials)


@pytest.mark.slow
def test_no_trial_is_lost_whatever_is_killed(server, tmp_path):
    study = campaign(server.url, tmp_path, n_trials=12, n_workers=3, kills=10, server=server)
    assert faults(study, 12) == []


def test_silence_is_forgiven_after_an_outage(server, monkeypatch):
    storages = [Database(server.url, heartbeat=60) for _ in range(2)]
    optuna.create_study(study_name="beats", storage=storages[0])
    one, other = (Study("beats", storage, 1) for storage in storages)
    one._thread_local.in_optimize_loop = True

    def pass_an_hour() -> None:
        execute(server, "UPDATE trial_heartbeats SET heartbeat = heartbeat - interval '1 hour'")

    def seen_by_other() -> list[str]:
        optuna.storages.fail_stale_trials(other)
        return [trial.state.name for trial in other.trials]

    trial = one.ask()  # whose heart never beats again
    pass_an_hour()
    storages[1]._trusted_from = float("inf")  # as after an outage
    assert seen_by_other() == ["RUNNING"]
    storages[0].record_heartbeat(trial._trial_id)
    storages[1]._trusted_from = 0.0
    assert seen_by_other() == ["RUNNING"]
    pass_an_hour()
    assert seen_by_other() == ["FAIL"]
    other._repeat_lost_trials()
    assert seen_by_other() == ["FAIL", "WAITING"]
    with pytest.raises(optuna.exceptions.UpdateFinishedTrialError):
        one._storage.set_trial_state_values(trial._trial_id, TrialState.COMPLETE, [1.0])
    for storage in storages:
        storage.close()


def interrupt_at(monkeypatch, steps: int, action: Callable[[], object]) -> None:
    """Do something once, in the middle of the first training."""
    whole, done = trials.Evaluations._on_step, []

    def step(self):
        if self.num_timesteps >= steps and not done:
            done.append(True)
            action()
        return whole(self)

    monkeypatch.setattr(trials.Evaluations, "_on_step", step)


def test_an_outage_is_waited_for_at_the_start_and_later(server, tmp_path, monkeypatch, capsys):
    lock = threading.Lock()

    def pause(seconds: float) -> None:
        with lock:  # the heart's thread notices, too
            if not server.runs:
                server.start()

    clock = SimpleNamespace(monotonic=time.monotonic, sleep=pause)
    monkeypatch.setattr(studies, "time", clock)
    interrupt_at(monkeypatch, 70, lambda: server.stop("immediate"))
    server.stop("immediate")
    assert tune.main([*TOY, "--storage", server.url, "-f", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert out.count("is out of reach, trying again") >= 2 and "is back after" in out
    assert "secret" not in out + err and "Traceback" not in out + err
    assert f"optuna-dashboard postgresql://tuner:***@127.0.0.1:{server.port}" in out
    assert states(server) == {"COMPLETE": 2}


def test_gone_for_good_is_a_clear_error(server, tmp_path, monkeypatch, capsys):
    interrupt_at(monkeypatch, 70, server.stop)
    command = [*TOY, "--storage", server.url, "-f", str(tmp_path)]
    assert tune.main([*command, "--storage-timeout", "1"]) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err and "secret" not in out + err
    (line,) = err.splitlines()
    assert line.startswith("error: postgresql://tuner:***@127.0.0.1")
    assert "the same command continues the study" in line
    server.start()
    assert tune.main(command) == 0
    assert states(server) == {"COMPLETE": 2, "FAIL": 1}


@pytest.mark.parametrize(
    ("url", "parts"),
    [
        ("postgresql://me:secret@127.0.0.1:{port}/x", ["out of reach", "me:***@127.0.0.1"]),
        ("mysql://me:secret@127.0.0.1/x", ["must be postgresql://", "me:***@127.0.0.1"]),
        ("postgresql://me:secret@127.0.0.1:port/x", ["must be postgresql://"]),
    ],
)
def test_wrong_addresses(tmp_path, capsys, url, parts):
    command = [*TOY, "--storage", url.format(port=free_port()), "-f", str(tmp_path)]
    assert tune.main([*command, "--storage-timeout", "0"]) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err and "secret" not in out + err
    assert len(err.splitlines()) == 1
    for part in parts:
        assert part in err
    assert list(tmp_path.iterdir()) == []


def test_a_database_that_is_not_there_is_not_waited_for(cluster, tmp_path, capsys):
    url = cluster.url.replace("/postgres", "/nowhere")
    assert tune.main([*TOY, "--storage", url, "-f", str(tmp_path)]) == 2
    assert '"nowhere" does not exist' in capsys.readouterr().err


def test_a_transaction_that_was_cut_is_an_outage():
    with create_engine("sqlite://").connect() as connection:
        connection.execute(text("SELECT 1"))
        connection.invalidate()
        with pytest.raises(PendingRollbackError) as cut:
            connection.execute(text("SELECT 1"))
    assert studies._is_outage(cut.value)

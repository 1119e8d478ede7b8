"""Workers that share a study through a real PostgreSQL server on loopback."""

import copy
import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterator

import optuna
import pytest
from kills import campaign, faults
from postgres import Server, free_port, programs, running
from sqlalchemy.exc import OperationalError
from typed import refused

from sb3_guard import tune
from sb3_guard.zoo.tuning import studies, trials

psycopg = pytest.importorskip("psycopg", reason="psycopg is not installed")
pytestmark = [
    pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning"),
    pytest.mark.filterwarnings("ignore:Heartbeat of storage:UserWarning"),
]

TOY = (
    "--algo trpo_lag --gym-packages registered_envs --env CostPoint-v0 --env-kwargs "
    "episode_length:20 -params n_envs:2 n_steps:30 n_critic_updates:3 cost_limit:2 "
    "--eval-episodes 2 --device cpu --num-threads 1 --pruner none -n 240 --n-trials 2"
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


def trials_of(server: Server) -> list[optuna.trial.FrozenTrial]:
    url = server.url.replace("postgresql:", "postgresql+psycopg:")
    return optuna.load_study(study_name="trpo_lag_CostPoint-v0", storage=url).trials


def states(server: Server) -> Counter[str]:
    return Counter(one.state.name for one in trials_of(server))


@pytest.mark.slow
def test_no_trial_is_lost_whatever_is_killed(server, tmp_path):
    study = campaign(server.url, tmp_path, n_trials=12, n_workers=3, kills=10, server=server)
    assert faults(study) == []


@pytest.mark.slow
def test_the_trial_of_a_silent_worker_is_done_again(server, tmp_path, monkeypatch):
    """By whoever begins a trial after the silence."""
    monkeypatch.setattr(studies, "GRACE", 2)

    def lose_another() -> None:
        """A trial whose heart stops."""
        storage, _ = studies.open_storage(server.url, tmp_path)
        lost = optuna.load_study(study_name="trpo_lag_CostPoint-v0", storage=storage).ask()
        storage.record_heartbeat(lost.number + 1)  # the number in its table
        time.sleep(3.0)

    interrupt_at(monkeypatch, 70, lose_another)
    assert tune.main([*TOY, "--storage", server.url, "-f", str(tmp_path)]) == 0
    done = [one.system_attrs.get("retry_history") for one in trials_of(server) if one.values]
    assert states(server)["FAIL"] == 1 and [1] in done


def interrupt_at(monkeypatch, steps: int, action: Callable[[], object]) -> None:
    """Do something once, in the middle of the first training."""
    whole, done = trials.Evaluations._on_step, []

    def step(self):
        if self.num_timesteps >= steps and not done:
            done.append(True)
            action()
        return whole(self)

    monkeypatch.setattr(trials.Evaluations, "_on_step", step)


def test_a_restart_between_two_calls_goes_unnoticed(server, tmp_path, monkeypatch, capsys):
    def restart() -> None:
        server.stop("immediate")
        server.start()

    interrupt_at(monkeypatch, 70, restart)
    assert tune.main([*TOY, "--storage", server.url, "-f", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert "secret" not in out + err and "Traceback" not in out + err
    assert f"optuna-dashboard postgresql://tuner:***@127.0.0.1:{server.port}" in out
    assert states(server) == {"COMPLETE": 2}


def test_a_trial_whose_connection_is_cut_is_done_again(server, tmp_path, monkeypatch, capsys):
    """Within a call, when the database is back at once: Optuna can still say that it failed."""

    def cut() -> None:
        raise OperationalError("UPDATE …", {}, Exception("the connection was cut"))

    interrupt_at(monkeypatch, 70, cut)
    command = [*TOY, "--storage", server.url, "-f", str(tmp_path)]
    refused(tune.main, command, capsys, "the connection was cut", "the same command continues")
    assert states(server) == {"FAIL": 1, "WAITING": 1}


@pytest.mark.slow
def test_a_database_that_is_gone_ends_the_worker_with_a_line(server, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(studies, "HEARTBEAT", 1)
    monkeypatch.setattr(studies, "GRACE", 2)

    def stop() -> None:
        server.stop()
        time.sleep(1.5)  # until the heart notices, too

    interrupt_at(monkeypatch, 70, stop)
    command = [*TOY, "--storage", server.url, "-f", str(tmp_path)]
    assert tune.main(command) == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err and "secret" not in out + err
    (line,) = err.splitlines()
    assert line.startswith("error: the study's database fails: ")
    assert "the same command continues the study" in line
    server.start()
    time.sleep(2.5)  # the trial of the worker that ended is lost by now
    assert tune.main(command) == 0
    assert states(server) == {"COMPLETE": 2, "FAIL": 1}


@pytest.mark.parametrize(
    ("url", "parts"),
    [
        ("postgresql://me:secret@127.0.0.1:{port}/x", ["database fails", "refused"]),
        ("mysql://me:secret@127.0.0.1/x", ["must be postgresql://", "me:***@127.0.0.1"]),
    ],
)
def test_wrong_addresses(tmp_path, capsys, url, parts):
    command = [*TOY, "--storage", url.format(port=free_port()), "-f", str(tmp_path)]
    assert "secret" not in refused(tune.main, command, capsys, *parts)
    assert list(tmp_path.iterdir()) == []

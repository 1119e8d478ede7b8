"""Tuning: what is searched, what counts as best, and that nothing is lost on the way."""

import gc
import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import optuna
import pandas as pd
import pytest
from cost_envs import CostPoint
from kills import campaign, faults, work
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState, create_trial
from processes import fresh, wait_for
from typed import refused

from sb3_guard import train, tune
from sb3_guard.algorithms import ALGORITHMS, TRPO
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.hyperparams import (
    annotations,
    check,
    model_arguments,
    parameters,
    read_hyperparams,
)
from sb3_guard.zoo.tuning import studies, trials
from sb3_guard.zoo.tuning.report import best
from sb3_guard.zoo.tuning.spaces import RELATIVES, SAMPLERS, Search, read_space, space_of

pytestmark = pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")

TOY = (
    "--algo trpo_lag --gym-packages registered_envs --env CostPoint-v0 --env-kwargs "
    "episode_length:20 --eval-episodes 2 --device cpu --num-threads 1 -n 240"
).split()
SMALL = "-params n_envs:2 n_steps:30 n_critic_updates:3 cost_limit:2".split()
SUPPORT = Path(__file__).parents[1] / "support"
OFF_POLICY = ("sac_lag", "td3_lag", "tqc_lag")
SHIPPED_KL = 0.02


def draw(search: Search, seed: int = 0) -> dict:
    """What a random trial tries."""
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=seed))
    return search.draw(study.ask())


def shipped(algo: str, env_id: str = "Goal_Point_8Hazards-v0") -> dict:
    return check(algo, algorithm(algo), read_hyperparams(algo, env_id))


# What is searched


@pytest.mark.parametrize("algo", [*sorted(ALGORITHMS), *RELATIVES])
def test_spaces_hold_what_algorithms_accept(algo):
    search = Search(algo, shipped(algo))
    for corner in search.corners():
        check(algo, algorithm(algo), corner)
    hints = annotations(algorithm(algo))
    values = {**draw(search), "buffer_size" if "buffer_size" in hints else "n_steps": 30}
    algorithm(algo)(env=CostPoint(), **model_arguments(check(algo, algorithm(algo), values)))


@pytest.mark.parametrize("algo", sorted(ALGORITHMS))
def test_the_first_trial_is_the_shipped_one(algo):
    base = shipped(algo)
    search = Search(algo, base)
    study = optuna.create_study()
    first = search.first()
    assert first.keys() == search.space.keys()
    study.enqueue_trial(first)
    drawn = search.draw(study.ask())
    # What the file leaves to the constructor is that one's default.
    cls = algorithm(algo)
    expected = {name: parameters(cls)[name].default for name in drawn.keys() - base.keys()} | base
    if hasattr(cls, "policy_defaults"):
        expected["policy_kwargs"] = {
            **{name: value for name, value in cls.policy_defaults.items() if "std" in name},
            **expected["policy_kwargs"],
        }
    assert drawn == expected


def test_the_limit_is_to_hold_with_both_kinds_of_actions():
    """The return is that of the most likely actions, as where the best model is chosen."""

    def evaluate(deterministic):
        values = (5.0, [1.0, 4.0]) if deterministic else (9.0, [2.0, 3.0])
        return SimpleNamespace(returns=np.array([values[0]]), limited=np.array([values[1]]))

    training = SimpleNamespace(evaluation=SimpleNamespace(evaluate=evaluate))
    rows: list = []
    evaluations = trials.Evaluations(
        training, SimpleNamespace(n_evaluations=1), lambda _, row: rows.append(row), lambda: False
    )
    evaluations.finish()
    assert rows == [[5.0, 2.0, 4.0]]


def test_an_evaluation_is_of_the_agent_after_its_update(monkeypatch):
    """Four evaluations in four rollouts see four agents, none of them before it has learnt."""
    seen: list = []
    settings = SimpleNamespace(n_evaluations=4, n_timesteps=160)
    evaluations = trials.Evaluations(SimpleNamespace(), settings, lambda *_: None, lambda: False)

    def evaluate() -> list[float]:
        seen.append((evaluations.num_timesteps, evaluations.model._n_updates))
        return [0.0]

    monkeypatch.setattr(evaluations, "_evaluate", evaluate)
    TRPO("MlpPolicy", CostPoint(10), n_steps=40, seed=0).learn(160, callback=evaluations)
    evaluations.finish()
    steps, updates = zip(*seen, strict=True)
    assert steps[:3] == (40, 80, 120) and updates[0] > 0 and len({*updates}) == 4
    seen.clear()
    settings.n_evaluations = 9
    evaluations.finish()
    assert evaluations.done == 9 and len(seen) == 1, "of one agent"


def test_an_algorithm_of_a_user_tunes(tmp_path, monkeypatch):
    """In the space of its class and those of its bases, and from no file."""

    class Mine(TRPO):
        search_space = {"gamma": [0.5, 0.6], "cg_damping": {"low": 0.1, "high": 1.0}}  # noqa: RUF012

    monkeypatch.setitem(ALGORITHMS, "mine", Mine)
    space = space_of("mine")
    assert space["gamma"] == [0.5, 0.6]
    assert space["target_kl"] == space_of("trpo")["target_kl"]
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--algo", "mine", "--n-trials", "2") == 0
    (folder,) = (tmp_path / "mine").iterdir()
    values = read_hyperparams("mine", "CostPoint-v0", str(folder / "best.yml"))
    assert values["gamma"] in (0.5, 0.6) and 0.1 <= values["cg_damping"] <= 1.0


def test_what_is_fixed_is_not_searched():
    base = {"gamma": 0.9, "policy_kwargs": {"net_arch": [8]}}
    search = Search("trpo", base, fixed=base)
    assert not {"gamma", "policy_kwargs.net_arch", "policy_kwargs.log_std_init"} & {*search.space}
    values = draw(search)
    assert (values["gamma"], values["policy_kwargs"]) == (0.9, {"net_arch": [8]})
    with pytest.raises(UsageError, match="nothing is left to search"):
        Search("trpo", base, {"gamma": [0.5, 0.9]}, base)


def test_what_a_space_draws():
    options = [{"pi": [8]}, [1, 2], "text", 3, None, True]
    space = {
        "linear": {"low": 0.0, "high": 2.0, "log": False},
        "log": {"low": 1e-4, "high": 1.0, "log": True},
        "whole": {"low": 1, "high": 1000, "log": True},
        "option": options,
    }
    search = Search("trpo", {}, space)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    drawn = [search.draw(study.ask()) for _ in range(200)]
    for name, middle in {"linear": 1.0, "log": 1e-2, "whole": 1000**0.5}.items():
        values = np.array([one[name] for one in drawn])
        assert space[name]["low"] <= values.min() and values.max() <= space[name]["high"]
        assert 0.4 < (values < middle).mean() < 0.6
    assert isinstance(drawn[0]["whole"], int)
    assert all(any(one["option"] is option or one["option"] == option for one in drawn)
               for option in options)  # fmt: skip


def test_an_algorithm_without_a_space_says_how_to_give_it():
    with pytest.raises(UsageError, match=r"no search space for dqn.*--search-space"):
        Search("dqn", {})


def test_a_space_from_a_file(tmp_path):
    path = tmp_path / "space.yml"
    path.write_text(
        "target_kl: {low: 1e-3, high: 0.05, log: true}\n"
        "n_envs: [1, 2]\n"
        "policy_kwargs.net_arch: [[8], [16]]\n"
    )
    space = read_space(str(path))
    assert space["target_kl"] == {"low": 0.001, "high": 0.05, "log": True}
    assert space["policy_kwargs.net_arch"] == [[8], [16]]
    base = {"policy_kwargs": "dict(activation_fn=nn.ReLU, net_arch=[4])"}
    drawn = draw(Search("cpo", base, space))
    assert drawn.keys() == {"target_kl", "n_envs", "policy_kwargs"}
    assert drawn["policy_kwargs"] in [
        {"activation_fn": "nn.ReLU", "net_arch": [n]} for n in (8, 16)
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("- a", "must map names"),
        ("x: 3", "x: 3 .*list of at least two options"),
        ("x: [1]", "two options"),
        ("x: {low: 1}", "'high'"),
        ("x: {low: 1, high: 2, lgo: true}", "'lgo'"),
        ("x: {low: 0, high: 1, log: true}", "low"),
    ],
)
def test_spaces_that_are_none(tmp_path, content, message):
    path = tmp_path / "space.yml"
    path.write_text(content)
    with pytest.raises(UsageError, match=f"(?s)search.space.*{message}"):
        read_space(str(path))


@pytest.mark.parametrize("sampler", sorted(SAMPLERS))
def test_samplers_take_constraints(sampler):
    study = optuna.create_study(direction="maximize", sampler=SAMPLERS[sampler](0, 4))
    for _ in range(6):
        trial = study.ask()
        x = trial.suggest_float("x", 0.0, 1.0)
        trial.set_constraint("cost", 2 * x - 1)
        study.tell(trial, x)
    assert len(study.trials) == 6


@pytest.mark.parametrize(
    ("outcomes", "number"),
    [
        ([(5.0, 0.0), (9.0, 0.1), (7.0, 0.0)], 2),  # feasible by return
        ([(5.0, 2.0), (1.0, 1.0), (9.0, 8.0)], 1),  # least violation
        ([(5.0, 2.0), (6.0, 2.0)], 1),  # of two alike, by return
        ([(-5.0, 0.0), (100.0, 0.01)], 0),
    ],
)
def test_the_best_is_feasible_first(outcomes, number):
    trials = [
        create_trial(value=value, user_attrs={"result": {"return": value, "violation": over}})
        for value, over in outcomes
    ]
    result = {"return": 99.0, "violation": 0.0}
    pruned = create_trial(state=TrialState.PRUNED, user_attrs={"result": result})
    assert best([*trials, pruned]) is trials[number]
    assert best([pruned]) is None


# The command


def pretend(monkeypatch, outcome):
    """Let a training come to ``outcome(values, seed)`` in a moment, rising to it evenly."""

    def train(self, values, seed, after):
        for k in range(1, self.settings.n_evaluations + 1):
            if self.stopped():
                raise trials.Stopped
            value, *costs = outcome(values, seed)
            after(k, [value * k / self.settings.n_evaluations, *costs])

    monkeypatch.setattr(trials.Objective, "_train", train)
    monkeypatch.setattr(gc, "collect", lambda: 0)  # no model is made; it takes most of the time


def by_kl(values, seed):
    """Return rises with target_kl, and so does cost; 0.0245 is feasible at a limit of 1."""
    return 100 * values["target_kl"], 40 * values["target_kl"] + 0.01 * seed


def study_in(folder, name="trpo_lag_CostPoint-v0") -> optuna.Study:
    storage = JournalStorage(JournalFileBackend(str(folder / "study.journal")))
    return optuna.load_study(study_name=name, storage=storage)


def states(folder) -> dict:
    return dict(Counter(one.state.name for one in study_in(folder).trials))


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "trpo_lag" / "CostPoint-v0_tune"


def run(tmp_path, *more: str) -> int:
    return tune.main([*TOY, *SMALL, "-f", str(tmp_path), "--pruner", "none", *more])


def test_best_is_feasible_and_train_reads_it(tmp_path, folder, monkeypatch, capsys):
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "12", "--cost-limit", "1", "--seed", "0") == 0
    out, err = capsys.readouterr()
    assert err == ""
    table = pd.read_csv(folder / "trials.csv")
    feasible = table["violation"] == 0
    assert len(table) == 12 and feasible.any() and not feasible.all()
    top = table[feasible].sort_values("return").iloc[-1]
    assert f"trial {top['number']}: " in out.split("best         ")[1]
    assert table["return"].max() > top["return"]
    assert table["gamma"].between(0.9, 1).all()
    values = read_hyperparams("trpo_lag", "CostPoint-v0", str(folder / "best.yml"))
    assert values["target_kl"] == top["target_kl"]
    # Training with the result is as long as a trial; the limit also chooses models.
    assert (values["n_timesteps"], values["selection_limit"]) == (240, 1.0)
    assert values["env_kwargs"] == {"episode_length": 20}
    shown = out.split("train with   sb3-guard train ")[1].splitlines()[0].split()
    assert train.main([*shown, "-n", "60", "-f", str(tmp_path), "--verbose", "0"]) == 0


def test_constraints_are_in_the_study(tmp_path, folder, monkeypatch):
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "3", "--cost-limit", "0.5", "--seeds", "2", "5") == 0
    for trial in study_in(folder).trials:
        cost = 40 * trial.params["target_kl"] + 0.035  # mean of the seeds
        over = max(cost - 0.5, 0.0)
        assert trial.constraints == {"cost": pytest.approx(cost - 0.5)}
        assert trial.user_attrs["result"] == pytest.approx(
            {"return": trial.value, "cost": cost, "violation": over}
        )
        assert min(trial.intermediate_values) == 1 and trial.last_step == 8
        expected = -1e9 - over if over else trial.value
        assert trial.intermediate_values[8] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("pruner", ["median", pytest.param("halving", marks=pytest.mark.slow)])
def test_pruning_is_feasible_first(tmp_path, folder, monkeypatch, capsys, pruner):
    """At last, a trial of the highest return that breaks the limit."""
    seen = []

    def outcome(values, seed):
        number = len(study_in(folder).trials) - 1
        seen.append(number)
        return (99.0, 5.0) if number == 5 else (float(number), 0.0)

    pretend(monkeypatch, outcome)
    more = ["--n-trials", "6", "--pruner", pruner, "--n-startup-trials", "3", "--cost-limit", "1"]
    assert run(tmp_path, *more, "--n-evaluations", "6") == 0
    *_, top, last = study_in(folder).trials
    assert top.state == TrialState.COMPLETE
    assert last.state == TrialState.PRUNED and last.constraints == {"cost": 4.0}
    assert last.last_step == (3 if pruner == "median" else 1)
    assert f"pruned after {last.last_step} of 6" in capsys.readouterr().out


def test_several_costs(tmp_path, folder, monkeypatch, capsys):
    pretend(monkeypatch, lambda values, seed: (1.0, 0.2, 50 * values["target_kl"]))
    costs = ["--env-kwargs", "cost_keys:('cost','heat')", "-params", "cost_keys:['cost','heat']"]
    assert run(tmp_path, *costs, "--n-trials", "2", "--cost-limit", "1", "0.5") == 0
    for one in study_in(folder).trials:
        heat = 50 * one.params["target_kl"]
        assert one.constraints == pytest.approx({"cost": -0.8, "heat": heat - 0.5})
    out = capsys.readouterr().out
    assert "cost heat" in out and "episode cost of at most 1, heat of at most 0.5\n" in out


def test_trains_for_real(tmp_path, folder, monkeypatch, capsys):
    more = "--seeds 0 1 -params normalize:True -n 120 --n-evaluations 2".split()
    assert run(tmp_path, *more, "--n-trials", "2") == 0
    out = capsys.readouterr().out
    assert "Trial 1: return " in out
    table = pd.read_csv(folder / "trials.csv")
    assert table["state"].tolist() == ["COMPLETE"] * 2
    assert np.isfinite(table[["return", "cost"]].to_numpy()).all()
    # The first trial is of the shipped hyperparameters, again the same.
    assert run(tmp_path, *more, "--n-trials", "1", "--study-name", "again") == 0
    again = pd.read_csv(folder.with_name("CostPoint-v0_tune_again") / "trials.csv")
    assert table.loc[0, "target_kl"] == SHIPPED_KL
    assert table.loc[0, "return":"cost"].equals(again.loc[0, "return":"cost"])


def test_a_seeded_search_is_the_same_again(tmp_path, monkeypatch):
    pretend(monkeypatch, by_kl)
    tables, search = [], "--n-trials 5 --n-startup-trials 3 --seed 4".split()
    for name in ("one", "other"):
        assert run(tmp_path, *search, "--study-name", name) == 0
        path = tmp_path / "trpo_lag" / f"CostPoint-v0_tune_{name}" / "trials.csv"
        tables.append(pd.read_csv(path).drop(columns="seconds"))
    pd.testing.assert_frame_equal(*tables)


# Nothing is lost


@pytest.mark.slow
def test_no_trial_is_lost_whatever_is_killed(tmp_path):
    """`python scripts/chaos.py tune` does the same for longer."""
    study = campaign(str(tmp_path / "journal"), tmp_path, n_trials=12, n_workers=3, kills=6)
    assert faults(study) == []


@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM]
)
def test_an_interrupted_trial_is_done_later(tmp_path, folder, monkeypatch, capsys, number):
    whole, done = trials.Evaluations._on_step, []

    def step(self):
        if self.num_timesteps >= 100 and self.training.flags.seed == 1 and not done:
            done.append(True)
            os.kill(os.getpid(), number)
        return whole(self)

    monkeypatch.setattr(trials.Evaluations, "_on_step", step)
    command = ["--n-trials", "2", "--seeds", "0", "1"]
    assert run(tmp_path, *command) == 128 + number
    out, err = capsys.readouterr()
    assert "Stopping" in err and "The same command continues the study." in out
    assert "Traceback" not in out + err
    assert states(folder) == {"FAIL": 1, "WAITING": 1}
    trained = []
    pretend(monkeypatch, lambda values, seed: trained.append(seed) or (1.0, 0.0))
    assert run(tmp_path, *command) == 0
    assert states(folder) == {"FAIL": 1, "COMPLETE": 2}
    before, again, _ = study_in(folder).trials
    assert again.params == before.params
    assert trained == [0] * 4 + [1] * 4 + [0] * 4 + [1] * 4


def test_n_trials_counts_those_of_the_study(tmp_path, folder, monkeypatch, capsys):
    pretend(monkeypatch, by_kl)
    for _ in range(2):
        assert run(tmp_path, "--n-trials", "3") == 0
        assert states(folder) == {"COMPLETE": 3}
    assert run(tmp_path, "--max-total-trials", "5", "--sampler", "random") == 0
    assert states(folder) == {"COMPLETE": 5}
    assert "3 of 5 trials are finished" in capsys.readouterr().out


def states_or_none(folder) -> dict:
    try:
        return states(folder)
    except (OSError, KeyError):  # the study is not yet written
        return {}


@pytest.mark.slow
def test_a_killed_workers_trial_is_done_at_the_next_start(tmp_path, folder, monkeypatch):
    command = ["-n", "1e8", "--n-trials", "1"]
    arguments = [*TOY, *SMALL, "-f", str(tmp_path), "--pruner", "none", *command]
    worker = fresh(work, arguments, tmp_path / "0.txt")
    wait_for(lambda: "RUNNING" in states_or_none(folder) or not worker.is_alive(), 300)
    # It trains, and writes nothing: the lock of a journal that is being written holds for 30 s.
    wait_for(lambda: "hyperparams" in study_in(folder).trials[0].user_attrs)
    time.sleep(1.0)
    worker.kill()
    worker.join()
    assert states(folder) == {"RUNNING": 1}, (tmp_path / "0.txt").read_text()
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, *command) == 0
    assert states(folder) == {"FAIL": 1, "COMPLETE": 1}
    assert study_in(folder).trials[1].params["target_kl"] == SHIPPED_KL


def begun(tmp_path, worker: str | None, **attributes) -> optuna.Study:
    """A study of which a worker has begun a trial, whose hyperparameters are drawn."""
    storage, _ = studies.open_storage(None, tmp_path / "study.journal")
    study = optuna.create_study(storage=storage)
    trial = study.ask()
    trial.suggest_float("x", 0.0, 1.0)
    for name, value in {**attributes, **({"worker": worker} if worker else {})}.items():
        trial.set_user_attr(name, value)
    studies.repeat_lost_trials(study)
    return study


def gone() -> int:
    """The number of a process that has ended."""
    process = subprocess.Popen(["true"])
    process.wait()
    return process.pid


def test_the_trial_of_a_dead_worker_is_queued(tmp_path):
    lost, again = begun(tmp_path / "a", f"{socket.gethostname()}-{gone()}").trials
    assert (lost.state, again.state) == (TrialState.FAIL, TrialState.WAITING)
    assert again.params == lost.params
    # It never said who it is.
    assert [t.state.name for t in begun(tmp_path / "b", None).trials] == ["FAIL", "WAITING"]


def test_other_trials_are_left_to_their_workers(tmp_path):
    alive = f"{socket.gethostname()}-{os.getppid()}"
    for number, worker in enumerate([alive, f"elsewhere-{gone()}"]):
        (trial,) = begun(tmp_path / str(number), worker).trials
        assert trial.state == TrialState.RUNNING


def test_trials_that_kill_their_workers_are_given_up(tmp_path):
    worker = f"{socket.gethostname()}-{gone()}"
    storage, _ = studies.open_storage(None, tmp_path / "study.journal")
    study = optuna.create_study(storage=storage)
    for _ in range(studies.MOST_REPEATS + 2):
        study.ask().set_user_attr("worker", worker)
        studies.repeat_lost_trials(study)
    histories = [trial.system_attrs.get("retry_history", []) for trial in study.trials]
    assert histories == [[], [0], [0, 1], [0, 1, 2], [], [4]]


def test_a_full_disk_is_a_clear_error(tmp_path, folder, monkeypatch, capsys):
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "1") == 0
    table = (folder / "trials.csv").read_bytes()

    def full(self, logs):
        raise OSError(28, "No space left on device")

    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(JournalFileBackend, "append_logs", full)
        refused(lambda argv: run(tmp_path, *argv), ["--n-trials", "2"], capsys, "No space left")
    assert (folder / "trials.csv").read_bytes() == table
    assert run(tmp_path, "--n-trials", "2") == 0
    assert states(folder)["COMPLETE"] == 2


# Trials that fail


def test_a_failing_trial_is_the_worst(tmp_path, folder, monkeypatch, capsys):
    seen = []

    def outcome(values, seed):
        seen.append(1)
        if len(seen) == 1:
            raise ValueError("the policy is NaN")
        return by_kl(values, seed)

    pretend(monkeypatch, outcome)
    assert run(tmp_path, "--n-trials", "3", "--cost-limit", "0") == 0
    assert "Trial 0: failed: the policy is NaN" in capsys.readouterr().out
    assert states(folder) == {"PRUNED": 1, "COMPLETE": 2}
    first, *others = study_in(folder).trials
    assert first.constraints["cost"] > max(one.constraints["cost"] for one in others)
    assert pd.read_csv(folder / "trials.csv")["error"][0] == "the policy is NaN"


# What is typed wrongly

WRONG = [
    (["--cost-limit", "1", "2"], ["selection_limit=[1.0, 2.0]"]),
    (["--storage", "redis://here"], ["--storage redis://here", "must be postgresql://"]),
    (["-f", "/proc/nowhere"], ["-f", "/proc/nowhere"]),
]


@pytest.mark.parametrize(("wrong", "parts"), WRONG, ids=lambda v: v[0])
def test_wrong_flags_change_nothing(empty, capsys, wrong, parts):
    refused(tune.main, [*TOY, *SMALL, *wrong], capsys, *parts)


def test_spaces_are_checked_with_the_algorithm(tmp_path, capsys):
    path = tmp_path / "space.yml"
    path.write_text("gamma: [x, y]")
    command = [*TOY, *SMALL, "-f", str(tmp_path / "logs"), "--search-space", str(path)]
    refused(tune.main, command, capsys, "gamma")
    assert not (tmp_path / "logs").exists()


def test_a_study_is_continued_as_it_was_begun(tmp_path, folder, monkeypatch, capsys):
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "1") == 0
    capsys.readouterr()
    for other, part in (
        (["--cost-limit", "5"], "begun with"),
        (["-n", "120"], "n_timesteps 240, not 120"),
        (["-params", "n_steps:60"], "n_steps 30, not 60"),
    ):
        refused(lambda argv: run(tmp_path, *argv), other, capsys, part, "--study-name")
    assert states(folder) == {"COMPLETE": 1}


def test_files_that_are_no_studies_are_left_alone(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"two lines\nof text")
    with pytest.raises(UsageError, match="as a study"):
        studies.open_storage(str(path), tmp_path)
    assert path.read_bytes() == b"two lines\nof text" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("method", ["set_user_attr", "enqueue_trial"])
def test_a_study_whose_beginner_died_is_begun(tmp_path, folder, monkeypatch, method):
    def die(self, *_, **__):
        raise KeyboardInterrupt

    pretend(monkeypatch, by_kl)
    with monkeypatch.context() as patch:
        patch.setattr(optuna.Study, method, die)
        assert run(tmp_path, "--n-trials", "2") == 130
    assert run(tmp_path, "--n-trials", "2") == 0
    assert states(folder) == {"COMPLETE": 2}
    assert study_in(folder).trials[0].params["target_kl"] == SHIPPED_KL


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_several_processes_stop_together(tmp_path, folder, number):
    """One command, two workers; when the first is stopped or killed, both end."""
    command = [sys.executable, "-m", "sb3_guard.tune", *TOY, *SMALL, "-f", str(tmp_path)]
    command += ["-n", "1e6", "--n-jobs", "2"]
    with subprocess.Popen(
        command,
        cwd=SUPPORT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as first:
        wait_for(lambda: states_or_none(folder).get("RUNNING") == 2, 300)
        wait_for(lambda: all("worker" in t.user_attrs for t in study_in(folder).trials))
        workers = [t.user_attrs["worker"].rsplit("-", 1)[1] for t in study_in(folder).trials]
        assert str(first.pid) in workers and len(set(workers)) == 2
        if number == signal.SIGINT:
            os.killpg(first.pid, number)  # as the terminal does
        else:
            first.send_signal(number)
        out, err = first.communicate(timeout=300)
    assert "Traceback" not in out + err
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers))
    if number == signal.SIGKILL:
        assert first.returncode == -number
    else:
        assert first.returncode == 128 + number
        assert states(folder) == {"FAIL": 2, "WAITING": 2}

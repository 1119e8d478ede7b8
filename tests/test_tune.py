"""Tuning: what is searched, what counts as best, and that nothing is lost on the way."""

import json
import os
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import optuna
import pandas as pd
import pytest
import yaml
from cost_envs import CostPoint
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState, create_trial
from processes import fork, join, wait_for
from test_bad_input import empty, refused  # noqa: F401 (a fixture)

from sb3_guard import cli, train, tune
from sb3_guard.algorithms import ALGORITHMS
from sb3_guard.zoo import storages, tuning
from sb3_guard.zoo.algos import algorithm, baselines
from sb3_guard.zoo.config import build, check, parameters, read_hyperparams
from sb3_guard.zoo.samplers import SAMPLERS, SPACES, Choice, Range, Search, read_space, set_dotted
from sb3_guard.zoo.tuning import FeasibleFirst
from sb3_guard.zoo.tuning_report import Report, Verdict, front
from sb3_guard.zoo.usage import UsageError

TOY = (
    "--algo trpo_lag --gym-packages registered_envs --env CostPoint-v0 --env-kwargs "
    "episode_length:20 --eval-episodes 2 --device cpu --num-threads 1 -n 240"
).split()
SMALL = "-params n_envs:2 n_steps:30 n_critic_updates:3".split()


def draw(search: Search, seed: int = 0) -> dict:
    """What a random trial tries."""
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=seed))
    return search.draw(study.ask())


# What is searched


def test_every_algorithm_has_a_space():
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

    assert SPACES.keys() >= ALGORITHMS.keys()
    for algo in {*baselines()} - {*SPACES}:
        assert algo in HYPERPARAMS_SAMPLER, algo


@pytest.mark.parametrize("algo", sorted(SPACES))
def test_spaces_hold_what_algorithms_accept(algo):
    cls = algorithm(algo)
    base = check(algo, cls, read_hyperparams(algo, "Goal_Point_8Hazards-v0"))
    for end in (0, -1):
        values = {**base, "buffer_size" if algo == "crossq" else "n_steps": 30}
        for name, one in SPACES[algo].items():
            ends = one.options if isinstance(one, Choice) else (one.low, one.high)
            values = set_dotted(values, name, ends[end])
        values = check(algo, cls, values)
        cls(env=CostPoint(), **build(values).model)


@pytest.mark.parametrize("algo", sorted(SPACES))
def test_the_first_trial_is_the_shipped_one(algo):
    base = check(algo, algorithm(algo), read_hyperparams(algo, "Goal_Point_8Hazards-v0"))
    search = Search(algo, base)
    study = optuna.create_study()
    study.enqueue_trial(search.first())
    drawn = search.draw(study.ask())
    assert base.items() <= drawn.items()
    # What the file leaves to the constructor is that one's default.
    defaults = parameters(algorithm(algo))
    for name in drawn.keys() - base.keys():
        assert drawn[name] == pytest.approx(defaults[name].default)


@pytest.mark.parametrize("algo", sorted(SPACES))
def test_a_space_serves_rl_zoo(algo):
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER

    from sb3_guard.zoo.rl_zoo3 import key_in_rl_zoo, register

    register()
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    extra = {"using_her_replay_buffer": False, "her_kwargs": {}}
    drawn = HYPERPARAMS_SAMPLER[key_in_rl_zoo(algo)](study.ask(), 2, 4, extra)
    outer = {name.partition(".")[0] for name in SPACES[algo]}
    assert drawn.keys() == outer - {"n_envs"}
    shipped = read_hyperparams(algo, "Goal_Point_8Hazards-v0")["policy_kwargs"]
    assert shipped.keys() <= drawn["policy_kwargs"].keys()
    assert HYPERPARAMS_SAMPLER["trpo"].__module__ == "rl_zoo3.hyperparams_opt"


def test_what_is_fixed_is_not_searched():
    base = {"gamma": 0.9, "policy_kwargs": {"net_arch": [8]}}
    search = Search("trpo", base, fixed=base)
    assert not {"gamma", "policy_kwargs.net_arch", "policy_kwargs.log_std_init"} & {*search.space}
    values = draw(search)
    assert (values["gamma"], values["policy_kwargs"]) == (0.9, {"net_arch": [8]})
    with pytest.raises(UsageError, match="nothing is left to search"):
        Search("trpo", base, {"gamma": Range(0.5, 0.9)}, base)


@pytest.mark.parametrize(
    ("one", "kind", "logarithmic"),
    [
        (Range(0.0, 2.0), float, False),
        (Range(1e-4, 1.0, log=True), float, True),
        (Range(1, 1000, log=True), int, True),
        (Range(0.9, 0.9999, log=True, complement=True), float, True),
    ],
)
def test_ranges_draw_in_their_scale(one, kind, logarithmic):
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    values = np.array([one.draw(study.ask(), "x") for _ in range(300)])
    assert isinstance(values[0].item(), kind)
    assert (values >= one.low).all() and (values <= one.high).all()
    scaled = 1 - values if one.complement else values
    middle = np.sqrt(scaled.min() * scaled.max()) if logarithmic else scaled.mean()
    assert 0.4 < (scaled < middle).mean() < 0.6
    assert one.represent(one.high) is not None and one.represent(1e9) is None


def test_choices_may_be_of_any_kind():
    options = ({"pi": [8]}, [1, 2], "text", 3, None, True)
    one = Choice(options)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    drawn = [one.draw(study.ask(), "x") for _ in range(60)]
    assert all(value in drawn for value in options)
    assert one.represent({"pi": [8]}) == json.dumps({"pi": [8]})


@pytest.mark.parametrize("algo", ["ppo", "sac", "td3", "dqn"])
def test_rl_zoos_spaces_become_plain_data(algo):
    base = check(algo, algorithm(algo), {"n_timesteps": 100, "policy_kwargs": "dict(n_critics=1)"})
    for seed in range(4):
        values = draw(Search(algo, base), seed)
        assert yaml.safe_load(yaml.safe_dump(values)) == values
        setup = build(check(algo, algorithm(algo), values))
        assert setup.model["policy_kwargs"]["n_critics"] == 1
        assert "net_arch" in setup.model["policy_kwargs"]
        assert "action_noise" not in values


@pytest.mark.parametrize("algo", ["ddpg", "td3"])
def test_rl_zoos_noise_is_what_was_drawn(algo):
    """None, too, although the shipped file has some; what is fixed stays."""
    base = check(algo, algorithm(algo), read_hyperparams(algo, "Goal_Point_8Hazards-v0"))
    assert base["noise_type"] == "normal"
    for kind in ("normal", "ornstein-uhlenbeck", None):
        study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
        study.enqueue_trial({"noise_type": kind, "noise_std": 0.25}, skip_if_exists=False)
        values = Search(algo, base).draw(study.ask())
        assert (values["noise_type"], values.get("noise_std")) == (kind, 0.25 if kind else None)
        assert (build(check(algo, algorithm(algo), values)).action_noise(2) is None) == (not kind)
        study.enqueue_trial({"noise_type": kind, "noise_std": 0.25}, skip_if_exists=False)
        values = Search(algo, base, fixed={"noise_type": "normal"}).draw(study.ask())
        assert (values["noise_type"], values["noise_std"]) == ("normal", 0.25)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("dict(a=nn.ReLU, b=dict(c=[1]))", "dict(a=nn.ReLU, b=2)"),
        (" {'a': 1}", "dict(a=1, b=2)"),
        ("dict()", "dict(b=2)"),
        ("dict(**x)", None),
        ("{**x}", None),
        ("print(1)", None),
        ("dict(a", None),
    ],
)
def test_an_entry_of_a_mapping_that_is_text_changes(text, expected):
    if expected is None:
        with pytest.raises(UsageError, match="can't change entries of"):
            set_dotted({"x": text}, "x.b", 2)
    else:
        assert set_dotted({"x": text}, "x.b", 2) == {"x": expected}


def test_a_space_of_ones_own(tmp_path):
    path = tmp_path / "space.yml"
    path.write_text(
        "target_kl: {low: 1e-3, high: 0.05, log: true}\n"
        "gamma: {low: 0.9, high: 0.99, complement: true}\n"
        "n_envs: [1, 2]\n"
        "policy_kwargs.net_arch: [[8], [16]]\n"
    )
    space = read_space(str(path))
    assert space["target_kl"] == Range(0.001, 0.05, log=True)
    assert space["policy_kwargs.net_arch"] == Choice(([8], [16]))
    values = draw(Search("cpo", {}, space))
    assert values.keys() == {"target_kl", "gamma", "n_envs", "policy_kwargs"}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1, 2", "can't read"),
        ("- a", "must map names"),
        ("x: [1, 2]\nx: [3, 4]", "line 2 has the key 'x' again, after line 1"),
        ("x: 3", "x .*write a list of options"),
        ("x: [1]", "at least two options"),
        ("x: {low: 1}", "there is no 'high'"),
        ("x: {low: 1, hihg: 2}", "unknown key 'hihg'; did you mean 'high'"),
        ("x: {low: 2, high: 1}", "low: 2 is not below high: 1"),
        ("x: {low: 0, high: 1, log: true}", "low must be above 0"),
        ("x: {low: 0.5, high: 1, log: true, complement: true}", "high must be below 1"),
        ("x: {low: .nan, high: 1}", "not finite"),
        ("x: {low: a, high: 1}", "low: 'a' is not a number"),
        ("x: {low: 0, high: 1, log: 1}", "log: 1 is not True or False"),
    ],
)
def test_spaces_that_are_none(tmp_path, content, message):
    path = tmp_path / "space.yml"
    path.write_text(content)
    with pytest.raises(UsageError, match=f"--search-space: .*{message}"):
        read_space(str(path))


@pytest.mark.parametrize("sampler", sorted(SAMPLERS))
@pytest.mark.parametrize("pareto", [False, True])
def test_samplers_take_constraints(sampler, pareto):
    """Each works with constraints, and without in several directions."""
    study = optuna.create_study(
        directions=["maximize", "minimize"] if pareto else ["maximize"],
        sampler=SAMPLERS[sampler](0, 4),
    )
    for _ in range(7):
        trial = study.ask()
        x = trial.suggest_float("x", 0.0, 1.0)
        if not pareto:
            trial.set_constraint("cost", 2 * x - 1)
        study.tell(trial, [x, 2 * x] if pareto else x)
    assert len(study.trials) == 7


# What counts as best


def finished(number, value, costs, **attributes):
    trial = create_trial(value=value, user_attrs={"result": [value, *costs], **attributes})
    trial.number = number
    return trial


LIMIT_1 = Verdict(lambda costs: sum(max(cost - 1.0, 0.0) for cost in costs))


@pytest.mark.parametrize(
    ("outcomes", "best"),
    [
        ([(5.0, 0.5), (9.0, 1.1), (7.0, 1.0)], 2),  # feasible by return; the limit itself is
        ([(5.0, 3.0), (1.0, 2.0), (9.0, 9.0)], 1),  # least violation
        ([(5.0, 3.0), (6.0, 3.0)], 1),  # of two alike, by return
        ([(-5.0, 0.0), (100.0, 1.01)], 0),
    ],
)
def test_the_best_is_feasible_first(outcomes, best):
    trials = [finished(i, value, [cost]) for i, (value, cost) in enumerate(outcomes)]
    pruned = create_trial(
        state=TrialState.PRUNED, user_attrs={"result": [99.0, 0.0]}, intermediate_values={0: 99.0}
    )
    assert LIMIT_1.best([*trials, pruned]) is trials[best]
    assert LIMIT_1.best([pruned]) is None
    scores = LIMIT_1.scores(trials)
    assert max(scores, key=scores.__getitem__) == best or outcomes[0][1] == outcomes[1][1]


def test_front():
    points = [(1.0, 0.0), (3.0, 2.0), (2.0, 2.5), (4.0, 5.0), (1.0, 0.0)]
    trials = [finished(i, value, [cost]) for i, (value, cost) in enumerate(points)]
    assert [one.number for one in front(trials)] == [3, 1, 0, 4]
    assert front([]) == []


def ended(returns, violations, state=TrialState.COMPLETE):
    return create_trial(
        state=state,
        value=returns[-1] if state == TrialState.COMPLETE else None,
        intermediate_values=dict(enumerate(returns)),
        user_attrs={"violations": violations},
    )


@pytest.mark.parametrize(
    ("returns", "violations", "pruned"),
    [
        ([4.0], [0.0], False),  # above the median, 3
        ([2.0], [0.0], True),
        ([9.0], [0.1], True),  # however much it gets: it costs too much
        ([9.0, 2.0], [0.0, 0.0], True),  # however good it was before
        ([9.0, 4.0], [0.1, 0.0], False),  # keeps the limit by now
    ],
)
def test_median_pruning_compares_the_feasible_by_return(returns, violations, pruned):
    study = optuna.create_study(direction="maximize")
    for value in (1.0, 3.0, 5.0):
        study.add_trial(ended([value, value], [0.0, 0.0]))
    trial = ended(returns, violations, TrialState.RUNNING)
    trial.number = 9
    assert FeasibleFirst("median", 3).prune(study, trial) == pruned
    assert not FeasibleFirst("median", 4).prune(study, trial)
    assert not FeasibleFirst("median", 3, n_warmup_steps=5).prune(study, trial)
    trial.system_attrs = {"fixed_params": {"gamma": 0.99}}  # the file's, with which to compare
    assert not FeasibleFirst("median", 3).prune(study, trial)


@pytest.mark.parametrize(("violation", "pruned"), [(0.5, False), (2.5, True)])
def test_pruning_compares_the_infeasible_by_violation(violation, pruned):
    """The worst return of all is -7, in a trial that came later than those it is compared with."""
    study = optuna.create_study(direction="maximize")
    for value, other in ((0.0, 1.0), (8.0, 2.0), (8.0, 3.0)):
        study.add_trial(ended([value], [other]))
    study.add_trial(ended([-7.0], [0.0], TrialState.PRUNED))
    trial = ended([-3.0], [violation], TrialState.RUNNING)
    trial.number = 9
    assert FeasibleFirst("median").prune(study, trial) == pruned
    # Worse than any that keeps the limit, however low that one's return.
    study.add_trial(ended([-70.0], [0.0]))
    study.add_trial(ended([-80.0], [0.0]))
    study.add_trial(ended([-90.0], [0.0]))
    study.add_trial(ended([-90.0], [0.0]))
    assert FeasibleFirst("median").prune(study, trial)


@pytest.mark.parametrize(
    ("step", "value", "pruned"), [(0, 7.5, False), (0, 5.5, True), (1, 0.0, False), (3, 0.0, True)]
)
def test_halving_keeps_a_quarter_at_its_rungs(step, value, pruned):
    study = optuna.create_study(direction="maximize")
    for other in range(8):  # of nine trials two may go on
        study.add_trial(ended([float(other)] * 4, [0.0] * 4))
    trial = ended([9.0] * step + [value], [0.0] * (step + 1), TrialState.RUNNING)
    trial.number = 9
    assert FeasibleFirst("halving").prune(study, trial) == pruned


# The command


def pretend(monkeypatch, outcome):
    """Let a training come to ``outcome(values, seed)`` in a moment, rising to it evenly."""

    def train(self, values, seed, after):
        history = []
        for k in range(1, self.settings.n_evaluations + 1):
            if self.stopped():
                raise tuning.Stopped
            value, *costs = outcome(values, seed)
            history.append([value * k / self.settings.n_evaluations, *costs])
            if not after(history):
                return history, False
        return history, True

    monkeypatch.setattr(tuning.Worker, "_train", train)


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


@pytest.fixture
def drawn():
    """For tests that want the plots."""


@pytest.fixture(autouse=True)
def _plots(request, monkeypatch):
    """Drawing takes most of the time of a study as small as these."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr(Report, "plot", lambda self, study, trials: None)


def run(tmp_path, *more: str) -> int:
    return tune.main([*TOY, *SMALL, "-f", str(tmp_path), "--pruner", "none", *more])


def test_best_is_feasible_and_train_reads_it(tmp_path, folder, drawn, monkeypatch, capsys):
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "12", "--cost-limit", "1", "--seed", "0") == 0
    out = capsys.readouterr().out
    table = pd.read_csv(folder / "trials.csv")
    assert len(table) == 12 and table["feasible"].any() and not table["feasible"].all()
    best = table[table["feasible"]].sort_values("return").iloc[-1]
    assert f"best         trial {best['trial']}: " in out
    assert table["return"].max() > best["return"]
    for line in ("0 of 12 trials are finished", "optuna-dashboard", "an episode cost of at most 1"):
        assert line in out
    values = read_hyperparams("trpo_lag", "CostPoint-v0", str(folder / "best.yml"))
    assert values["target_kl"] == pytest.approx(best["target_kl"], rel=1e-3)
    # The file's own length of training, not that of the trials; the limit also chooses models.
    assert (values["n_timesteps"], values["selection_limit"]) == (6_000_000, 1.0)
    assert values["env_kwargs"] == {"episode_length": 20}
    for name in ("history", "importances", "pareto"):
        assert (folder / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    shown = out.split("train with   python -m sb3_guard.train ")[1].split()
    assert train.main([*shown, "-n", "60", "-f", str(tmp_path), "--verbose", "0"]) == 0


def test_no_feasible_trial_is_said(tmp_path, folder, drawn, monkeypatch, capsys):
    pretend(monkeypatch, lambda values, seed: (values["target_kl"], 2 + values["target_kl"]))
    assert run(tmp_path, "--n-trials", "4") == 0  # the limit is max(cost_limit, 1)
    out = capsys.readouterr().out
    assert "0 of 4 kept the cost limit" in out
    assert "No trial kept the cost limit 1: the best one is that of least violation." in out
    table = pd.read_csv(folder / "trials.csv")
    best = table.sort_values("violation").iloc[0]
    assert f"best         trial {best['trial']}: " in out and "over the limit" in out


def test_constraints_and_violations_are_in_the_study(tmp_path, folder, monkeypatch):
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "3", "--cost-limit", "0.5", "--seeds", "2", "5") == 0
    study = study_in(folder)
    for trial in study.trials:
        cost = 40 * trial.user_attrs["hyperparams"]["target_kl"] + 0.035  # mean of the seeds
        assert trial.constraints == {"cost": pytest.approx(cost - 0.5)}
        assert trial.value == trial.user_attrs["result"][0]
        assert len(trial.intermediate_values) == 8
        assert trial.intermediate_values[7] == pytest.approx(trial.value)
        assert trial.user_attrs["violations"][-1] == pytest.approx(max(cost - 0.5, 0))
        assert {"seed 2", "seed 5"} <= trial.user_attrs.keys()


def test_pruned_trials_have_constraints_too(tmp_path, folder, monkeypatch, capsys):
    pretend(monkeypatch, by_kl)
    more = ["--n-trials", "14", "--pruner", "median", "--n-startup-trials", "3", "--seed", "1"]
    assert run(tmp_path, *more, "--n-evaluations", "6") == 0
    pruned = [one for one in study_in(folder).trials if one.state == TrialState.PRUNED]
    assert pruned and all(one.constraints for one in pruned)
    assert all(min(one.intermediate_values) == 0 for one in pruned)
    assert all(2 <= one.last_step < 5 for one in pruned)  # never the first third, nor the last
    assert "pruned after 3 of 6 evaluations" in capsys.readouterr().out


def test_pareto_front(tmp_path, folder, drawn, monkeypatch, capsys):
    pretend(monkeypatch, by_kl)
    assert tune.main([*TOY, *SMALL, "-f", str(tmp_path), "--pareto", "--n-trials", "5"]) == 0
    out = capsys.readouterr().out
    study = study_in(folder)
    assert [one.name for one in study.directions] == ["MAXIMIZE", "MINIMIZE"]
    assert all(not one.constraints for one in study.trials)
    names = {path.stem for path in (folder / "pareto").iterdir()}
    assert names == {f"trial_{one.number}" for one in study.best_trials}
    assert "the trade-off of return and episode cost" in out and "front" in out
    for path in (folder / "pareto").iterdir():
        read_hyperparams("trpo_lag", "CostPoint-v0", str(path))


def test_algorithms_without_a_limit(tmp_path, monkeypatch, capsys):
    pretend(monkeypatch, by_kl)
    command = [*TOY, *SMALL, "-f", str(tmp_path), "--algo", "trpo", "--n-trials", "3"]
    assert tune.main(command) == 0
    out = capsys.readouterr().out
    assert "trpo has no cost limit; --cost-limit sets one" in out and "kept" not in out
    table = pd.read_csv(tmp_path / "trpo" / "CostPoint-v0_tune" / "trials.csv")
    assert (table["violation"] == 0).all()


def test_several_costs(tmp_path, drawn, monkeypatch, capsys):
    pretend(monkeypatch, lambda values, seed: (1.0, 0.2, 50 * values["target_kl"]))
    costs = ["--env-kwargs", "cost_keys:('cost','heat')", "-params", "cost_keys:['cost','heat']"]
    assert run(tmp_path, *costs, "--n-trials", "3", "--cost-limit", "1", "0.5") == 0
    folder = tmp_path / "trpo_lag" / "CostPoint-v0_tune"
    for one in study_in(folder).trials:
        heat = 50 * one.user_attrs["hyperparams"]["target_kl"]
        assert one.constraints == pytest.approx({"cost": -0.8, "heat": heat - 0.5})
    assert "cost heat" in capsys.readouterr().out


def test_trains_for_real(tmp_path, folder):
    assert run(tmp_path, "--n-trials", "2", "--seeds", "0", "1", "--verbose", "0") == 0
    table = pd.read_csv(folder / "trials.csv")
    assert table["state"].tolist() == ["complete"] * 2
    assert np.isfinite(table[["return", "cost"]].to_numpy()).all()
    histories = [one.user_attrs["seed 1"] for one in study_in(folder).trials]
    assert np.shape(histories) == (2, 4, 2)
    # The first trial is of the shipped hyper-parameters, again the same.
    assert run(tmp_path, "--n-trials", "1", "--seeds", "0", "1", "--study-name", "again") == 0
    again = pd.read_csv(folder.with_name("CostPoint-v0_tune_again") / "trials.csv")
    pd.testing.assert_series_equal(
        table.loc[0, ["return", "cost"]], again.loc[0, ["return", "cost"]]
    )


def test_a_normalised_agent_is_evaluated_as_it_was_trained(tmp_path, folder):
    assert run(tmp_path, "-params", "normalize:True", "--n-trials", "1") == 0
    assert states(folder) == {"COMPLETE": 1}


def test_a_seeded_search_is_the_same_again(tmp_path, monkeypatch):
    pretend(monkeypatch, by_kl)
    tables, search = [], "--n-trials 6 --n-startup-trials 3 --seed 4".split()
    for name in ("one", "other"):
        assert run(tmp_path, *search, "--study-name", name) == 0
        path = tmp_path / "trpo_lag" / f"CostPoint-v0_tune_{name}" / "trials.csv"
        tables.append(pd.read_csv(path).drop(columns=["seconds", "worker"]))
    pd.testing.assert_frame_equal(*tables)


# Nothing is lost


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_trial_is_done_later(tmp_path, folder, monkeypatch, capsys, number):
    whole, done = tuning.Evaluations._on_step, []

    def step(self):
        if self.num_timesteps >= 100 and self.experiment.args["seed"] == 1 and not done:
            done.append(True)
            os.kill(os.getpid(), number)
        return whole(self)

    monkeypatch.setattr(tuning.Evaluations, "_on_step", step)
    command = ["--n-trials", "2", "--seeds", "0", "1"]
    assert run(tmp_path, *command) == 128 + number
    out, err = capsys.readouterr()
    assert "The same command continues the study." in out and "Stopping" in err
    assert "Traceback" not in out + err
    assert states(folder) == {"FAIL": 1, "WAITING": 1}
    trained = []
    pretend(monkeypatch, lambda values, seed: trained.append(seed) or (1.0, 0.0))
    before = study_in(folder).trials[0]
    assert run(tmp_path, *command) == 0
    assert states(folder) == {"FAIL": 1, "COMPLETE": 2}
    assert study_in(folder).trials[1].params == before.params
    assert trained == [1] * 4 + [0] * 4 + [1] * 4  # seed 0 of the first trial was done before
    assert "0 of 2 trials are finished" in capsys.readouterr().out


def test_n_trials_counts_those_of_the_study(tmp_path, folder, monkeypatch, capsys):
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "3") == 0
    assert run(tmp_path, "--n-trials", "3") == 0
    assert states(folder) == {"COMPLETE": 3}
    assert run(tmp_path, "--max-total-trials", "5", "--sampler", "random") == 0
    assert states(folder) == {"COMPLETE": 5}
    assert "3 of 5 trials are finished" in capsys.readouterr().out


def slow(monkeypatch, seconds: float) -> None:
    def outcome(values, seed):
        import time

        time.sleep(seconds / 4)
        return by_kl(values, seed)

    pretend(monkeypatch, outcome)


def owned_by(study: optuna.Study, pid: int) -> list[optuna.trial.FrozenTrial]:
    name = f"-{pid}-"
    return [t for t in study.trials if name in t.user_attrs.get(storages.OWNER, {}).get("name", "")]


def test_a_killed_workers_trial_is_done_by_another(tmp_path, folder, monkeypatch):
    slow(monkeypatch, 0.4)
    command = [*TOY, *SMALL, "-f", str(tmp_path), "--pruner", "none", "--n-trials", "6"]
    first, second = (fork(tune.main, command, tmp_path / f"{i}.txt") for i in range(2))
    wait_for(lambda: (folder / "study.journal").exists())
    wait_for(lambda: "trial" in (tmp_path / "0.txt").read_text())
    study = study_in(folder)
    wait_for(
        lambda: (
            any(one.state == TrialState.RUNNING for one in owned_by(study, first))
            and bool(owned_by(study, second))
        )
    )
    os.kill(first, signal.SIGKILL)
    assert join(first) == -signal.SIGKILL
    assert join(second) == 0, (tmp_path / "1.txt").read_text()
    assert states(folder) == {"COMPLETE": 6, "FAIL": 1}
    (lost,) = (one for one in study_in(folder).trials if one.state == TrialState.FAIL)
    (again,) = (
        t for t in study_in(folder).trials if t.system_attrs.get("failed_trial") is not None
    )
    assert again.system_attrs["failed_trial"] == lost.number
    assert lost.params.items() <= again.params.items()


def test_a_killed_workers_trial_is_done_at_the_next_start(tmp_path, folder, monkeypatch):
    slow(monkeypatch, 2.0)
    command = [*TOY, *SMALL, "-f", str(tmp_path), "--pruner", "none", "--n-trials", "1"]
    first = fork(tune.main, command, tmp_path / "0.txt")
    wait_for(lambda: "RUNNING" in states_or_none(folder))
    os.kill(first, signal.SIGKILL)
    join(first)
    pretend(monkeypatch, by_kl)
    assert tune.main(command) == 0
    assert states(folder) == {"FAIL": 1, "COMPLETE": 1}
    left = {path.name for path in (folder / "study.journal.workers").iterdir()}
    assert left == {"claim.lock", "journal.lock"}  # none of workers


def states_or_none(folder) -> dict:
    if not (folder / "study.journal").exists():
        return {}
    try:
        return states(folder)
    except KeyError:  # the study is not yet written
        return {}


def test_trials_that_kill_their_workers_are_given_up(tmp_path):
    storage = storages.Journal(tmp_path / "study.journal")
    study = optuna.create_study(storage=storage.storage)
    for _ in range(storages.MOST_RETRIES + 1):
        with storage.claim(study):
            study.ask()  # and dies before it says whose it is
    with storage.claim(study):
        pass
    assert Counter(one.state.name for one in study.trials) == {"FAIL": storages.MOST_RETRIES + 1}
    storage.close()


@pytest.mark.parametrize("stopped", [False, True])
def test_a_trial_is_not_lost_between_failing_and_queueing(tmp_path, monkeypatch, stopped):
    """Whoever gives it back dies after the first of the two, too; then it is given back once."""

    class Killed(BaseException):
        pass

    def die(*_: object, **__: object) -> None:
        raise Killed

    storage = storages.Journal(tmp_path / "study.journal")
    study = optuna.create_study(storage=storage.storage)
    study.ask()  # and its worker dies
    for name in ("add_trial", "tell"):
        with monkeypatch.context() as patch, pytest.raises(Killed):
            patch.setattr(optuna.Study, name, die)
            if stopped:
                storages.queue_again(study, study.trials[0])
                storages.queue_again(study, study.trials[0])  # as after an outage
                study.tell(0, state=TrialState.FAIL)
            with storage.claim(study):
                pass
        assert study.trials[0].state == TrialState.RUNNING
    for _ in range(2):
        with storage.claim(study):
            pass
    assert [one.state.name for one in study.trials] == ["FAIL", "WAITING"]
    storage.close()


def test_a_cut_line_of_the_journal_is_mended(tmp_path, folder, monkeypatch):
    """As a full disk leaves it."""
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "2") == 0
    journal = folder / "study.journal"
    content = journal.read_bytes()
    journal.write_bytes(content + b'{"op_code":8,"wor')
    assert run(tmp_path, "--n-trials", "3") == 0
    assert states(folder) == {"COMPLETE": 3}
    assert journal.read_bytes().startswith(content)


def test_a_full_disk_is_a_clear_error(tmp_path, folder, monkeypatch, capsys):
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "2") == 0
    table = (folder / "trials.csv").read_bytes()

    def full(self, logs):
        raise OSError(28, "No space left on device")

    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(JournalFileBackend, "append_logs", full)
        assert run(tmp_path, "--n-trials", "3") == 2
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    assert "No space left on device; what is in it is intact" in err.splitlines()[-1]
    assert (folder / "trials.csv").read_bytes() == table
    assert run(tmp_path, "--n-trials", "3") == 0
    assert states(folder)["COMPLETE"] == 3


def test_a_trial_given_to_another_is_left_to_it(tmp_path, folder, monkeypatch, capsys):
    """As after a long pause of this process: another worker has failed and repeated its trial."""
    taken = []

    def outcome(values, seed):
        if not taken:
            taken.append(True)
            study = study_in(folder)
            (trial,) = study.get_trials(states=(TrialState.RUNNING,))
            study.tell(trial.number, state=TrialState.FAIL)
        return by_kl(values, seed)

    pretend(monkeypatch, outcome)
    assert run(tmp_path, "--n-trials", "2") == 0
    assert "Trial 0 was taken for lost and given to another worker" in capsys.readouterr().out
    assert states(folder) == {"FAIL": 1, "COMPLETE": 2}


def test_several_processes(tmp_path, monkeypatch):
    """--n-jobs starts the same command again; stand-ins take down how."""
    calls, ends = [], []

    def popen(command, **kwargs):
        calls.append(command)
        return SimpleNamespace(
            poll=lambda: None, terminate=lambda: ends.append(1), wait=lambda: None
        )

    monkeypatch.setattr(tuning.subprocess, "Popen", popen)
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "2", "--n-jobs", "3") == 0
    assert len(calls) == len(ends) == 2
    assert calls[0][1:3] == ["-m", "sb3_guard.tune"] and "CostPoint-v0" in calls[0]
    assert calls[0][-4:] == ["--n-jobs", "1", "--worker-of", str(os.getpid())]


def test_a_worker_ends_with_the_process_that_started_it(tmp_path, folder, monkeypatch):
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "2", "--worker-of", "1000000") == 0
    assert study_in(folder).get_trials(states=(TrialState.COMPLETE,)) == []


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
    trials = study_in(folder).trials
    assert trials[0].constraints["cost"] > max(one.constraints["cost"] for one in trials[1:])
    assert pd.read_csv(folder / "trials.csv")["error"][0] == "the policy is NaN"


def test_nothing_but_failures_ends_it(tmp_path, monkeypatch, capsys):
    def outcome(values, seed):
        raise ValueError("no cost\nin info")

    pretend(monkeypatch, outcome)
    refused(
        lambda arguments: run(tmp_path, *arguments), ["--n-trials", "9"], capsys,
        "3 trials in a row failed, the last one: no cost in info",
    )  # fmt: skip


def test_a_cost_that_is_no_number_fails_the_trial(tmp_path, capsys):
    refused(
        tune.main, [*TOY, *SMALL, "-f", str(tmp_path), "--env", "Flickering-v0",
                    "--env-kwargs", "episode_length:50"],
        capsys, "3 trials in a row failed", "nan",
    )  # fmt: skip


# What is typed wrongly

WRONG = [
    (["--sampler", "tpu"], ["unknown sampler 'tpu'", "did you mean 'tpe'?", "nsgaii"]),
    (["--pruner", "medium"], ["unknown pruner 'medium'", "did you mean 'median'?", "halving"]),
    (["--cost-limit", "-1"], ["--cost-limit -1.0", "at least 0"]),
    (["--cost-limit", "nan"], ["--cost-limit nan", "at least 0"]),
    (["--cost-limit", "low"], ["--cost-limit", "'low'"]),
    (["--cost-limit", "1", "2"], ["selection_limit", "2 entries"]),
    (["--pareto", "--pruner", "median"], ["no pruning with --pareto"]),
    (["--algo", "trpo_lga"], ["unknown algorithm 'trpo_lga'", "did you mean 'trpo_lag'?"]),
    (["--env", "Gaol_Point_8Hazards"], ["'Gaol'", "'Goal'"]),
    (["--env-kwargs", "length:3"], ["CostPoint-v0", "'length'"]),
    (["-params", "lambda_rl:1"], ["'lambda_rl'", "did you mean 'lambda_lr'?"]),
    (["-params", "lambda_lr:fast"], ["lambda_lr", "'fast'", "a number"]),
    (["--n-trials", "0"], ["--n-trials", "at least 1"]),
    (["--seeds", "0", "0"], ["--seeds 0 0", "twice"]),
    (["--seeds", "-3"], ["seed -3", "from 0"]),
    (["--seeds", "1", "--n-seeds", "2"], ["--n-seeds", "--seeds"]),
    (["--n-evaluations", "500"], ["--n-evaluations 500", "240 steps"]),
    (["--n-startup-trials", "-1"], ["--n-startup-trials -1", "at least 0"]),
    (["--storage", "redis://here"], ["--storage redis://here", "must be postgresql://"]),
    (["--storage-timeout", "-1"], ["--storage-timeout -1", "at least 0"]),
    (["--search-space", "absent.yml"], ["--search-space", "absent.yml"]),
    (["-conf", "absent.yml"], ["absent.yml"]),
    (["--trials", "3"], ["unknown flag --trials", "did you mean"]),
    (["-f", "/proc/nowhere"], ["-f", "'/proc/nowhere"]),
]


@pytest.mark.parametrize(("wrong", "parts"), WRONG, ids=lambda v: " ".join(v)[:40])
def test_wrong_flags_change_nothing(empty, capsys, wrong, parts):  # noqa: F811
    refused(tune.main, [*TOY, *SMALL, *wrong], capsys, *parts)


def test_an_algorithm_without_a_space():
    with pytest.raises(UsageError, match="no search space for mine; give one with --search-space"):
        Search("mine", {})


@pytest.mark.parametrize(
    ("name", "allowed"), [("target", "'target'"), ("n_steps", "n_steps"), ("gamma", "gamma")]
)
def test_spaces_are_checked_with_the_algorithm(tmp_path, capsys, name, allowed):
    path = tmp_path / "space.yml"
    path.write_text(f"{name}: [x, y]")
    command = [*TOY, "-f", str(tmp_path / "logs"), "--search-space", str(path)]
    refused(tune.main, command, capsys, allowed)
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("other", "parts"),
    [
        (["--cost-limit", "5"], ["begun with"]),
        (["-n", "120"], ["n timesteps 240, not 120"]),
        (["--seeds", "1"], ["seeds [0], not [1]"]),
        (["-params", "n_steps:60"], ["hyperparams n_steps 30, not 60"]),
    ],
)
def test_a_study_is_continued_as_it_was_begun(tmp_path, folder, monkeypatch, capsys, other, parts):
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "1") == 0
    capsys.readouterr()
    refused(lambda arguments: run(tmp_path, *arguments), other, capsys, *parts, "--study-name")
    assert states(folder) == {"COMPLETE": 1}


@pytest.mark.parametrize("content", [b"\x00\x01\n\x02\n", b"{}\n", b"[1]\n{}\n"])
def test_files_that_are_no_studies(tmp_path, capsys, content):
    path = tmp_path / "file"
    path.write_bytes(content)
    command = [*TOY, *SMALL, "-f", str(tmp_path), "--storage", str(path)]
    refused(tune.main, command, capsys, str(path), "not a study")
    assert path.read_bytes() == content


@pytest.mark.parametrize("directions", [["maximize"], ["maximize", "minimize"]])
def test_a_study_of_somebody_else(tmp_path, folder, capsys, directions):
    folder.mkdir(parents=True)
    storage = JournalStorage(JournalFileBackend(str(folder / "study.journal")))
    name = "trpo_lag_CostPoint-v0"
    study = optuna.create_study(storage=storage, study_name=name, directions=directions)
    if len(directions) == 1:
        study.add_trial(create_trial(value=1.0))
    refused(lambda arguments: run(tmp_path, *arguments), [], capsys, "not one of sb3_guard's")


def test_a_study_whose_creator_died_at_once_is_begun(tmp_path, folder, monkeypatch):
    folder.mkdir(parents=True)
    storage = JournalStorage(JournalFileBackend(str(folder / "study.journal")))
    optuna.create_study(storage=storage, study_name="trpo_lag_CostPoint-v0", direction="maximize")
    pretend(monkeypatch, by_kl)
    assert run(tmp_path, "--n-trials", "2") == 0
    assert study_in(folder).trials[0].params["target_kl"] == 0.02  # that of the shipped file


def test_a_study_whose_beginner_died_in_between_is_begun(tmp_path, folder, monkeypatch):
    class Killed(BaseException):
        pass

    def die(self, params):
        raise Killed

    pretend(monkeypatch, by_kl)
    with monkeypatch.context() as patch:
        patch.setattr(optuna.Study, "enqueue_trial", die)
        with pytest.raises(Killed):
            run(tmp_path, "--n-trials", "2")
    assert run(tmp_path, "--n-trials", "2") == 0
    assert states(folder) == {"COMPLETE": 2}
    assert study_in(folder).trials[0].params["target_kl"] == 0.02  # that of the shipped file


def test_help_and_dispatcher(capsys, tmp_path):
    with pytest.raises(SystemExit) as end:
        cli.main(["tune", "--help"])
    assert end.value.code == 0
    out = capsys.readouterr().out
    assert "python -m sb3_guard.tune --algo trpo_lag" in out and "--worker-of" not in out
    assert cli.main(["tune", "--sampler", "no", "-f", str(tmp_path)]) == 2


@pytest.mark.slow
def test_several_processes_for_real(tmp_path, folder):
    """One command, two workers; when the first is told to stop, both do, and nothing is lost."""
    command = [sys.executable, "-m", "sb3_guard.tune", *TOY, *SMALL, "-f", str(tmp_path)]
    command += ["-n", "1e6", "--n-jobs", "2"]
    with subprocess.Popen(
        command,
        cwd=Path(__file__).parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as first:
        wait_for(lambda: states_or_none(folder).get("RUNNING") == 2, 300)
        wait_for(lambda: all(storages.OWNER in t.user_attrs for t in study_in(folder).trials))
        owners = [one.user_attrs[storages.OWNER]["name"] for one in study_in(folder).trials]
        workers = [int(name.split("-")[-2]) for name in owners]
        assert len({first.pid, *workers}) == 2
        first.terminate()
        out, err = first.communicate(timeout=300)
    assert first.returncode == 128 + signal.SIGTERM
    assert "Traceback" not in out + err
    assert states(folder) == {"FAIL": 2, "WAITING": 2}
    for pid in workers:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)

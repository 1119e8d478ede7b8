"""An algorithm against its variant: the same settings, one grid, and how far they are apart."""

import inspect
import math
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import registered_envs  # noqa: F401
from cost_envs import CostPoint
from fake_runs import fake_run
from killed import environment
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import sb3_guard
from sb3_guard import CPPOPID, PPOLag, benchmark, make_model, plot
from sb3_guard.algorithms import CostRollouts, TrustRegion, hyperparameter, register_algorithm
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.results.runs import read_results, select
from sb3_guard.zoo.results.statistics import differences
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.hyperparams import read_hyperparams
from sb3_guard.zoo.run.run import Run
from sb3_guard.zoo.tuning.flags import TuneFlags
from sb3_guard.zoo.tuning.search import prepare

ROOT = Path(__file__).parents[2]
GOAL, POINT = "SafetyPointGoal1-v0", "Goal_Point_8Hazards-v0"


@pytest.fixture(autouse=True)
def table(monkeypatch):
    """The algorithms, to which a test adds its own."""
    table = dict(sb3_guard.ALGORITHMS)
    for module in ("algorithms", "zoo.run.algos", "zoo.run.hyperparams"):
        monkeypatch.setattr(f"sb3_guard.{module}.ALGORITHMS", table)


class Changed(PPOLag):
    """With one default of its own in the class and one in the constructor."""

    lambda_lr: float = hyperparameter(0.7)
    price: float = hyperparameter(0.0)

    def __init__(self, *args, n_steps=64, **kwargs):
        super().__init__(*args, n_steps=n_steps, **kwargs)


@pytest.mark.parametrize(
    ("bases", "base"),
    [((PPOLag,), "ppo_lag"), ((CPPOPID,), "cppo_pid"), ((CostRollouts, PPO), "ppo"),
     ((TrustRegion,), "trpo")],
)  # fmt: skip
def test_a_variant_has_the_hyperparameters_of_its_nearest_base(bases, base):
    register_algorithm("mine", type("Further", (type("Mine", bases, {}),), {}))
    register_algorithm("another_name", PPOLag)
    for env_id in (GOAL, POINT, "Anything-v0"):
        assert read_hyperparams("mine", env_id) == read_hyperparams(base, env_id)
    assert read_hyperparams("another_name", GOAL) == read_hyperparams("ppo_lag", GOAL)


def test_a_default_that_the_class_states_comes_before_the_file_of_its_base(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # -conf names a shipped file from anywhere
    register_algorithm("mine", Changed)
    values, theirs = (read_hyperparams(algo, GOAL) for algo in ("mine", "ppo_lag"))
    assert values == {k: v for k, v in theirs.items() if k not in ("lambda_lr", "n_steps")}
    given = read_hyperparams("mine", GOAL, overrides={"n_steps": 9, "price": 0.5})
    assert given == {**values, "n_steps": 9, "price": 0.5}
    assert read_hyperparams("mine", GOAL, "ppo_lag") == theirs
    with pytest.raises(UsageError, match="a name such as ppo_lag"):
        read_hyperparams("mine", GOAL, "ppo_lga")


def test_whose_hyperparameters_they_are_is_said_once(capsys):
    register_algorithm("told", Changed)
    register_algorithm("based", type("Based", (TrustRegion,), {}))
    for env in (POINT, GOAL):
        assert make_model("told", env, verbose=1, n_envs=2, batch_size=32).aim == "certificate"
        Run.check(RunFlags(algo="based", env=env))
    Run.check(RunFlags(algo="told", env=env, conf_file="trpo_lag"))
    flags = TuneFlags(algo="told", env="CostPoint-v0", hyperparams={"cost_limit": 2.0})
    assert prepare(flags)[1].hyperparams["batch_size"] == 250
    assert capsys.readouterr().out.splitlines() == [
        "hyperparameters of told: those of ppo_lag",
        "hyperparameters of based: those of trpo",
        f"cost_limit of based on {POINT}: 2, the usual one",
        f"cost_limit of based on {GOAL}: 25, the usual one",
    ]
    register_algorithm("worst", type("Worst", (TrustRegion,), {"limit_on": "max"}))
    with pytest.raises(UsageError, match="no cost limit is known"):  # the usual one is of a sum
        Run.check(RunFlags(algo="worst", env=GOAL))


# The page


PAGE = (ROOT / "docs" / "writing_an_algorithm.md").read_text()
SECTION = PAGE.partition("## Change an algorithm that is there")[2].partition("\n## ")[0]


def test_the_three_changes_of_the_page_change_what_they_say(tmp_path, monkeypatch):
    names: dict = {}
    exec("\n".join(re.findall(r"```python\n(.*?)```", SECTION, re.DOTALL)), names)
    env = make_vec_env(lambda: CostPoint(20, hazard=(-1.0, 0.0)), 2)

    def trained(name, **arguments):
        names[name]("MlpPolicy", env, cost_limit=0.5, **arguments).learn(80).save(tmp_path / name)
        return names[name].load(tmp_path / name, env).learn(80)

    capped = trained("PPOCapped", n_steps=40, batch_size=40, lambda_init=5.0)
    short = trained("CPOShort", n_steps=40, share=0.25)
    price = trained("SACPrice", learning_starts=40, price=2.0)
    assert capped.prices > 1.0 and capped.weights(np.float64([0.3])) == np.float32(0.3)
    monkeypatch.setattr(names["CPO"], "plan", lambda self, region: (region, None))
    assert short.plan(8.0) == (2.0, None)
    monkeypatch.setattr(names["SACLag"], "learn_from", lambda self, batch, step: batch.rewards)
    batch = price.replay_buffer.sample(64)
    assert (price.learn_from(batch, 0) == batch.rewards - 2.0 * batch.costs).all()
    assert batch.costs.any()


def test_methods_that_may_be_overridden_have_the_signatures_of_the_page():
    rows = re.findall(r"^\| `(\w+)`.*? \| (`.*) \|$", SECTION, re.MULTILINE)
    signatures = [(c, *m) for c, text in rows for m in re.findall(r"`(\w+)\((.*?)\)`", text)]
    assert len(rows) == 5 and len(signatures) == 14
    for name, method, stated in signatures:
        taken = inspect.signature(getattr(getattr(sb3_guard, name), method)).parameters.values()
        shown = [p.name + f"={p.default}" * (p.default is not p.empty) for p in taken]
        assert ", ".join(shown[1:]) == stated, f"{name}.{method}"


# A grid


def test_a_grid_compares_an_algorithm_of_a_module(tmp_path, monkeypatch, capsys):
    """Two seeds of two algorithms in a process of their own; tables and figures; a lost result."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "examples" / "custom_algorithm.py", tmp_path)
    packages = "--gym-packages registered_envs custom_algorithm"
    grid = (
        f"{packages} --algos trpo_lag trpo_price --envs CostPoint-v0 -n 800 -f grid --jobs 1 "
        "--env-kwargs episode_length:20 --eval-freq -1 --device cpu "
        "-params n_envs:2 n_steps:100 n_critic_updates:1 cost_limit:5"
    ).split()
    command = [sys.executable, "-m", "sb3_guard.benchmark", *grid]
    run = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)
    assert run.returncode == 0 and "trpo_price: those of trpo" in run.stdout, run.stderr
    assert benchmark.main([*grid, "--dry-run"]) == 0
    assert "4 of 4 done" in capsys.readouterr().out
    assert plot.main("grid --table t.md --figure curves -o f".split()) == 0
    assert Path("f/curves_CostPoint-v0.png").is_file()
    assert re.search(
        r"TRPO with a fixed weight − TRPO-Lagrangian \| final, sampled actions \| 2, 2 +\| 800 +\|"
        r" [−\d., ]+ \[[−\d., ]+\]", Path("t.md").read_text(),
    )  # fmt: skip
    lost = Path("grid/trpo_price/CostPoint-v0_2")
    (lost / "result.json").unlink()
    assert plot.main("grid --table runs.csv".split()) == 0
    assert f"sb3-guard train -i {lost} {packages} continues it" in capsys.readouterr().err


# Is the difference real?


def test_the_difference_has_welchs_interval(tmp_path):
    """Where one's seeds are alike it is the other's own: d ± t(0.975, 2) s/√3, where t = 4.303."""
    for seed, extra in enumerate((-1.0, 0.0, 1.0)):
        fake_run(tmp_path, "cpo", seed=seed, returns=20.0, cost=4.0 + extra, epochs=1)
        fake_run(tmp_path, "mine", seed=seed, returns=26.0, cost=2.0, epochs=1)
    runs = select(read_results([tmp_path]).runs)
    (row,) = differences(runs).to_dict("records")
    assert (row["label"], row["seeds"], row["split"]) == ("My own − CPO", "3, 3", "training")
    assert row["return"] == pytest.approx(6.0) and row["cost"] == pytest.approx(-2.0)
    half = 4.302653 / math.sqrt(3)
    assert (row["cost_low"], row["cost_high"]) == pytest.approx((-2 - half, -2 + half), rel=1e-6)
    (single,) = differences(runs[runs["seed"] == 0]).to_dict("records")
    assert single["cost"] == pytest.approx(-1.0) and math.isnan(single["cost_low"])
    fake_run(tmp_path, "pcpo")
    assert differences(select(read_results([tmp_path]).runs)).empty  # which two?


def test_a_shorter_run_is_named_and_left_out(tmp_path, capsys):
    short = fake_run(tmp_path / "logs", returns=1.0, epochs=3)
    fake_run(tmp_path / "logs", returns=20.0, epochs=6, seed=1)
    fake_run(tmp_path / "logs", "trpo", epochs=3)
    assert plot.main([str(tmp_path / "logs"), "--table", str(tmp_path / "t.md")]) == 0
    assert f"left out: {short}: 300 steps, where the longest run" in capsys.readouterr().err
    assert re.search(r"CPO .* 600 .* 20\.00 ", (tmp_path / "t.md").read_text())

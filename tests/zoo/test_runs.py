"""Tables of runs: read, left out, chosen, and what a reader of their means is told."""

import json
import math

import pandas as pd
import pytest
from fake_runs import fake_run

from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.results.runs import choose, read_curve, read_results, select

HAZARDS, GHOSTS = "Goal_Point_8Hazards", "Goal_Point_8Ghosts"


def edit(run, **changes):
    file = run / "result.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def params(run, name):
    return run / f"{HAZARDS}-v0" / name


def test_a_row_says_all_about_a_run(tmp_path):
    versions = {"mujoco": "4.0.0", "python": "3.11.4"}
    path = fake_run(
        tmp_path, seed=3, cost_limit=25, seconds=12.5, versions=versions, commit="abc",
        platform="Linux",
    )  # fmt: skip
    table = read_results([tmp_path]).runs
    (row,) = table.to_dict("records")
    expected = {
        "suite": HAZARDS,
        "algo": "cpo", "label": "CPO", "family": "CPO-based", "seed": 3, "steps": 600, "J_r": 20.0,
        "M_c": 5.0, "rho_c": 0.5, "cost_limit": 25.0, "limits": "25", "seconds": 12.5,
        "epoch": 100, "mujoco": "4.0.0", "python": "3.11.4", "commit": "abc", "platform": "Linux",
        "path": str(path), "episodes": 10,
    }  # fmt: skip
    assert {key: row[key] for key in expected} == expected
    assert pd.isna(row["torch"])


def test_an_algorithm_that_states_no_name_has_its_key(tmp_path):
    fake_run(tmp_path, "sac_x", env="CartPole-v1", label=None, family=None)
    (row,) = read_results([tmp_path]).runs.to_dict("records")
    assert (row["suite"], row["label"], row["family"]) == ("CartPole-v1", "SAC-X", "")
    assert math.isnan(row["seconds"]) and pd.isna(row["commit"])


def test_the_reference_comes_first_then_family_by_family(tmp_path):
    for algo in ("trpo_lag", "ppo", "cpo", "trpo", "mine", "pcpo"):
        fake_run(tmp_path, algo)
    labels = read_results([tmp_path]).runs["label"].tolist()
    assert labels == ["TRPO", "PPO", "CPO", "PCPO", "My own", "TRPO-Lagrangian"]


def test_folders_may_overlap_and_numbers_sort_as_numbers(tmp_path):
    for number in (10, 9, 2):
        fake_run(tmp_path, number=number, seed=0)
    found = read_results([tmp_path, tmp_path / "cpo", tmp_path / "cpo" / ".."]).runs
    assert [path[-2:] for path in found["path"]] == ["_2", "_9", "10"]
    # The same run three times: the one with the greatest number counts.
    (path,) = select(found)["path"]
    assert path.endswith("_10")
    assert len(read_results([path]).runs) == 1


DAMAGE = {
    "unfinished": lambda run: (run / "result.json").unlink(),
    "is damaged": lambda run: (run / "result.json").write_text('{"return": 1'),
    "KeyError: 'costs'": lambda run: (run / "result.json").write_text("{}"),
    "no env, algo or seed": lambda run: params(run, "args.yml").write_text("env: 3"),
    "can't read": lambda run: (run / "0.monitor.csv").unlink(),
    "config.yml": lambda run: params(run, "config.yml").write_text("a: ["),
}


@pytest.mark.parametrize("why", DAMAGE)
def test_a_damaged_run_is_named_and_left_out(tmp_path, why):
    whole, broken = fake_run(tmp_path), fake_run(tmp_path, seed=1)
    DAMAGE[why](broken)
    found = read_results([tmp_path])
    assert found.runs["path"].tolist() == [str(whole)]
    assert list(found.left_out) == [str(broken)] and why in found.left_out[str(broken)]


def test_runs_at_several_limits_are_not_averaged(tmp_path):
    fake_run(tmp_path, "trpo")
    for limit in ([1.0, 2.0], [3.0], [50.0, 50.0]):
        fake_run(tmp_path, cost_limit=limit)
    found = read_results([tmp_path]).runs
    assert found["limits"].fillna("–").tolist() == ["–", "3", "1 2", "50 50"]
    assert found["cost_limit"][1] == 3.0 and found["cost_limit"].notna().sum() == 1
    with pytest.raises(UsageError, match=r"1 2, 3, 50 50, .*--cost-limit 50 50"):
        select(found)
    assert select(choose(found, cost_limit=[50, 50]))["algo"].tolist() == ["trpo", "cpo"]
    with pytest.raises(UsageError, match=r"no run at cost limit 1; .* 1 2, 3, 50 50"):
        choose(found, cost_limit=[1])


def test_an_environment_is_chosen_with_or_without_its_version(tmp_path):
    goal, slow, fast = "SafetyPointGoal1-v0", "SafetyHopperVelocity-v0", "SafetyHopperVelocity-v1"
    for env in (goal, slow, fast):
        fake_run(tmp_path, env=env)
    found = read_results([tmp_path]).runs
    for name in (goal, "SafetyPointGoal1"):
        assert choose(found, [name])["suite"].tolist() == [goal]
    assert choose(found, [fast])["suite"].tolist() == [fast]
    assert choose(found, ["SafetyHopperVelocity"])["suite"].tolist() == [slow, fast]
    with pytest.raises(UsageError, match="'SafetyPointGoal1-v1'; did you mean"):
        choose(found, [goal, "SafetyPointGoal1-v1"])


def test_environments_of_other_settings_are_not_compared(tmp_path):
    fake_run(tmp_path, "trpo", config={"env_kwargs": {"num": 2}})
    fake_run(tmp_path, config={"env_kwargs": None})
    with pytest.raises(UsageError, match=r'env_kwargs, \{"num": 2\}, \{\}, '):
        select(read_results([tmp_path]).runs)


@pytest.mark.parametrize(
    "other",
    [{"seed": 1, "config": {"env_wrapper": "a.B"}}, {"args": {"trained_agent": "old.zip"}},
     {"epochs": 3}],
)  # fmt: skip
def test_unequal_runs_are_not_averaged(tmp_path, other):
    fake_run(tmp_path)
    fake_run(tmp_path, **other)
    with pytest.raises(UsageError, match=r"of cpo differ in .*give the folders of one kind"):
        select(read_results([tmp_path]).runs)


def test_curve_of_a_run(tmp_path):
    path = fake_run(tmp_path, returns=60.0, cost=2.0)
    curve = read_curve(path, 100)
    assert curve["step"].tolist() == [100, 200, 300, 400, 500, 600]
    assert curve["J_r"].tolist() == pytest.approx([10, 20, 30, 40, 50, 60])
    assert curve["M_c"].tolist() == pytest.approx([2.0] * 6)
    assert curve["rho_c"].iloc[-1] == pytest.approx(0.2)
    long = fake_run(tmp_path, epochs=60)
    assert len(read_curve(long, 10)) == len(read_curve(long)) == 200


@pytest.mark.parametrize("content", [None, "", "#{}\nr,l,t\n1,2,3\n", "#{}\nr,l,t,c\n",
                                     "#{}\nr,l,t,c\n1,10,1,2\n1,1"])  # fmt: skip
def test_damaged_curve(tmp_path, content):
    file = fake_run(tmp_path) / "0.monitor.csv"
    file.unlink() if content is None else file.write_text(content)
    with pytest.raises(UsageError, match=r"0\.monitor\.csv"):
        read_curve(file.parent)

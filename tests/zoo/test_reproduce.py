"""A published run is trained again from its command, and compared episode by episode."""

import json
import shutil

import pytest

from sb3_guard import reproduce, train

PACKAGES = ["--gym-packages", "registered_envs"]
TOY = (
    "--env CostPoint-v0 --env-kwargs episode_length:20 --seed 3 --eval-freq -1 --verbose 0 "
    "--device cpu -n 400 --num-threads 1 -params n_envs:2 n_steps:100 n_critic_updates:3 "
    "cost_limit:2"
).split()


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    assert train.main([*TOY, *PACKAGES, "-f", str(folder)]) == 0
    return folder


@pytest.fixture
def run(logs, tmp_path):
    return shutil.copytree(logs, tmp_path / "logs") / "cpo" / "CostPoint-v0_1"


def again(tmp_path, *arguments: str) -> int:
    return reproduce.main([*arguments, "-f", str(tmp_path / "again")])


def test_a_run_goes_the_same_way(run, tmp_path, capsys):
    assert again(tmp_path, str(run), *PACKAGES) == 0
    out = capsys.readouterr().out
    result = json.loads((run / "result.json").read_text())
    assert result["command"] in out and "The same: all training and final episodes agree" in out
    new = json.loads((tmp_path / "again" / "cpo" / "CostPoint-v0_4" / "result.json").read_text())
    assert new["final"] == result["final"] and "trained already" not in out
    assert again(tmp_path, str(run), *PACKAGES) == 0  # trains nothing, and says so
    out = capsys.readouterr().out
    assert 0 < out.index("This run was trained already") < out.index("The same")


def test_a_row_that_went_another_way(run, tmp_path, capsys, monkeypatch):
    result = json.loads((run / "result.json").read_text())
    cost = result["cost"] + 1
    rows = tmp_path / "rows.csv"
    rows.write_text(
        "row,command,curve,return,cost,commit\n"
        f'table/cpo/A_1,"{result["command"]}",0123,{result["return"]},{cost},abc\n'
    )
    monkeypatch.setattr(reproduce, "ROWS", rows)
    assert again(tmp_path, "table/cpo/A_1", *PACKAGES) == 1
    out = capsys.readouterr().out
    assert (
        "Not the same" in out
        and "  cost of the final epoch: before" in out
        and "The run before is of commit abc" in out
    )
    assert again(tmp_path, "table/cpo/A_2") == 2
    assert "did you mean 'table/cpo/A_1'" in capsys.readouterr().err


@pytest.mark.parametrize("split", ["stochastic", "greedy"])
def test_other_final_episodes_are_another_run(run, tmp_path, capsys, split):
    """Every tier is made of them."""
    result = json.loads((run / "result.json").read_text())
    costs = result["final"][split]["costs"]
    result["final"][split]["costs"] = [cost + 2 for cost in costs]
    (run / "result.json").write_text(json.dumps(result))
    assert again(tmp_path, str(run), *PACKAGES) == 1
    out = capsys.readouterr().out
    assert "Not the same: the final episodes differ" in out and "training episodes" not in out
    assert ("cost of the final policy, sampled actions: before" in out) == (split == "stochastic")


def test_a_claim_that_the_episodes_do_not_make(run, tmp_path, capsys):
    result = json.loads((run / "result.json").read_text())
    cost = {"mean": 0.1, "low": 0.0, "high": 0.2, "limit": 2.0, "verdict": "kept"}
    claims = {
        "return": 99.0, "cost": 0.0, "length": 7.0, "episodes": 1, "cost_limit": 9.0,
        "physics_errors": 3, "cost_rate": 0.0, "label": "Best", "costs": {"cost": cost},
    }  # fmt: skip
    for name, value in claims.items():
        (run / "result.json").write_text(json.dumps(result | {name: value}))
        assert again(tmp_path, str(run), *PACKAGES) == 1, name
        said = capsys.readouterr().out
        assert reproduce.MEASURES.get(name, name) in said and "The same" not in said


def test_a_claim_of_the_table_that_the_episodes_do_not_make(run, tmp_path, capsys, monkeypatch):
    result = json.loads((run / "result.json").read_text())
    numbers = reproduce.measures(result)
    for name in numbers:
        row = {"row": "table/cpo/A_1", **{key: result[key] for key in ("command", "curve")}}
        row |= {"final": reproduce.final_hash(result), **numbers, name: numbers[name] + 1}
        (tmp_path / "rows.csv").write_text(
            ",".join(row) + "\n" + ",".join(f'"{value}"' for value in row.values()) + "\n"
        )
        monkeypatch.setattr(reproduce, "ROWS", tmp_path / "rows.csv")
        assert again(tmp_path, "table/cpo/A_1", *PACKAGES) == 1
        assert f"{reproduce.MEASURES[name]}: before" in capsys.readouterr().out


def test_another_processor_is_judged_by_the_spread_over_seeds(run, tmp_path, capsys, monkeypatch):
    result = json.loads((run / "result.json").read_text())
    monkeypatch.setattr(reproduce, "ROWS", tmp_path / "rows.csv")
    for spread, status, said in ((5.0, 0, "Alike"), (0.01, 1, "Not alike"), (None, 1, "one seed")):
        rows = ["row,command,curve,processor,return,cost"]
        for seed, sign in ((3, 1), (4, -1))[: 2 if spread else 1]:
            words = result["command"].replace("--seed 3", f"--seed {seed}")
            numbers = [result[name] + 1 + sign * (spread or 1.0) for name in ("return", "cost")]
            rows.append(f'table/cpo/A_{seed},"{words}",0123,Pentium,{numbers[0]},{numbers[1]}')
        (tmp_path / "rows.csv").write_text("\n".join(rows) + "\n")
        assert again(tmp_path, "table/cpo/A_3", *PACKAGES) == status
        before, _, after = capsys.readouterr().out.partition("Not the same: the training episodes")
        assert f"of Pentium, this is {result['processor']}" in before and said in after


def test_an_older_run_without_a_hash_is_refused(run, tmp_path, capsys):
    result = json.loads((run / "result.json").read_text())
    (run / "result.json").write_text(json.dumps(result | {"curve": None}))
    assert again(tmp_path, str(run), *PACKAGES) == 2
    assert "no hash of the episodes" in capsys.readouterr().err


def test_a_run_is_not_compared_with_itself(run, tmp_path, capsys):
    assert again(tmp_path, str(run), *PACKAGES) == 0
    assert again(tmp_path, str(tmp_path / "again/cpo/CostPoint-v0_4"), *PACKAGES) == 2
    assert "choose another --log-folder" in capsys.readouterr().err


def test_a_folder_of_runs_is_told_from_a_run(run, tmp_path, capsys):
    assert again(tmp_path, str(run.parent)) == 2
    assert f"run folders in it: {run}" in capsys.readouterr().err


def test_nothing_is_the_same_if_no_episode_has_ended(tmp_path, capsys):
    short = [*TOY, *PACKAGES, "-n", "60", "--env-kwargs", "episode_length:500"]
    assert train.main([*short, "-f", str(tmp_path / "logs")]) == 0
    assert again(tmp_path, str(tmp_path / "logs/cpo/CostPoint-v0_1"), *PACKAGES) == 1
    assert "No episode has ended: there is nothing to compare." in capsys.readouterr().out


def test_the_packages_own_table_can_be_read(tmp_path, capsys):
    assert again(tmp_path, "nothing/of/that_1") == 2
    assert "is no run folder" in capsys.readouterr().err

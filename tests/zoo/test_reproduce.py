"""A published run is trained again from its command, and compared episode by episode."""

import json

import pytest

from sb3_guard import reproduce, train

PACKAGES = ["--gym-packages", "registered_envs"]
TOY = (
    "--env CostPoint-v0 --env-kwargs episode_length:20 --seed 3 --eval-freq -1 --verbose 0 "
    "--device cpu -n 400 --num-threads 1 -params n_envs:2 n_steps:100 n_critic_updates:3 "
    "cost_limit:2"
).split()


@pytest.fixture
def run(tmp_path):
    assert train.main([*TOY, *PACKAGES, "-f", str(tmp_path / "logs")]) == 0
    return tmp_path / "logs" / "cpo" / "CostPoint-v0_1"


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


def test_logs_that_are_not_as_the_run_wrote_them(run, tmp_path, capsys):
    """Packed ones are rounded: the hash of the result counts, and the user is told."""
    monitor = run / "0.monitor.csv"
    lines = monitor.read_text().splitlines()
    monitor.write_text("\n".join([*lines[:-1], "9,20,9,9"]) + "\n")
    assert again(tmp_path, str(run), *PACKAGES) == 0
    out = capsys.readouterr().out
    assert "is not as the run wrote it" in out and "The same" in out and ", which took 0:00:" in out
    for damaged in (["r,l,t", "1.0,20,1"], [lines[1], "9"]):
        monitor.write_text("\n".join([lines[0], *damaged]) + "\n")
        assert again(tmp_path, str(run), *PACKAGES) == 2
        assert f"can't read {monitor}" in capsys.readouterr().err
    monitor.unlink()
    assert again(tmp_path, str(run), *PACKAGES) == 2
    assert f"can't read {monitor}: No such file" in capsys.readouterr().err


def test_a_claim_that_the_episodes_do_not_make(run, tmp_path, capsys):
    result = json.loads((run / "result.json").read_text())
    cost = {"mean": 0.1, "low": 0.0, "high": 0.2, "limit": 2.0, "verdict": "kept"}
    claims = {
        "return": 99.0, "cost": 0.0, "length": 7.0, "episodes": 1, "cost_limit": 9.0,
        "physics_errors": 3, "cost_rate": 0.0, "label": "Best", "costs": {"cost": cost},
    }  # fmt: skip
    for name, value in claims.items():
        (run / "result.json").write_text(json.dumps(result | {name: value}))
        assert again(tmp_path, str(run), *PACKAGES) in (1, 2), name
        said = "".join(capsys.readouterr())
        assert name.replace("_limit", "") in said and "The same" not in said


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
    for seconds in ("fast", float("nan")):
        (run / "result.json").write_text(json.dumps(result | {"seconds": seconds}))
        assert again(tmp_path, str(run), *PACKAGES) == 2
        assert "result.json is damaged" in capsys.readouterr().err


def test_a_run_is_not_compared_with_itself(run, tmp_path, capsys):
    assert again(tmp_path, str(run), *PACKAGES) == 0
    assert again(tmp_path, str(tmp_path / "again/cpo/CostPoint-v0_4"), *PACKAGES) == 2
    assert "choose another --log-folder" in capsys.readouterr().err


def test_a_folder_of_runs_is_told_from_a_run(run, tmp_path, capsys):
    assert again(tmp_path, str(run.parent)) == 2
    assert f"run folders in it: {run}" in capsys.readouterr().err


def test_a_command_imports_what_the_user_names_only(run, tmp_path, capsys):
    assert again(tmp_path, str(run)) == 2
    assert "only the command line may name" in capsys.readouterr().err
    assert not (tmp_path / "again").exists()


def test_hyperparameters_of_a_program_are_run_where_it_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sub.2").mkdir()
    (tmp_path / "sub.2" / "mine.py").write_text(
        "hyperparams = {'CostPoint-v0': dict(policy='MlpPolicy', n_timesteps=400)}"
    )
    assert train.main([*TOY, *PACKAGES, "-conf", "./sub.2/mine.py", "-f", "logs"]) == 0
    arguments = ["logs/cpo/CostPoint-v0_1", *PACKAGES]
    assert again(tmp_path, *arguments) == 2
    assert "then add --conf-file ./sub.2/mine.py" in capsys.readouterr().err
    assert again(tmp_path, *arguments, "-conf", "./sub.2/mine.py") == 0


def test_one_module_may_be_program_and_environment(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "both.py").write_text(
        "from tests.support.registered_envs import *\n"
        "hyperparams = {'CostPoint-v0': dict(policy='MlpPolicy', n_timesteps=400)}"
    )
    flags = [*TOY, "--gym-packages", "both", "-conf", "both", "-f", str(tmp_path / "logs")]
    assert train.main(flags) == 0
    arguments = [str(tmp_path / "logs/cpo/CostPoint-v0_1"), "--gym-packages", "both"]
    assert again(tmp_path, *arguments, "-conf", "both") == 0


def test_nothing_is_the_same_if_no_episode_has_ended(tmp_path, capsys):
    short = [*TOY, *PACKAGES, "-n", "60", "--env-kwargs", "episode_length:500"]
    assert train.main([*short, "-f", str(tmp_path / "logs")]) == 0
    assert again(tmp_path, str(tmp_path / "logs/cpo/CostPoint-v0_1"), *PACKAGES) == 1
    assert "No episode has ended: there is nothing to compare." in capsys.readouterr().out


def test_the_packages_own_table_can_be_read(tmp_path, capsys):
    assert again(tmp_path, "nothing/of/that_1") == 2
    assert "is no run folder" in capsys.readouterr().err

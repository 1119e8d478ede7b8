"""The leaderboard is made of packed logs, and what is sent in for it is checked."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from fake_runs import fake_run

from sb3_guard import train
from sb3_guard.zoo.results.runs import label_of
from sb3_guard.zoo.run.folder import RunFolder

ROOT = Path(__file__).parents[2]


@pytest.fixture
def scripts(monkeypatch, tmp_path):
    """The scripts, with a folder of data of their own."""
    monkeypatch.syspath_prepend(ROOT / "scripts")
    import archives
    import check_runs
    import grand_table
    import leaderboard
    import results

    data = tmp_path / "data"
    data.mkdir()
    for path in (ROOT / "docs" / "data").glob("*table*.yml"):
        shutil.copy(path, data)
    shutil.copy(ROOT / "docs" / "data" / "untrained.csv", data)
    for module in (archives, check_runs, results, leaderboard, grand_table):
        monkeypatch.setattr(module, "DATA", data)
    monkeypatch.setattr(check_runs, "MILLION", 600)
    yield leaderboard, archives, check_runs
    for name in ("archives", "check_runs", "grand_table", "leaderboard", "results"):
        sys.modules.pop(name)


def rows_of(text: str, heading: str) -> list[list[str]]:
    table = text.partition(f"### {heading}\n")[2].partition("###")[0]
    lines = [line for line in table.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def test_certified_rows_come_first_by_return(scripts, tmp_path):
    board, archives, _ = scripts
    for algo, mean, cost, seeds in (
        ("cpo", 10.0, 20.0, 3), ("pcpo", 12.0, 24.0, 3), ("p3o", 15.0, 24.0, 2),
        ("trpo_lag", 20.0, 30.0, 2),
    ):  # fmt: skip
        played_by(tmp_path / "logs", algo, mean, cost, seeds)
    archives.pack(tmp_path / "logs", "grand_table", by_environment=True)
    rows, runs = board.read()
    assert len(runs) == 10 and "grand_table/cpo/SafetyPointGoal1-v0_1" in {*runs["row"]}
    glance = [" ".join(line.split()) for line in board.glance(rows).splitlines()]
    assert glance[0] == "| 1e6 steps | PointGoal1 |"
    assert {"| PCPO | 12.0 / 24.0 ✓ (3) |", "| TRPO-Lagrangian | 20.0 / 30.0 ✗ (2) |"} < {*glance}
    table = rows_of(board.leaderboard(rows), "SafetyPointGoal1-v0, 1e6 steps")
    # Two seeds are too few for a place.
    assert [row[:3] for row in table[:4]] == [
        ["1", "PCPO", "3"], ["2", "CPO", "3"], ["–", "*P3O*", "*2 of 3*"],
        ["–", "*TRPO-Lagrangian*", "*2 of 3*"],
    ]  # fmt: skip
    assert table[0][-1] == "`sb3-guard reproduce grand_table/pcpo/SafetyPointGoal1-v0_1`"
    train = (
        "`sb3-guard train --algo {} --env SafetyPointGoal1-v0 --seeds {} -n 1000000 "
        "--eval-freq -1 --num-threads 1`"
    )
    assert table[2][-1].endswith(f"; missing: {train.format('p3o', 2)}")
    assert table[0][4] == "24.0 [24.0, 24.0]" and table[2][5] == "*certified*"
    assert table[3][6:8] == ["*100\xa0%*", "*0.20*"]
    missing = next(row for row in table if row[1] == "*PPO*")
    assert missing[-1] == train.format("ppo", "0 1 2")
    assert [row[1] for row in table[-2:]] == ["*random actions*", "*idle*"]
    # The same algorithms, sent in by another.
    archives.pack(tmp_path / "logs", "sent_again")
    rows, _ = board.read()
    table = rows_of(board.leaderboard(rows), "SafetyPointGoal1-v0, 1e6 steps")
    assert [row[1] for row in table[:5]] == ["PCPO", "PCPO", "CPO", "CPO", "*P3O*"]
    assert "sent_again/pcpo" in table[1][-1] and "missing" not in table[5][-1]
    assert [" ".join(line.split()) for line in board.glance(rows).splitlines()] == glance
    assert board.glance(rows.iloc[:0]) == ""


def test_a_seed_that_is_sent_in_joins_the_row_that_lacks_it(scripts, tmp_path):
    board, archives, _ = scripts
    played_by(tmp_path / "logs", "p3o", 15.0, 24.0, 2)
    archives.pack(tmp_path / "logs", "grand_table")
    shutil.rmtree(tmp_path / "logs")
    played_by(tmp_path / "logs", "p3o", 12.0, 21.0, 3)
    shutil.rmtree(tmp_path / "logs" / "p3o" / "SafetyPointGoal1-v0_1")
    archives.pack(tmp_path / "logs", "sent_rest")
    rows, runs = board.read()
    assert len(runs) == 4
    table = rows_of(board.leaderboard(rows), "SafetyPointGoal1-v0, 1e6 steps")
    # The seed that both have stays a row of its own.
    assert [row[:5] for row in table[:2]] == [
        ["1", "P3O", "3", "14.0\xa0±\xa01.7", "23.0 [21.0, 24.0]"],
        ["–", "*P3O*", "*1*", "*12.0*", "*21.0 [21.0, 21.0]*"],
    ]
    assert table[0][-1] == "`sb3-guard reproduce grand_table/p3o/SafetyPointGoal1-v0_1`"


def played_by(folder: Path, algo: str, mean: float, cost: float, seeds: int) -> None:
    """Runs on SafetyPointGoal1 whose final episodes all have the same return and cost."""
    played = {"returns": [mean] * 4, "costs": [cost] * 4, "lengths": [1000] * 4}
    made = {"command": "sb3-guard train", "curve": "12", "seconds": 9.0, "n_timesteps": 1_000_000}
    for seed in range(seeds):
        fake_run(folder, algo, "SafetyPointGoal1-v0", seed, config={"cost_limit": 25.0},
                 final={"stochastic": played, "greedy": played},
                 cost_limit=None if algo == "ppo" else 25.0, **made)  # fmt: skip


def test_an_unconstrained_row_is_judged_by_the_limit_of_the_page(scripts, tmp_path):
    board, archives, _ = scripts
    played_by(tmp_path / "logs", "ppo", 10.0, 30.0, 3)
    archives.pack(tmp_path / "logs", "sent_ppo")
    rows, _ = board.read()
    (row,) = rows.query("split == 'stochastic'").to_dict("records")
    assert row["tier"] == "violating" and row["above"] == 1


def test_all_seeds_that_are_planned_are_asked_for(scripts):
    """Those of several grids are seeds of one row."""
    board, *_ = scripts
    plan = board.planned().set_index(["suite", "algo", "budget"])["seeds"]
    assert plan["Goal_Point_8Hazards", "cpo", 1] == [0, 1, 2]
    assert plan["Goal_Hopper_8Hazards", "cpo", 1] == [0]
    assert plan["SafetyPointGoal1-v0", "cpo", 10] == [0]


def test_packed_logs_are_small(scripts, tmp_path):
    _, archives, _ = scripts
    path = fake_run(tmp_path / "logs", returns=1 / 3)
    archives.pack(tmp_path / "logs", "small")
    with archives.unpacked("small") as found:
        (copy,) = found.runs["path"]
        text = Path(copy, "0.monitor.csv").read_text()
        assert max(map(len, text.splitlines())) < 30
        assert Path(copy, "result.json").read_text() == (path / "result.json").read_text()


def sent(folder: Path, algo: str = "cpo", seed: int = 0, **entries: Any) -> Path:
    """A run without a fault, where a million is 600."""
    limit = {"config": {"cost_limit": 2.0}, "cost_limit": 2.0}
    played = {"returns": [1 / 3] * 100, "costs": [1 / 3] * 100, "lengths": [20] * 100}
    final = {"stochastic": played, "greedy": played}
    path = fake_run(folder, algo, seed=seed, returns=1 / 3, **limit | entries, final=final,
                    versions={"sb3_guard": "1"})  # fmt: skip
    run = RunFolder(path)
    made = {"command": run.flags().command(), "curve": run.curve_hash(), "label": label_of(algo)}
    made |= {"seconds": 1.0, "processor": "Pentium"}
    run.write_result(run.checked_result() | made)
    return path


def test_a_run_without_a_limit_can_be_sent_in(scripts, tmp_path, capsys):
    checks = scripts[2]
    for seed in range(3):
        run = sent(tmp_path / "logs", "ppo", seed, config={"cost_limit": None}, cost_limit=None)
        result = json.loads((run / "result.json").read_text()) | {"label": None}  # as SB3's
        (run / "result.json").write_text(json.dumps(result))
    assert checks.check(tmp_path / "logs")
    assert [line.split(": ")[1] for line in capsys.readouterr().out.splitlines()] == ["fine"] * 3


def test_an_algorithm_without_a_limit_may_have_one_in_its_hyperparameters(scripts, tmp_path):
    """A grid gives all its algorithms the same."""
    sent(tmp_path / "logs", "trpo", config={"cost_limit": 2.0}, cost_limit=None)
    assert scripts[2].check(tmp_path / "logs")


def test_the_algorithm_is_told_by_the_folder(scripts, tmp_path, monkeypatch, capsys):
    run = sent(tmp_path / "logs")
    monkeypatch.chdir(run.parent)
    assert scripts[2].check(Path(".")), capsys.readouterr().out
    run.parent.rename(tmp_path / "logs" / "pcpo")
    assert not scripts[2].check(tmp_path / "logs")
    assert "cpo in result.json, pcpo by the folder's name" in capsys.readouterr().out


def test_too_few_seeds_are_no_fault_but_told(scripts, tmp_path, capsys):
    checks = scripts[2]
    for seed in (0, 1, 1):
        sent(tmp_path / "logs", seed=seed)
    assert checks.check(tmp_path / "logs")
    assert "cpo on Goal_Point_8Hazards: 2 of the 3 seeds that" in capsys.readouterr().out


def test_hashes_can_be_checked_after_packing(scripts, tmp_path, capsys):
    _, archives, checks = scripts
    sent(tmp_path / "logs")
    archives.pack(tmp_path / "logs", "sent_mine")
    with archives.unpacked("sent_mine") as found:
        (path,) = found.runs["path"]
        assert checks.check(Path(path)), capsys.readouterr().out


def test_hyperparameters_of_a_file_elsewhere_are_refused(scripts, tmp_path, capsys):
    checks = scripts[2]
    sent(tmp_path / "logs", args={"conf_file": "paper"})
    assert checks.check(tmp_path / "logs")
    sent(tmp_path / "logs", args={"conf_file": "mine.yml"})
    assert not checks.check(tmp_path / "logs")
    assert "args.yml has conf_file: mine.yml" in capsys.readouterr().out


@pytest.mark.parametrize("made", [True, False])
def test_a_folder_without_runs(scripts, tmp_path, capsys, made):
    checks = scripts[2]
    folder = tmp_path / "logs"
    if made:
        folder.mkdir()
    assert not checks.check(folder)
    assert capsys.readouterr().out == f"no finished run in {folder}\n"


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--pack", "mine"], "required: folder"),
        (["{run}", "--pack", "mine"], "a folder per algorithm"),
        (["{logs}/..", "--pack", "mine"], "a folder per algorithm"),
        (["{logs}", "--pack", "there"], "docs/data has sent_there.tar.xz"),
        (["{logs}", "--pack", "a/b"], "letters, digits and _"),
        (["{logs}", "--pack", ""], "letters, digits and _"),
    ],
)
def test_bad_flags(scripts, tmp_path, monkeypatch, capsys, flags, message):
    checks = scripts[2]
    run = sent(tmp_path / "logs")
    (checks.DATA / "sent_there.tar.xz").touch()
    flags = [flag.format(run=run, logs=tmp_path / "logs") for flag in flags]
    monkeypatch.setattr(sys, "argv", ["check_runs.py", *flags])
    with pytest.raises(SystemExit):
        checks.main()
    assert message in capsys.readouterr().err


def played(value: Any) -> dict[str, Any]:
    """Final episodes whose numbers are all the same."""
    split = {key: [value] * 100 for key in ("returns", "costs", "lengths")}
    return {"final": {"stochastic": split, "greedy": split}}


@pytest.mark.parametrize(
    ("file", "changes", "message"),
    [
        ("result.json", played(float("nan")), "no finite numbers"),
        ("result.json", played("1"), "no finite numbers"),
        ("result.json", played(-5.0), "negative costs, or lengths below 1"),
        ("result.json", played(0), "negative costs, or lengths below 1"),
        ("result.json", {"final": {"stochastic": {}}}, "final greedy has 0 episodes"),
        ("result.json", {"label": "Best"}, "label is 'Best', not 'CPO'"),
        ("result.json", {"seconds": None}, "no seconds"),
        ("result.json", {"return": 99.0}, "return is 99, by the episodes 0.333"),
        ("result.json", {"cost": 0.0}, "cost is 0, by the episodes 5"),
        (
            "result.json",
            {"costs": {"cost": {"mean": 5.0, "high": 5.1, "verdict": "kept"}}},
            "costs cost verdict is kept, by the episodes exceeded",
        ),
        ("result.json", {"episodes": 1}, "1 episodes ended in the final epoch by result.json, 10"),
        ("result.json", {"cost_rate": 0.1}, "cost_rate is 0.1, by the episodes about 0.5"),
        ("result.json", {"cost_limit": None}, "cost_limit is None in result.json, not 2"),
        ("result.json", {"n_timesteps": 500}, "500 steps of 600"),
        ("result.json", {"algo": "pcpo"}, "algo is cpo in args.yml, pcpo in result.json"),
        ("result.json", {"n_timesteps": 800}, "800 steps of 600"),
        ("result.json", {"final": None}, "no final"),
        ("result.json", {"limit_on": "max"}, "on an episode's worst step"),
        ("result.json", {"cut": True}, "were cut"),
        ("result.json", {"learned": [300]}, "went on after it had finished"),
        ("result.json", {"commit": "abc-dirty"}, "not committed"),
        ("config.yml", {"cost_limit": 100.0}, "cost_limit is 100.0 in config.yml"),
        ("config.yml", {"cost_limit": "lin_25"}, "cost_limit is lin_25 in config.yml"),
        ("config.yml", {"monitor_kwargs": {"cost_keys": []}}, "config.yml has monitor_kwargs"),
        ("args.yml", {"eval_env_kwargs": {"hazards": {"num": 0}}}, "in another environment"),
        ("args.yml", {"env": "Goal_Ant_8Hazards-v0"}, "env is Goal_Ant_8Hazards-v0 in args.yml"),
    ],
)
def test_a_row_that_is_not_what_it_says(scripts, tmp_path, capsys, file, changes, message):
    checks = scripts[2]
    run = sent(tmp_path / "logs")
    assert checks.check(run)
    (path,) = run.rglob(file)
    content = yaml.safe_load(path.read_text()) | changes  # YAML contains JSON
    path.write_text(json.dumps(content) if path.suffix == ".json" else yaml.safe_dump(content))
    assert not checks.check(run)
    assert message in capsys.readouterr().out


def test_runs_of_the_page_are_not_sent_again(scripts, tmp_path, monkeypatch, capsys):
    run = sent(tmp_path / "logs")
    rows = tmp_path / "rows.csv"
    curve = json.loads((run / "result.json").read_text())["curve"]
    rows.write_text(f"row,curve\ngrand_table/pcpo/A_1,{curve}\n")
    assert scripts[2].check(run)
    monkeypatch.setattr(scripts[2], "ROWS", rows)
    assert scripts[2].check(run)  # two algorithms may do the same where no limit binds
    rows.write_text(f"row,curve\ngrand_table/cpo/A_1,{curve}\n")
    assert not scripts[2].check(run)
    assert "it has the episodes of grand_table/cpo/A_1" in capsys.readouterr().out


def test_no_packed_run_is_lost(scripts, tmp_path):
    archives = scripts[1]
    for seed in range(2):
        run = sent(tmp_path / "logs", seed=seed)
    archives.pack(tmp_path / "logs", "grid")
    archives.pack(tmp_path / "logs", "grid")
    shutil.rmtree(run)
    with pytest.raises(SystemExit, match=f"{tmp_path / 'logs'} lacks: .* grid/cpo/{run.name}"):
        archives.pack(tmp_path / "logs", "grid")


def test_seeds_have_episodes_of_their_own(scripts, tmp_path, capsys):
    checks = scripts[2]
    run = sent(tmp_path / "logs", seed=1)
    copy = sent(tmp_path / "logs", seed=2)
    assert checks.check(tmp_path / "logs")
    shutil.copy(run / "0.monitor.csv", copy)
    made = json.loads((copy / "result.json").read_text())
    curve = json.loads((run / "result.json").read_text())["curve"]
    (copy / "result.json").write_text(json.dumps(made | {"curve": curve}))
    assert not checks.check(tmp_path / "logs")
    assert "the same episodes under several seeds" in capsys.readouterr().out


def test_seeds_of_a_row_have_the_same_hyperparameters(scripts, tmp_path, capsys):
    checks = scripts[2]
    for seed in (1, 2):
        sent(tmp_path / "logs", seed=seed, config={"cost_limit": 2.0, "gamma": 0.9 + seed / 100})
    assert not checks.check(tmp_path / "logs")
    assert "cpo on Goal_Point_8Hazards: the seeds differ in length or" in capsys.readouterr().out


def test_an_empty_curve_is_a_fault(scripts, tmp_path, capsys):
    checks = scripts[2]
    (sent(tmp_path / "logs") / "0.monitor.csv").write_text("")
    assert not checks.check(tmp_path / "logs")
    assert "0.monitor.csv" in capsys.readouterr().out


def test_a_folder_that_is_sent_in_is_checked(scripts, tmp_path, capsys):
    checks = scripts[2]
    toy = (
        "--env Goal_Point_1Hazards --seed 0 --eval-freq -1 --verbose 0 --num-threads 1 -n 8000 "
        "-params n_envs:2 n_steps:2000 n_critic_updates:1 cost_limit:2"
    ).split()
    assert train.main([*toy, "-f", str(tmp_path / "logs")]) == 0
    (run,) = (tmp_path / "logs" / "cpo").iterdir()
    assert not checks.check(tmp_path / "logs")
    said = capsys.readouterr().out
    assert "final greedy has 1 episodes, not 100" in said
    assert "n_timesteps is 8,000; allowed" in said
    assert said.count(";") == 4 + said.count("not committed; ")
    result = json.loads((run / "result.json").read_text())
    (run / "result.json").write_text(
        json.dumps(result | {"curve": "0", "command": "x", "final": None})
    )
    (run / "0.monitor.csv").write_text(
        "\n".join((run / "0.monitor.csv").read_text().splitlines()[:-3]) + "\n"
    )
    assert not checks.check(tmp_path / "logs")
    said = capsys.readouterr().out
    for text in ("no final", "not the hash", "not that of args.yml", "5,000 steps of 8,000"):
        assert text in said
    for name, changes in (
        ("args.yml", {"trained_agent": "ppo.zip", "gym_packages": ["mine"]}),
        ("config.yml", {"cost_keys": ["cheap"], "env_kwargs": {"hazards": {"num": 1}}}),
    ):
        (file,) = run.glob(f"*/{name}")
        file.write_text(yaml.safe_dump(yaml.safe_load(file.read_text()) | changes))
    (run / "result.json").write_text(json.dumps(result | {"cost_limit": 100.0}))
    assert not checks.check(tmp_path / "logs")
    said = capsys.readouterr().out
    for text in (
        "trained_agent: ppo.zip",
        "gym_packages",
        "cost_keys",
        "env_kwargs",
        "100.0 in result",
    ):
        assert text in said


def test_the_page_is_made_of_its_logs(scripts, monkeypatch):
    board, *_ = scripts
    for module in scripts:
        monkeypatch.setattr(module, "DATA", ROOT / "docs" / "data")
    rows, runs = board.read()
    assert board.page(rows) == board.PAGE.read_text(), "run `python scripts/leaderboard.py`"
    assert runs.to_csv(index=False) == board.ROWS.read_text(), "its rows are of other logs"

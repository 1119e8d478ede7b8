"""The leaderboard is made of packed logs."""

import shlex
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest
from fake_runs import fake_run

from sb3_guard.benchmark import Flags, with_file
from sb3_guard.zoo.grids.grid import expand
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.run import Run

ROOT = Path(__file__).parents[2]


@pytest.fixture
def scripts(monkeypatch, tmp_path):
    """The scripts, with a folder of data of their own."""
    monkeypatch.syspath_prepend(ROOT / "scripts")
    import archives
    import leaderboard
    import results

    data = tmp_path / "data"
    data.mkdir()
    for module in (archives, results, leaderboard):
        monkeypatch.setattr(module, "DATA", data)
    yield leaderboard, archives
    for name in ("archives", "leaderboard", "results"):
        sys.modules.pop(name)


def test_rows_that_keep_the_limit_come_first_by_return(scripts, tmp_path, monkeypatch):
    board, archives = scripts
    one = {"suite": "SafetyPointGoal1-v0", "algo": "cup", "delivered": "1 of 3"}
    monkeypatch.setattr(board, "certified", lambda name: pd.DataFrame([one]))
    for algo, mean, cost, seeds in (
        ("cup", 10.0, 20.0, 3), ("focops", 12.0, 24.0, 3), ("p3o", 15.0, 24.0, 2),
        ("cppo_pid", 20.0, 30.0, 3), ("sac_lag", 5.0, 30.0, 2),
    ):  # fmt: skip
        played_by(tmp_path / "logs", algo, mean, cost, seeds)
    archives.pack(tmp_path / "logs", "grand_table", by_environment=True)
    rows, runs = board.read()
    assert len(runs) == 13 and "grand_table/cup/SafetyPointGoal1-v0_1" in {*runs["row"]}
    glance = [" ".join(line.split()) for line in board.glance(rows).splitlines()]
    assert glance[0] == "| 1e6 steps | PointGoal1 |"
    assert {"| FOCOPS | 12.0 / 24.0 ✓ (3) |", "| CPPO-PID | 20.0 / 30.0 ✗ (3) |"} < {*glance}
    # Two seeds are too few for a mark and a place.
    assert {"| P3O | 15.0 / 24.0 (2) |", "| SAC-Lagrangian | 5.0 / 30.0 (2) |"} < {*glance}
    table = board.leaderboard(rows)
    assert table[["algo", "seeds", "verdict"]].values.tolist() == [
        ["focops", 3, "kept"], ["cup", 3, "kept"], ["p3o", 2, "kept"],
        ["cppo_pid", 3, "exceeded"], ["sac_lag", 2, "exceeded"],
    ]  # fmt: skip
    assert table["place"].dropna().tolist() == [1, 2]
    assert table["delivered"].dropna().to_dict() == {1: "1 of 3"}
    first, last = table.iloc[0], table.iloc[3]
    assert first["row"] == "grand_table/focops/SafetyPointGoal1-v0_1"
    assert (first["cost"], first["low"], first["high"]) == (24.0, 24.0, 24.0)
    assert (last["above"], last["excess"]) == (1.0, 0.2)
    assert board.glance(rows.iloc[:0]) == ""


def test_rows_of_former_defaults_stand_apart_and_give_way_to_those_of_today(scripts, tmp_path):
    board, archives = scripts
    for algo in ("pcpo", "cpo", "sac_lag"):
        played_by(tmp_path / "then", algo, 10.0, 20.0, 1)
    for algo in ("cpo", "sac_lag"):
        played_by(tmp_path / "now", algo, 9.0, 19.0, 3, delivered=None)
    archives.pack(tmp_path / "then", "grand_table")
    archives.pack(tmp_path / "now", "delivery")
    rows, runs = board.read()
    table = board.leaderboard(rows).set_index("algo")
    assert table["return"].to_dict() == {"cpo": 9.0, "sac_lag": 9.0, "pcpo": 10.0}
    assert table["settings"].to_dict() == {
        "cpo": "", "sac_lag": "", "pcpo": "batch_size:None n_critic_updates:80",
    }  # fmt: skip
    now, then = board.glance(rows).split("\n\n")
    assert "PCPO" not in now and then.startswith("| 1e6 steps, former settings | PointGoal1 ")
    assert "| PCPO " in then and "SAC" not in then
    assert len(runs) == 9  # can all be trained again
    with sys.modules["results"].logs("grand_table") as kept:
        assert kept["algo"].value_counts().to_dict() == {"cpo": 3, "sac_lag": 3}


@pytest.mark.usefixtures("scripts")
def test_the_best_agent_of_each_environment_stands_first(tmp_path, monkeypatch):
    results = sys.modules["results"]
    header = "environment,million_steps,algo,settings,seeds,return,cost,verdict,row"
    lines = [
        "SafetyA-v0,1,cpo,,3,9.0,20.0,kept,g/cpo/SafetyA-v0_1",
        "SafetyA-v0,1,trpo,,3,20.0,60.0,exceeded,g/trpo/SafetyA-v0_1",
        "SafetyB-v0,1,cpo,,1,5.0,24.0,kept,g/cpo/SafetyB-v0_1",  # of one seed: undecided
        "SafetyB-v0,1,pcpo,,1,4.0,20.0,undecided,g/pcpo/SafetyB-v0_1",
        "Goal_C,2,cpo,,1,5.0,9.0,exceeded,g/cpo/Goal_C_1",
        "Goal_C,1,trpo,,1,9.0,10.0,exceeded,g/trpo/Goal_C_1",
        "Goal_C,1,pcpo,aim:mean,3,20.0,1.0,kept,g/pcpo/Goal_C_1",  # of former defaults
    ]
    (tmp_path / "data" / "leaderboard.csv").write_text("\n".join([header, *lines]))
    runs = tmp_path / "rows.csv"
    times = [f"{line.rpartition(',')[2]},{60 * n}" for n, line in enumerate(lines, 1)]
    runs.write_text("\n".join(["row,seconds", *times]))
    monkeypatch.setattr(results, "ROWS", runs)
    columns = ["suite", "algo", "delivered", "return", "mean"]
    given = [
        ["SafetyA-v0", "trpo", "2 of 3", 12.0, 19.5],
        ["SafetyB-v0", "cpo", "1 of 3", 1.0, 2.0],  # less than half
        ["SafetyB-v0", "p3o", "2 of 2", 9.0, 2.0],  # too few
    ]
    monkeypatch.setattr(results, "certified", lambda name: pd.DataFrame(given, columns=columns))
    _, _, *rows = results.best("x").splitlines()
    assert [[*map(str.strip, row.split("|"))][1:-1] for row in rows] == [
        ["SafetyA-v0", "25", "`trpo`", "12.0", "19.5", "certified", "2 of 3", "1e6", "2"],
        ["SafetyB-v0", "25", "`cpo`", "5.0", "24.0", "undecided", "1", "1e6", "3"],
        ["Goal_C", "2", "`cpo`", "5.0", "9.0", "exceeded", "1", "2e6", "5"],
    ]


def played_by(
    folder: Path, algo: str, mean: float, cost: float, seeds: int, **result: object
) -> None:
    """Runs on SafetyPointGoal1 whose final episodes all have the same return and cost."""
    played = {"returns": [mean] * 4, "costs": [cost] * 4, "lengths": [1000] * 4}
    made = {"command": "sb3-guard train", "curve": "12", "seconds": 9.0, "n_timesteps": 1_000_000}
    made |= result
    for seed in range(seeds):
        fake_run(folder, algo, "SafetyPointGoal1-v0", seed, config={"cost_limit": 25.0},
                 final={"stochastic": played, "greedy": played},
                 cost_limit=None if algo == "ppo" else 25.0, **made)  # fmt: skip


def test_an_unconstrained_row_is_judged_by_the_limit_of_the_page(scripts, tmp_path):
    board, archives = scripts
    played_by(tmp_path / "logs", "ppo", 10.0, 30.0, 3)
    archives.pack(tmp_path / "logs", "grand_table")
    rows, _ = board.read()
    (row,) = rows.query("split == 'stochastic'").to_dict("records")
    assert row["verdict"] == "exceeded" and row["above"] == 1


def test_packed_logs_are_small(scripts, tmp_path):
    _, archives = scripts
    path = fake_run(tmp_path / "logs", returns=1 / 3)
    archives.pack(tmp_path / "logs", "small")
    with archives.unpacked("small") as found:
        (copy,) = found.runs["path"]
        text = Path(copy, "0.monitor.csv").read_text()
        assert max(map(len, text.splitlines())) < 30
        assert Path(copy, "result.json").read_text() == (path / "result.json").read_text()


def test_no_packed_run_is_lost(scripts, tmp_path):
    _, archives = scripts
    for seed in range(2):
        run = fake_run(tmp_path / "logs", seed=seed)
    archives.pack(tmp_path / "logs", "grid")
    archives.pack(tmp_path / "logs", "grid")
    shutil.rmtree(run)
    with pytest.raises(SystemExit, match=f"{tmp_path / 'logs'} lacks: .* grid/cpo/{run.name}"):
        archives.pack(tmp_path / "logs", "grid")


@pytest.mark.parametrize(
    "folders", [("grand_table_10m",), pytest.param(None, marks=pytest.mark.slow)]
)
def test_the_page_is_made_of_its_logs(scripts, monkeypatch, folders):
    """Of those of one grid, its rows; of all, the whole page, which takes a minute."""
    board, _ = scripts
    for module in scripts:
        monkeypatch.setattr(module, "DATA", ROOT / "docs" / "data")
    if folders:
        monkeypatch.setattr(board, "FOLDERS", folders)
    rows, runs = board.read()
    written, table = board.ROWS.read_text(), (ROOT / "docs/data/leaderboard.csv").read_text()
    lines = board.leaderboard(rows).to_csv(index=False).splitlines()
    if folders is None:
        assert board.page(rows) == board.PAGE.read_text(), "run `python scripts/leaderboard.py`"
        assert lines == table.splitlines() and runs.to_csv(index=False) == written
    else:
        assert len(lines) > 3 and {*lines} <= {*table.splitlines()}
        assert {*runs.to_csv(index=False).splitlines()} <= {*written.splitlines()}


@pytest.mark.filterwarnings("ignore:.* left out there")
def test_grids_train_the_rows_as_they_were_trained(scripts, tmp_path):
    """Of each environment and algorithm the first seed, with the settings of its command."""
    board, _ = scripts
    rows = pd.read_csv(board.ROWS).set_index("row")["command"]
    trained = set()
    for grid, folder in board.GRIDS:
        flags = with_file(Flags(grid=str(ROOT / f"docs/data/{grid}.yml")))
        shared = RunFlags.shared(flags, log_folder=str(tmp_path / folder))
        for run in expand(flags.pairs(), flags.seeds[:1], shared):
            row = run.path.relative_to(tmp_path).as_posix()
            if row not in rows:  # not trained yet
                continue
            then = Run.check(RunFlags.parse(shlex.split(rows[row])[2:]))
            settings, those = ({"aim": "mean", **one.hyperparams} for one in (run, then))
            assert settings == those, row
            assert (run.flags.certify, run.flags.seed) == (then.flags.certify, then.flags.seed), row
            trained.add(row)
    assert len(trained) > 150

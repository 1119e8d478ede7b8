"""The leaderboard is made of packed logs."""

import shutil
import sys
from pathlib import Path

import pytest
from fake_runs import fake_run

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
    for path in (ROOT / "docs" / "data").glob("*table*.yml"):
        shutil.copy(path, data)
    shutil.copy(ROOT / "docs" / "data" / "untrained.csv", data)
    for module in (archives, results, leaderboard):
        monkeypatch.setattr(module, "DATA", data)
    yield leaderboard, archives
    for name in ("archives", "leaderboard", "results"):
        sys.modules.pop(name)


def rows_of(text: str, heading: str) -> list[list[str]]:
    table = text.partition(f"### {heading}\n")[2].partition("###")[0]
    lines = [line for line in table.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def test_certified_rows_come_first_by_return(scripts, tmp_path):
    board, archives = scripts
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
    assert board.glance(rows.iloc[:0]) == ""


def played_by(folder: Path, algo: str, mean: float, cost: float, seeds: int) -> None:
    """Runs on SafetyPointGoal1 whose final episodes all have the same return and cost."""
    played = {"returns": [mean] * 4, "costs": [cost] * 4, "lengths": [1000] * 4}
    made = {"command": "sb3-guard train", "curve": "12", "seconds": 9.0, "n_timesteps": 1_000_000}
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
    assert row["tier"] == "violating" and row["above"] == 1


def test_all_seeds_that_are_planned_are_asked_for(scripts):
    """Those of several grids are seeds of one row."""
    board, *_ = scripts
    plan = board.planned().set_index(["suite", "algo", "budget"])["seeds"]
    assert plan["Goal_Point_8Hazards", "cpo", 1] == [0, 1, 2]
    assert plan["Goal_Hopper_8Hazards", "cpo", 1] == [0]
    assert plan["SafetyPointGoal1-v0", "cpo", 10] == [0]


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
    """Of those of one grid, its table; of all, the whole page, which takes a minute."""
    board, _ = scripts
    for module in scripts:
        monkeypatch.setattr(module, "DATA", ROOT / "docs" / "data")
    if folders:
        monkeypatch.setattr(board, "FOLDERS", folders)
    rows, runs = board.read()
    page, written = board.PAGE.read_text(), board.ROWS.read_text()
    if folders is None:
        assert board.page(rows) == page, "run `python scripts/leaderboard.py`"
        assert runs.to_csv(index=False) == written, "its rows are of other logs"
    else:
        table, heading = board.leaderboard(rows), "SafetyPointGoal1-v0, 10e6 steps"
        assert len(rows_of(table, heading)) > 3 and rows_of(table, heading) == rows_of(
            page, heading
        )
        lines = [line for line in written.splitlines() if line.startswith("grand_table_10m/")]
        assert runs.to_csv(index=False).splitlines()[1:] == lines

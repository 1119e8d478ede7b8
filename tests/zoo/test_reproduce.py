"""A row of the leaderboard is trained again from its command, and compared episode by episode."""

import csv
import json

import pytest

from sb3_guard import reproduce, train

ROW = "table/cpo/CostPoint-v0_4"
TOY = (
    "--gym-packages registered_envs --env CostPoint-v0 --env-kwargs episode_length:20 --seed 3 "
    "--eval-freq -1 --verbose 0 --device cpu -n 400 --num-threads 1 -params n_envs:2 n_steps:100 "
    "n_critic_updates:3 cost_limit:2"
).split()


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    assert train.main([*TOY, "-f", str(folder)]) == 0
    return json.loads((folder / "cpo" / "CostPoint-v0_1" / "result.json").read_text())


@pytest.fixture
def again(result, tmp_path, monkeypatch, capsys):
    """Reproduce the row of a table of such rows: the status and what is said."""

    def run(*changes: dict, row: str = ROW) -> tuple[int, str]:
        names = ("command", "curve", "commit", "processor")
        own = {name: result[name] for name in names} | reproduce.measures(result)
        own |= {"row": ROW, "final": reproduce.final_hash(result), "seconds": 9}
        with (tmp_path / "rows.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, own)
            writer.writeheader()
            writer.writerows([own | change for change in changes or [{}]])
        monkeypatch.setattr(reproduce, "ROWS", tmp_path / "rows.csv")
        status = reproduce.main([row, "-f", str(tmp_path / "again")])
        out, err = capsys.readouterr()
        return status, out + err

    return run


def test_a_run_goes_the_same_way(again, result, tmp_path):
    status, out = again()
    assert status == 0 and "trained already" not in out
    assert result["command"] in out and "The same: all training and final episodes agree" in out
    new = json.loads((tmp_path / "again" / "cpo" / "CostPoint-v0_4" / "result.json").read_text())
    assert new["final"] == result["final"]
    status, out = again()  # trains nothing, and says so
    assert status == 0 and 0 < out.index("This run was trained already") < out.index("The same")


def test_a_row_that_went_another_way(again):
    status, out = again({"curve": "0123", "cost": 99.0, "commit": "abc"})
    assert status == 1 and "Not the same: the training episodes differ" in out
    assert "  cost of the final epoch: before 99, now" in out
    assert "The run before is of commit abc" in out
    # Every verdict is made of the final episodes.
    status, out = again({"final": "0123"})
    assert status == 1 and "the final episodes differ" in out and "training episodes" not in out
    for name in reproduce.MEASURES:  # which the episodes do not make
        status, out = again({name: 99.0})
        assert status == 1 and f"{reproduce.MEASURES[name]}: before 99" in out


def test_another_processor_is_judged_by_the_spread_over_seeds(again, result):
    for spread, status, said in ((5.0, 0, "Alike"), (0.01, 1, "Not alike"), (None, 1, "one seed")):
        rows = []
        for seed, sign in ((3, 1), (4, -1))[: 2 if spread else 1]:
            moved = {
                name: value + 1 + sign * (spread or 1.0)
                for name, value in reproduce.measures(result).items()
            }
            words = result["command"].replace("--seed 3", f"--seed {seed}")
            rows.append({"row": f"table/cpo/CostPoint-v0_{seed + 1}", "command": words, **moved})
        rows = [row | {"curve": "0123", "processor": "Pentium"} for row in rows]
        got, out = again(*rows)
        before, _, after = out.partition("Not the same: the training episodes")
        assert got == status
        assert f"of Pentium, this is {result['processor']}" in before and said in after


def test_a_row_that_the_package_does_not_have(again, capsys):
    status, out = again(row=ROW.replace("_4", "_5"))
    assert status == 2 and f"did you mean {ROW!r}?" in out


def test_the_packages_own_table_can_be_read(tmp_path, capsys):
    assert reproduce.main(["nothing/of/that_1", "-f", str(tmp_path)]) == 2
    assert "has no row 'nothing/of/that_1'" in capsys.readouterr().err

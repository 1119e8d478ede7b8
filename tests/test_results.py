"""Tables of runs: read whole, averaged, and scored as the paper does."""

import json
import math
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from fake_runs import fake_run

from sb3_guard.zoo.results import (
    COLUMNS,
    aggregate,
    by_category,
    interval,
    iqm,
    latex,
    learning,
    markdown,
    mean_curve,
    normalize,
    notices,
    overall,
    read_curve,
    read_results,
    select,
    tables,
    write_table,
)
from sb3_guard.zoo.usage import UsageError

HAZARDS, GHOSTS = "Goal_Point_8Hazards", "Goal_Point_8Ghosts"


def means(**metrics) -> pd.DataFrame:
    """A table of means of one suite: algorithm to (J_r, M_c, ρ_c)."""
    rows = [
        {"suite": HAZARDS, "algo": algo, "J_r": j, "M_c": m, "rho_c": r}
        for algo, (j, m, r) in metrics.items()
    ]
    return pd.DataFrame(rows)


# Reading


def test_a_row_says_all_about_a_run(tmp_path):
    versions = {"mujoco": "4.0.0", "python": "3.11.4"}
    path = fake_run(
        tmp_path, seed=3, cost_limit=25, seconds=12.5, versions=versions, commit="abc",
        platform="Linux",
    )  # fmt: skip
    table = read_results([tmp_path]).runs
    assert list(table.columns) == list(COLUMNS)
    (row,) = table.to_dict("records")
    expected = {
        "suite": HAZARDS, "task": "Goal", "robot": "Point", "constraint": "8Hazards",
        "algo": "cpo", "seed": 3, "steps": 600, "J_r": 20.0, "M_c": 5.0, "rho_c": 0.5,
        "cost_limit": 25.0, "seconds": 12.5, "epoch": 100, "mujoco": "4.0.0", "python": "3.11.4",
        "commit": "abc", "platform": "Linux", "path": str(path), "episodes": 10,
    }  # fmt: skip
    assert {key: row[key] for key in expected} == expected
    assert pd.isna(row["torch"])


def test_runs_of_older_versions_are_read(tmp_path):
    fake_run(tmp_path, "trpo", returns=1.0)
    fake_run(tmp_path, "cpo", config={"cost_limit": 5.0})
    table = read_results([tmp_path]).runs
    assert table["algo"].tolist() == ["trpo", "cpo"]
    assert math.isnan(table["cost_limit"][0]) and table["cost_limit"][1] == 5
    assert table["seconds"].isna().all() and table["commit"].isna().all()


def test_other_environments_keep_their_ids(tmp_path):
    fake_run(tmp_path, env="CartPole-v1")
    row = read_results([tmp_path]).runs.iloc[0]
    assert row["suite"] == "CartPole-v1" and pd.isna(row["robot"])


def test_several_limits_on_several_costs_are_no_number(tmp_path):
    fake_run(tmp_path, cost_limit=[1.0, 2.0])
    fake_run(tmp_path, cost_limit=[3.0], seed=1)
    fake_run(tmp_path, cost_limit=[50.0, 50.0])
    found = read_results([tmp_path]).runs
    assert found["cost_limit"][0] == 3.0 and found["cost_limit"][1:].isna().all()
    assert found["limits"].tolist() == ["3", "1 2", "50 50"]
    with pytest.raises(UsageError, match=r"several cost limits, 1 2, 3, 50 50, .*--cost-limit 1 2"):
        select(found)
    assert select(found, cost_limit=[50, 50])["limits"].tolist() == ["50 50"]
    with pytest.raises(UsageError, match="no run at cost limit 1; there are runs at 1 2, 3, 50 50"):
        select(found, cost_limit=1)
    assert tables(select(found, cost_limit=[1, 2]))["Results"]["limit"].tolist() == ["1 2"]


def test_folders_that_overlap_are_read_once(tmp_path):
    fake_run(tmp_path)
    assert len(read_results([tmp_path, tmp_path / "cpo", tmp_path / "cpo" / ".."]).runs) == 1


@pytest.mark.parametrize("where", ["", "cpo", f"cpo/{HAZARDS}-v0_1"])
def test_any_folder_above_a_run_will_do(tmp_path, where):
    fake_run(tmp_path)
    assert len(read_results([tmp_path / where]).runs) == 1


def test_numbers_sort_as_numbers(tmp_path):
    for number in (10, 9, 2):
        fake_run(tmp_path, number=number, seed=0)
    # The same run thrice: the one with the greatest number stands.
    found = read_results([tmp_path]).runs
    assert [path[-2:] for path in found["path"]] == ["_2", "_9", "10"]
    (path,) = select(found)["path"]
    assert path.endswith("_10")
    lines = notices(found, select(found))
    assert [line.split(" was repeated")[0][-2:] for line in lines] == ["_2", "_9"]


DAMAGE = {
    "unfinished": lambda run: (run / "result.json").unlink(),
    "can't be read": lambda run: (run / "result.json").write_text('{"return": 1'),
    "Expecting value": lambda run: (run / "result.json").write_text(""),
    "can't decode": lambda run: (run / "result.json").write_bytes(b"\xff\xfe\x00"),
    "should be a mapping": lambda run: (run / "result.json").write_text("[1]"),
    "it has no n_timesteps": lambda run: (run / "result.json").write_text("{}"),
    "cost = 'x' should be a number": lambda run: edit(run, cost="x"),
    "n_timesteps = None should be": lambda run: edit(run, n_timesteps=None),
    "n_timesteps = 1.5": lambda run: edit(run, n_timesteps=1.5),
    "no env, algo or seed": lambda run: params(run, "args.yml").write_text("env: 3"),
    "args.yml is damaged": lambda run: params(run, "args.yml").write_text(""),
    "one <env>/args.yml": lambda run: params(run, "args.yml").unlink(),
    "error.txt ends in 'disk on fire'": lambda run: fail(run),
    "config.yml": lambda run: params(run, "config.yml").write_text("a: ["),
}


def edit(run, **changes):
    file = run / "result.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def fail(run):
    (run / "result.json").unlink()
    (run / "error.txt").write_text("Traceback\n  …\ndisk on fire\n")


def params(run, name):
    return run / f"{HAZARDS}-v0" / name


@pytest.mark.parametrize("why", DAMAGE)
def test_a_damaged_run_is_named_and_left_out(tmp_path, why):
    whole, broken = fake_run(tmp_path), fake_run(tmp_path, seed=1)
    DAMAGE[why](broken)
    found = read_results([tmp_path])
    assert found.runs["path"].tolist() == [str(whole)]
    assert list(found.left_out) == [str(broken)] and why in found.left_out[str(broken)]


def test_a_run_that_died_at_once_is_named(tmp_path):
    begun = tmp_path / "cpo" / f"{HAZARDS}-v0_1" / f"{HAZARDS}-v0"
    begun.mkdir(parents=True)
    (begun / "command.txt").touch()
    assert list(read_results([tmp_path]).left_out) == [str(begun.parent)]


def test_folders_without_runs(tmp_path):
    with pytest.raises(UsageError, match=r"there is no folder '.*absent'"):
        read_results([tmp_path / "absent"])
    with pytest.raises(UsageError, match="there is no run below"):
        read_results([tmp_path])


def test_no_episode_ended(tmp_path):
    edit(fake_run(tmp_path), **{"return": None, "cost": None})
    found = read_results([tmp_path]).runs
    assert math.isnan(found["J_r"][0])
    assert "no episode ended in" in notices(found, select(found))[0]
    assert "–" in tables(select(found))["Results"].iloc[0]["return J_r"]


# Choosing


def test_runs_at_several_limits_are_not_averaged(tmp_path):
    fake_run(tmp_path, "trpo")
    for limit in (0.0, 5.0):
        fake_run(tmp_path, config={"cost_limit": limit})
    found = read_results([tmp_path]).runs
    with pytest.raises(UsageError, match=r"several cost limits, 0, 5, .* --cost-limit 0"):
        select(found)
    assert select(found, cost_limit=5)["algo"].tolist() == ["trpo", "cpo"]
    with pytest.raises(UsageError, match="no run at cost limit 7; there are runs at 0, 5"):
        select(found, cost_limit=7)


@pytest.mark.parametrize("name", [GHOSTS, GHOSTS + "-v0"])
def test_suites_are_chosen_by_id(tmp_path, name):
    fake_run(tmp_path)
    fake_run(tmp_path, env=GHOSTS + "-v0")
    found = read_results([tmp_path]).runs
    assert select(found, [name])["suite"].tolist() == [GHOSTS]
    with pytest.raises(UsageError, match="no run of 'Goal_Pint_8Ghosts'; did you mean"):
        select(found, ["Goal_Pint_8Ghosts"])


def test_runs_of_several_lengths_are_not_averaged(tmp_path):
    fake_run(tmp_path, "trpo", epochs=4)
    for epochs in (3, 6):
        fake_run(tmp_path, epochs=epochs)
    found = read_results([tmp_path]).runs
    with pytest.raises(UsageError, match=r"cpo on .* in length, 300, 600 steps.* --steps 600"):
        select(found)
    with pytest.raises(UsageError, match="no run of 7 steps; there are runs of 300, 400, 600"):
        select(found, steps=7)
    chosen = select(found, steps=300)
    assert chosen["steps"].tolist() == [400, 300]  # where there is no choice, all stay
    (line,) = notices(found, chosen)
    assert line == f"{HAZARDS}: runs differ in length: 300, 400 steps"


def test_environments_of_other_settings_are_not_compared(tmp_path):
    fake_run(tmp_path, "trpo", config={"env_kwargs": {"num": 2}})
    fake_run(tmp_path, config={"env_kwargs": None})
    with pytest.raises(UsageError, match=r'differ in env_kwargs .*\{"num": 2\} in .*; none in '):
        select(read_results([tmp_path]).runs)


WARM = dict(trained_agent="old.zip")


@pytest.mark.parametrize(
    ("one", "other", "line"),
    [
        ({}, {"seed": 1, "config": {"a": 0}}, "runs of cpo differ in hyper-parameters"),
        ({}, {"config": {"a": 0}}, "runs of cpo count twice or more for one seed: 0"),
        ({}, {"args": WARM}, "some runs went on from a model, others from none"),
        ({"commit": "a"}, {"seed": 1, "commit": "b"}, "runs differ in commit: a, b"),
        ({"commit": "a"}, {"seed": 1}, "runs differ in commit: a, unknown"),
        ({"versions": {"mujoco": "3"}}, {"seed": 1, "versions": {"mujoco": "4"}},
         "runs differ in mujoco: 3, 4"),
        ({"versions": {"sb3_guard": "1"}}, {"seed": 1, "versions": {"sb3_guard": "2"}},
         "runs differ in sb3_guard: 1, 2"),
        ({"algo": "trpo"}, {"config": {"n_steps": 5}},
         "algorithms differ in n_steps: 50 (trpo); 5 (cpo)"),
        ({"algo": "trpo", "config": {"gamma": 0.9}}, {},
         "algorithms differ in gamma: 0.9 (trpo); default (cpo)"),
        ({"config": {"warmup": 0.3}}, {"seed": 1, "config": {"warmup": 0.3}, "learned": [300]},
         "how they were extended"),
        ({"config": {"learning_rate": "lin_1"}},
         {"seed": 1, "config": {"learning_rate": "lin_1"}, "learned": [300]},
         "how they were extended"),
    ],
)  # fmt: skip
def test_unequal_runs_are_noticed(tmp_path, one, other, line):
    fake_run(tmp_path, **one)
    fake_run(tmp_path, **other)
    found = read_results([tmp_path]).runs
    lines = notices(found, select(found))
    assert any(line in note and note.startswith(HAZARDS) for note in lines), lines
    write_table(tmp_path / "r.md", select(found), lines)
    write_table(tmp_path / "r.tex", select(found), lines)
    assert f"\n- {lines[0]}\n" in (tmp_path / "r.md").read_text()
    assert f"\n% {lines[0]}\n" in (tmp_path / "r.tex").read_text()


def test_equal_runs_need_no_note(tmp_path):
    fake_run(tmp_path, "trpo")
    fake_run(tmp_path, "ppo", config={"n_steps": 7})  # a baseline's own
    fake_run(tmp_path, learned=[300])
    fake_run(tmp_path, seed=1)
    found = read_results([tmp_path]).runs
    assert notices(found, select(found)) == []


# Statistics


def test_means_and_intervals_over_seeds(tmp_path):
    for seed, value in enumerate((10.0, 20.0, 60.0)):
        fake_run(tmp_path, seed=seed, returns=value)
    (row,) = aggregate(read_results([tmp_path]).runs).to_dict("records")
    assert (row["J_r"], row["seeds"]) == (30.0, 3)
    assert row["J_r_std"] == pytest.approx(math.sqrt(700))  # of the sample
    # 27 resamples of three: the least mean has probability 1/27 > 2.5 %
    assert (row["J_r_low"], row["J_r_high"]) == (10.0, 60.0)
    assert (row["M_c_low"], row["M_c"], row["M_c_high"]) == (5.0, 5.0, 5.0)


def test_one_seed_has_no_interval():
    assert np.isnan(interval([np.array([3.0])])).all()
    assert np.isnan(interval([np.array([3.0, np.nan]), np.array([])])).all()


def test_interval_is_stratified():
    # Resampling across the groups would mix 0 and 100; within them nothing varies.
    assert interval([np.zeros(5), np.full(5, 100.0)]) == (50.0, 50.0)


def test_interval_agrees_with_the_normal_one():
    values = np.random.default_rng(0).normal(3.0, 2.0, size=400)
    low, high = interval([values])
    error = 1.96 * values.std() / 20
    assert (low, high) == pytest.approx((values.mean() - error, values.mean() + error), abs=0.02)
    assert interval([values]) == (low, high)  # reproducible


def test_interquartile_mean():
    assert iqm(np.array([1000.0, 1, 2, 3, 4, 5, 6, -500])) == 3.5
    assert iqm(np.array([[0.0, 1, 2, 9]]), axis=1).tolist() == [1.5]


# Scores


def test_scores_by_hand():
    table = means(trpo=(20.0, 8.0, 0.1), cpo=(15.0, 2.0, 0.05), pcpo=(30.0, 16.0, 0.3))
    scores = normalize(table, table).set_index("algo")
    assert scores.loc["trpo", ["reward", "cost", "cost_rate"]].tolist() == [1, 1, 1]
    assert scores.loc["cpo", ["reward", "cost", "cost_rate"]].tolist() == [0.75, 0.25, 0.5]
    # Reward is capped, costs are not.
    assert scores.loc["pcpo", ["reward", "cost"]].tolist() == [1.0, 2.0]


def test_negative_returns_are_shifted():
    table = means(trpo=(6.0, 1.0, 1.0), cpo=(-4.0, 1.0, 1.0), pcpo=(1.0, 1.0, 1.0))
    scores = normalize(table, table).set_index("algo")["reward"]
    # The range is 10: the least return becomes 0.1, TRPO's 10.1.
    assert scores.tolist() == pytest.approx([1.0, 0.1 / 10.1, 5.1 / 10.1])


def test_trpo_alone_is_scored_1_and_its_runs_around_it():
    table = means(trpo=(-4.0, 1.0, 1.0))
    assert normalize(table, table)["reward"].tolist() == [1.0]
    runs = pd.concat([table.assign(J_r=-5.0), table.assign(J_r=-3.0)])
    assert normalize(runs, table)["reward"].tolist() == [0.75, 1.0]


def test_only_the_papers_algorithms_count_for_the_shift():
    table = means(trpo=(6.0, 1, 1), cpo=(3.0, 1, 1), ppo=(-90.0, 1, 1))
    scores = normalize(table, table).set_index("algo")["reward"]
    assert scores[["trpo", "cpo"]].tolist() == [1.0, 0.5]


def test_runs_are_scored_on_the_scale_of_the_means():
    table = means(trpo=(6.0, 2.0, 1.0), cpo=(-4.0, 1.0, 1.0))
    runs = pd.concat([table.assign(J_r=table["J_r"] + d, M_c=table["M_c"] + d) for d in (-1, 1)])
    scores = normalize(runs, table)
    assert scores["reward"].tolist() == pytest.approx([9.1 / 10.1, -0.9 / 10.1, 1, 1.1 / 10.1])
    assert scores["cost"].tolist() == [0.5, 0.0, 1.5, 1.0]


@pytest.mark.parametrize("table", [means(trpo=(5.0, 0.0, 0.0), cpo=(5.0, 1.0, 1.0)),
                                   means(cpo=(5.0, 1.0, 1.0))])  # fmt: skip
def test_without_a_denominator_there_is_no_score(table):
    assert normalize(table, table)[["cost", "cost_rate"]].isna().all(axis=None)


def test_category_score_is_the_mean_of_its_algorithms():
    table = means(
        trpo=(10.0, 10.0, 1.0), trpo_lag=(6.0, 1.0, 0.1), trpo_fac=(8.0, 2.0, 0.2),
        trpo_ipo=(10.0, 6.0, 0.6), cpo=(5.0, 5.0, 0.5),
    )  # fmt: skip
    scores = by_category(normalize(table, table)).set_index("category")
    assert scores.loc["Lagrangian"].tolist() == pytest.approx([HAZARDS, 3, 0.8, 0.3, 0.3])
    assert scores.loc["CPO-based", "algorithms"] == 1
    assert "hierarchical" not in scores.index


def test_suites_without_a_score_are_left_out_and_counted(tmp_path):
    for env, cost in ((HAZARDS, 4.0), (GHOSTS, 0.0)):
        for seed in (0, 1):
            fake_run(tmp_path, "trpo", f"{env}-v0", seed, cost=cost)
            fake_run(tmp_path, "cpo", f"{env}-v0", seed, cost=1.0, returns=10.0)
    runs = read_results([tmp_path]).runs
    table = overall(runs, aggregate(runs)).set_index("algo")
    assert table.index.tolist() == ["trpo", "cpo"]
    assert table.loc["cpo", ["cost", "cost_n"]].tolist() == [0.25, 1]
    assert table.loc["cpo", ["reward", "reward_n", "reward_iqm"]].tolist() == [0.5, 2, 0.5]
    assert "0.25 (1)" in markdown(tables(runs)["All suites, relative to TRPO"])


# Curves


def test_curve_of_a_run(tmp_path):
    path = fake_run(tmp_path, returns=60.0, cost=2.0)
    curve = read_curve(path, 100)
    assert curve["step"].tolist() == [100, 200, 300, 400, 500, 600]
    assert curve["J_r"].tolist() == pytest.approx([10, 20, 30, 40, 50, 60])
    assert curve["M_c"].tolist() == pytest.approx([2.0] * 6)
    assert curve["rho_c"].iloc[-1] == pytest.approx(0.2)
    assert (curve["episodes"] == 10).all()


def test_short_epochs_are_taken_together(tmp_path):
    path = fake_run(tmp_path, epochs=60)
    assert len(read_curve(path, 10)) == 200
    assert len(read_curve(path)) == 200


def test_mean_of_curves_ends_where_the_shortest_does(tmp_path):
    curves = [read_curve(fake_run(tmp_path, seed=s, epochs=n, returns=10.0 * n), 100)
              for s, n in ((0, 4), (1, 6))]  # fmt: skip
    mean = mean_curve(curves, "J_r")
    assert mean.index.tolist() == [100, 200, 300, 400]
    assert mean["mean"].tolist() == pytest.approx([10, 20, 30, 40])


@pytest.mark.parametrize("content", [None, "", "#{}\n", "#{}\nr,l,t\n1,2,3\n", "#{}\nr,l,t,c\n",
                                     "#{}\nr,l,t,c\n1,10,1,2\n1,1"])  # fmt: skip
def test_damaged_curve(tmp_path, content):
    file = fake_run(tmp_path) / "0.monitor.csv"
    file.unlink() if content is None else file.write_text(content)
    with pytest.raises(UsageError, match=r"0\.monitor\.csv"):
        read_curve(file.parent)


def test_learning_compares_first_with_last(tmp_path):
    fake_run(tmp_path, returns=60.0)
    (row,) = learning(read_results([tmp_path]).runs, epochs=2).to_dict("records")
    assert (row["algorithm"], row["return, first"], row["last"]) == ("CPO", "15.00", "55.00")
    assert float(row["gain, s.e."]) > 50


# Files


@pytest.fixture
def runs(tmp_path):
    for algo, factor in (("trpo", 1.0), ("cpo", 0.5)):
        for seed in (0, 1):
            fake_run(
                tmp_path / "logs", algo, seed=seed, returns=20 * factor + seed, cost=5 * factor
            )
    return read_results([tmp_path / "logs"]).runs


def test_csv_is_the_table(tmp_path, runs):
    write_table(tmp_path / "a" / "runs.csv", runs)
    again = pd.read_csv(tmp_path / "a" / "runs.csv")
    pd.testing.assert_frame_equal(again[["algo", "seed", "J_r"]], runs[["algo", "seed", "J_r"]],
                                  check_dtype=False)  # fmt: skip
    assert list(again.columns) == list(COLUMNS)


def test_parquet_is_the_table(tmp_path, runs):
    pytest.importorskip("pyarrow")
    write_table(tmp_path / "runs.parquet", runs)
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "runs.parquet"), runs,
                                  check_dtype=False)  # fmt: skip


def test_parquet_without_its_library(tmp_path, runs, monkeypatch):
    monkeypatch.setattr("sb3_guard.zoo.results.find_spec", lambda name: None)
    with pytest.raises(
        UsageError, match=r"Parquet needs pyarrow; run pip install .* or write .csv"
    ):
        write_table(tmp_path / "runs.parquet", runs)


def test_markdown_and_latex(tmp_path, runs):
    write_table(tmp_path / "r.md", runs)
    write_table(tmp_path / "r.tex", runs)
    text, tex = ((tmp_path / name).read_text() for name in ("r.md", "r.tex"))
    # TRPO's mean is 20.5, CPO's 10.5
    assert "20.50 ± 0.71 [20.00, 21.00]" in text and "| 0.51 " in text
    assert r"20.50 $\pm$ 0.71 [20.00, 21.00]" in tex and r"Goal\_Point\_8Hazards" in tex
    assert "return $J_r$" in tex and r"cost rate $\rho_c$" in tex
    lines = [line for line in text.splitlines() if line.startswith("|")][:4]
    assert len({len(line) for line in lines}) == 1


@pytest.mark.parametrize("cell", ["_", "%", "&", "#", "\\", "ρ", "−3"])
def test_latex_escapes(cell):
    body = latex(pd.DataFrame({"a": [cell]})).splitlines()[4]
    assert body.removesuffix(r" \\") not in ("_", "%", "&", "#", "\\", "ρ", "−3")


def test_markdown_escapes():
    assert r"a\|b" in markdown(pd.DataFrame({"x": ["a|b"]}))


@pytest.mark.parametrize("name", ["r.xlsx", "r", "r.cvs"])
def test_unknown_format(tmp_path, runs, name):
    with pytest.raises(UsageError, match=r"unknown format .*allowed: .md, .tex, .csv, .parquet"):
        write_table(tmp_path / name, runs)
    assert not (tmp_path / name).exists()


def test_table_where_nothing_can_be_written(tmp_path, runs):
    (tmp_path / "file").touch()
    with pytest.raises(UsageError, match=r"can't write to .* choose another file"):
        write_table(tmp_path / "file" / "r.csv", runs)


def test_reading_results_loads_no_torch():
    code = (
        "import sys, sb3_guard.zoo.results, sb3_guard.zoo.figures, sb3_guard.plot\n"
        "print([m for m in ('torch', 'rl_zoo3') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"

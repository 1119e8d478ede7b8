"""Statistics against cases computed by hand, and the tables that are made of them."""

import math
import shutil
import subprocess

import numpy as np
import pandas as pd
import pytest
from fake_runs import LABELS, fake_run

from sb3_guard.zoo.cli.markdown import escaped
from sb3_guard.zoo.results.figure_data import Data
from sb3_guard.zoo.results.runs import read_curve, read_results
from sb3_guard.zoo.results.statistics import (
    aggregate,
    by_family,
    judging_limits,
    last_epochs,
    mean_curve,
    normalize,
)
from sb3_guard.zoo.results.tables import CAPTIONS, latex, markdown, tables, write_tables

HAZARDS, GHOSTS = "Goal_Point_8Hazards", "Goal_Point_8Ghosts"


def means(**metrics) -> pd.DataFrame:
    """A table of means of one suite: algorithm to (J_r, M_c, ρ_c)."""
    rows = [
        {"suite": HAZARDS, "algo": algo, "label": LABELS[algo][0],
         "family": LABELS[algo][1].replace("unconstrained", ""), "J_r": j, "M_c": m, "rho_c": r}
        for algo, (j, m, r) in metrics.items()
    ]  # fmt: skip
    return pd.DataFrame(rows)


# One run


def test_the_last_ten_epochs():
    # 12 epochs of 10 steps with two episodes each
    episodes = pd.DataFrame({"step": 5 * np.arange(1.0, 25), "J_r": 0.0, "M_c": np.arange(24.0)})
    assert last_epochs(episodes, 10)["M_c"].tolist() == [*range(4, 24)]
    # Rollouts too short to end an episode, as with n_steps off-policy, are no epochs.
    assert last_epochs(episodes, 4).equals(last_epochs(episodes, math.nan))
    assert len(last_epochs(episodes, 4)) != 20


def test_unconstrained_runs_are_judged_by_the_others_limit(tmp_path):
    fake_run(tmp_path, "trpo", cost=5.0)
    fake_run(tmp_path, "cpo", cost=1.0, cost_limit=4.0)
    fake_run(tmp_path, "pcpo", cost=1.0, cost_limit=4.0)
    runs = read_results([tmp_path]).runs
    assert judging_limits(runs).tolist() == [4.0, 4.0, 4.0]
    several = runs.assign(cost_limit=[math.nan, 4.0, 5.0])
    assert math.isnan(judging_limits(several)[0])


# Over seeds


def test_means_and_deviations_over_seeds(tmp_path):
    for seed, value in enumerate((10.0, 20.0, 60.0)):
        fake_run(tmp_path, seed=seed, returns=value, cost=5.0 + seed, cost_limit=0.0)
    (row,) = aggregate(read_results([tmp_path]).runs).to_dict("records")
    assert (row["label"], row["J_r"], row["seeds"], row["limits"]) == ("CPO", 30.0, 3, "0")
    assert row["J_r_std"] == pytest.approx(math.sqrt(700))  # of the sample
    assert row["M_c"] == pytest.approx(6) and row["M_c_std"] == pytest.approx(1)


def test_mean_of_curves_ends_where_the_shortest_does(tmp_path):
    curves = [read_curve(fake_run(tmp_path, seed=s, epochs=n, returns=10.0 * n), 100)
              for s, n in ((0, 4), (1, 6))]  # fmt: skip
    mean = mean_curve(curves, "J_r")
    assert mean.index.tolist() == [100, 200, 300, 400]
    assert mean["mean"].tolist() == pytest.approx([10, 20, 30, 40])


# Scores


def test_scores_by_hand():
    table = means(trpo=(20.0, 8.0, 0.1), cpo=(15.0, 2.0, 0.05), pcpo=(30.0, 16.0, 0.3))
    scores = normalize(table).set_index("algo")
    assert scores.loc["trpo", ["reward", "cost", "cost_rate"]].tolist() == [1, 1, 1]
    assert scores.loc["cpo", ["reward", "cost", "cost_rate"]].tolist() == [0.75, 0.25, 0.5]
    # Reward is capped, costs are not.
    assert scores.loc["pcpo", ["reward", "cost"]].tolist() == [1.0, 2.0]


def test_negative_returns_are_shifted():
    table = means(trpo=(6.0, 2.0, 1.0), cpo=(-4.0, 1.0, 1.0), pcpo=(1.0, 1.0, 1.0))
    # The range is 10: the least return becomes 0.1, TRPO's 10.1.
    rewards = normalize(table)["reward"].tolist()
    assert rewards == pytest.approx([1.0, 0.1 / 10.1, 5.1 / 10.1])
    alone = means(trpo=(-4.0, 1.0, 1.0))
    assert normalize(alone)["reward"].tolist() == [1.0]


def test_baselines_do_not_count_for_the_shift():
    table = means(trpo=(6.0, 1, 1), cpo=(3.0, 1, 1), ppo=(-90.0, 1, 1))
    assert normalize(table)["reward"].tolist()[:2] == [1.0, 0.5]


@pytest.mark.parametrize("table", [means(trpo=(5.0, 0.0, 0.0), cpo=(5.0, 1.0, 1.0)),
                                   means(cpo=(5.0, 1.0, 1.0))])  # fmt: skip
def test_without_a_denominator_there_is_no_score(table):
    assert normalize(table)[["cost", "cost_rate"]].isna().all(axis=None)


def test_score_of_a_family_is_the_mean_of_its_algorithms():
    table = means(
        trpo=(10.0, 10.0, 1.0), trpo_lag=(6.0, 1.0, 0.1), trpo_fac=(8.0, 2.0, 0.2),
        trpo_ipo=(10.0, 6.0, 0.6), cpo=(5.0, 5.0, 0.5),
    )  # fmt: skip
    scores = by_family(normalize(table)).set_index("family")
    assert scores.loc["Lagrangian"].tolist() == pytest.approx([HAZARDS, 3, 0.8, 0.3, 0.3])
    assert scores.loc["CPO-based", "algorithms"] == 1 and len(scores) == 2


def test_suites_without_a_score_are_left_out_and_counted(tmp_path):
    for env, cost in ((HAZARDS, 4.0), (GHOSTS, 0.0)):
        for seed in (0, 1):
            fake_run(tmp_path, "trpo", f"{env}-v0", seed, cost=cost)
            fake_run(tmp_path, "cpo", f"{env}-v0", seed, cost=1.0, returns=10.0)
    table = tables(Data(read_results([tmp_path]).runs))["All environments, relative to TRPO"]
    assert table["algorithm"].tolist() == ["TRPO", "CPO"]
    assert (table["cost / TRPO"][1], table["reward / TRPO"][1]) == ("0.25 (1)", "0.50 (2)")


# Files


@pytest.fixture
def runs(tmp_path):
    for algo, factor in (("trpo", 1.0), ("cpo", 0.5)):
        for seed in (0, 1):
            fake_run(
                tmp_path / "logs", algo, seed=seed, returns=20 * factor + seed, cost=5 * factor
            )
    return read_results([tmp_path / "logs"]).runs


def test_markdown_and_latex(tmp_path, runs):
    for name in ("r.md", "r.tex"):
        write_tables(tmp_path / name, Data(runs))
    text, tex = ((tmp_path / name).read_text() for name in ("r.md", "r.tex"))
    # TRPO's mean is 20.5, CPO's 10.5; no line breaks before or after ±.
    assert "| 20.50\xa0±\xa00.71 " in text and "| 0.51 " in text and "| 100.0 " in text
    assert "20.50\xa0±\xa00.71 " in tex and r"Goal\_Point\_8Hazards" in tex
    assert r"above limit, \%" in tex
    lines = [line for line in text.splitlines() if line.startswith("|")][:4]
    assert len({len(line) for line in lines}) == 1


def test_tables_agree(tmp_path):
    """One meaning of ± and one judgement, whichever table a reader takes."""
    costs = [1.0] * 40 + [9.0] * 40
    final = {
        split: {"returns": costs, "costs": [cost + 0.5 for cost in costs]}
        for split in ("stochastic", "greedy")
    }
    for seed in range(3):
        fake_run(tmp_path, seed=seed, returns=20.0 + 5 * seed, cost=6.0 + seed, final=final,
                 config={"cost_limit": 5.5})  # fmt: skip
    shown = tables(Data(read_results([tmp_path]).runs))
    assert {*shown} == {"Results", "Tiers"}
    tiers = shown["Tiers"].set_index("episodes")["limit"]
    assert tiers["final stochastic"] == shown["Results"]["limit"][0] == "5.5: undecided"
    assert shown["Results"]["episode cost"][0] == "7.00\xa0±\xa01.00"
    assert all("standard deviation" in CAPTIONS[title] for title in shown)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdflatex")
def test_pdflatex_takes_the_tables(tmp_path, runs):
    write_tables(tmp_path / "t.tex", Data(runs.assign(label="CPO & é_%")))
    (tmp_path / "p.tex").write_text(
        "\\documentclass{article}\\IfFileExists{booktabs.sty}{\\usepackage{booktabs}}{\\let"
        "\\toprule\\hline\\let\\midrule\\hline\\let\\bottomrule\\hline}"
        "\\begin{document}\\input{t}\\end{document}"
    )
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "p.tex"]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-1500:]


@pytest.mark.parametrize("cell", ["_", "%", "&", "#", "\\"])
def test_latex_escapes(cell):
    assert (
        cell
        not in latex(pd.DataFrame({"a": [cell]}), "").splitlines()[6].removesuffix(r" \\").split()
    )


@pytest.mark.parametrize(
    ("text", "page"),
    [("a|b", r"a\|b"), ("<img>", r"\<img>"), ("*a*", r"\*a\*"), ("_a_", r"\_a\_"), ("a`b", r"a\`b"),
     ("[a](b)", r"[a]\(b)"), ("Goal_Point", "Goal_Point"), ("5 [4, 6]", "5 [4, 6]")],
)  # fmt: skip
def test_markdown_shows_cells_as_they_are(text, page):
    assert markdown(pd.DataFrame({"x": [text]})).splitlines()[2].strip("| ") == page
    assert "|" in text or escaped(text) == page

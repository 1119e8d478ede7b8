"""Statistics against cases computed by hand, and the tables that are made of them."""

import itertools
import math

import numpy as np
import pandas as pd
import pytest
from fake_runs import LABELS, fake_run

from sb3_guard.judging import kept
from sb3_guard.zoo.cli.markdown import escaped
from sb3_guard.zoo.results import statistics
from sb3_guard.zoo.results.figure_data import Data
from sb3_guard.zoo.results.figures import draw
from sb3_guard.zoo.results.runs import read_curve, read_results
from sb3_guard.zoo.results.statistics import (
    SCORES,
    aggregate,
    by_family,
    judge,
    judging_limits,
    last_epochs,
    mean_curve,
    nested_interval,
    normalize,
    violations,
)
from sb3_guard.zoo.results.tables import CAPTIONS, markdown, tables, write_tables

HAZARDS, GHOSTS = "Goal_Point_8Hazards", "Goal_Point_8Ghosts"
NONE = pytest.approx(math.nan, nan_ok=True)


def means(**metrics) -> pd.DataFrame:
    """A table of means of one suite: algorithm to (J_r, M_c, ρ_c)."""
    rows = [
        {"suite": HAZARDS, "algo": algo, "label": LABELS[algo][0],
         "family": LABELS[algo][1].replace("unconstrained", ""), "J_r": j, "M_c": m, "rho_c": r}
        for algo, (j, m, r) in metrics.items()
    ]  # fmt: skip
    return pd.DataFrame(rows)


# Limits


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


@pytest.mark.parametrize(
    ("costs", "limit", "share", "excess"),
    [
        ([1, 2, 3, 6], 2, 2 / 4, (1 / 2 + 4 / 2) / 2),
        ([0, 0, 1, 3], 0, 2 / 4, (1 + 3) / 2),  # in units of cost
        ([-1, -3], -2, 1 / 2, 1 / 2),  # a limit from below
        ([1, 2], 2, 0, NONE),
    ],
)
def test_violations(costs, limit, share, excess):
    assert violations(np.array(costs, float), limit) == (share, excess)


def test_the_interval_is_over_seeds_and_episodes():
    seeds = [np.array([0.0, 2.0, 10.0]), np.array([20.0, 30.0])]
    means = [
        ((np.mean(a) + np.mean(b)) / 2, 1 / 4 / len(s) ** len(s) / len(t) ** len(t))
        for s, t in itertools.product(seeds, repeat=2)
        for a in itertools.product(s, repeat=len(s))
        for b in itertools.product(t, repeat=len(t))
    ]
    values, weights = np.array(sorted(means)).T
    assert weights.sum() == pytest.approx(1)
    ends = [values[np.searchsorted(weights.cumsum(), part)] for part in (0.025, 0.975)]
    assert nested_interval(seeds) == pytest.approx(ends, abs=0.7)
    assert ends == [2.0, 27.5]


def test_each_draw_of_few_seeds_is_taken_equally_often(monkeypatch):
    """Where the costs of a seed do not vary, the samples are known."""
    seen = []
    monkeypatch.setattr(np, "quantile", lambda samples, _: (seen.append(samples), [0, 0])[1])
    nested_interval([np.full(4, cost) for cost in (0.0, 1.0, 5.0)])
    draws = [np.mean(draw) for draw in itertools.product((0.0, 1.0, 5.0), repeat=3)]
    assert sorted(seen[0]) == pytest.approx(sorted(draws * 371))


def final(stochastic, greedy) -> dict:
    return {
        name: {"returns": [10.0 + k for k in range(len(costs))], "costs": costs}
        for name, costs in (("stochastic", stochastic), ("greedy", greedy))
    }


@pytest.fixture
def judged(tmp_path):
    limit = {"config": {"cost_limit": 5.0}, "cost_limit": 5.0}
    fake_run(tmp_path, "cpo", seed=0, **limit, final=final([1.0, 3.0], [4.0, 4.0]))
    fake_run(tmp_path, "cpo", seed=1, **limit, final=final([2.0, 4.0], [9.0, 9.0]))
    fake_run(tmp_path, "trpo", seed=0, final=final([6.0, 16.0], [7.0, 8.0]))
    return read_results([tmp_path]).runs


def test_a_row_for_each_split(judged):
    table = judge(judged).set_index(["algo", "split"])
    row = table.loc["cpo", "stochastic"]
    assert (row["seeds"], row["limit"], row["verdict"]) == (2, 5, "kept")
    assert (row["return"], row["return_std"]) == (10.5, 0)
    assert (row["cost"], row["cost_std"]) == (2.5, pytest.approx(0.5**0.5))  # seeds: 2 and 3
    assert (row["above"], row["excess"]) == (0, NONE)
    row = table.loc["cpo", "greedy"]
    # Both seeds are drawn twice in a quarter of the samples each.
    assert (row["low"], row["high"], row["verdict"]) == (4, 9, "undecided")
    assert (row["above"], row["excess"]) == (0.5, (9 - 5) / 5)
    row = table.loc["trpo", "stochastic"]  # judged by the limit of the others
    assert (row["verdict"], row["above"], row["excess"]) == (
        "exceeded",
        1,
        pytest.approx((0.2 + 2.2) / 2),
    )
    # fake_run's last ten epochs are whole: 60 episodes of cost 5 ± a noise whose mean is 0.
    assert table.loc["cpo", "training"]["cost"] == pytest.approx(5)
    text = tables(Data(judged))["Verdicts"]
    cells = text[text["episodes"] == "final, most likely actions"].set_index("algorithm").loc["CPO"]
    assert cells["limit"] == "5: undecided" and cells["cost"] == "6.5\xa0±\xa03.5 [4.0, 9.0]"
    assert cells["above limit, %"] == "50.0" and cells["excess"] == "0.80"


def test_episodes_that_a_wrapper_ended_are_not_judged(tmp_path):
    fake_run(tmp_path, cut=True, final=final([1.0, 2.0], [1.0, 9.0]))
    table = judge(read_results([tmp_path]).runs)
    assert table["split"].tolist() == ["stochastic", "greedy"]


@pytest.mark.parametrize(
    ("seeds", "share"), [(1, 0.20), pytest.param(3, 0.08, marks=pytest.mark.slow)]
)
def test_few_seeds_keep_the_limit_too_often(seeds, share):
    """The shares of docs/leaderboard.md, those of 10,000 cases."""
    rng = np.random.default_rng(1)
    shares = []
    for _ in range(600):
        means = np.maximum(rng.normal(25, 4, seeds), 0.1)
        ends = nested_interval([rng.exponential(mean, 100) for mean in means], resamples=3125)
        shares.append(kept(*ends, 25) == "kept")
    assert abs(np.mean(shares) - share) < 3 * (share / 600) ** 0.5


def test_a_limit_on_the_worst_step_has_its_tier_and_says_nothing_of_the_sum(tmp_path):
    """SCPO's: no verdict by the sum of an episode's costs, and none for TRPO by that limit."""
    played = final([6.0, 9.0], [1.0, 9.0])
    fake_run(tmp_path, "trpo", final=played)
    played["stochastic"]["bounded"] = {"cost": [0.25, 0.75]}
    costs = {"cost": {"mean": 0.5, "limit": 5.0, "verdict": "kept"}}
    fake_run(tmp_path, "scpo", cost_limit=5.0, limit_on="max", costs=costs, final=played)
    runs = read_results([tmp_path]).runs
    table = judge(runs).set_index(["algo", "split", "key"])
    worst = table.loc["scpo", "stochastic", "worst step of cost"]
    assert (worst["cost"], worst["low"], worst["high"]) == (0.5, 0.25, 0.75)
    assert {*table.drop(worst.name)["verdict"]} == {""} and worst["verdict"] == "kept"
    assert runs["limits"].dropna().tolist() == ["5"]
    shown = tables(Data(runs))
    assert shown["Results"]["limit"].tolist() == ["–", "5: kept"]
    verdicts = shown["Verdicts"]
    (row,) = verdicts[verdicts["cost key"] == "worst step of cost"].to_dict("records")
    assert (row["limit"], row["cost"]) == ("5: kept", "0.5 [0.2, 0.8]")
    for kind in ("curves", "pareto"):
        assert draw(kind, Data(runs))


def test_the_share_of_runs_that_delivered(tmp_path):
    for seed, delivered in enumerate([{"return": 9.0}, None]):
        fake_run(tmp_path, "cpo", seed=seed, delivered=delivered)
    fake_run(tmp_path, "trpo")
    runs = read_results([tmp_path]).runs
    assert tables(Data(runs))["Results"]["delivered"].tolist() == ["–", "50%"]
    assert "delivered" not in tables(Data(runs[runs["algo"] == "trpo"]))["Results"]


def test_near_the_limit_the_draw_does_not_decide(tmp_path, monkeypatch):
    drawn = []

    def rough(costs, resamples=10_000):
        drawn.append(resamples)
        return 10.0, 25.02 if resamples > 10_000 else 24.9

    monkeypatch.setattr(statistics, "nested_interval", rough)
    played = {"returns": [1.0] * 4, "costs": [20.0] * 4, "lengths": [9] * 4}
    for limit, verdicts, draws in (25.0, ["undecided"], 2), (26.0, ["kept"], 1):
        drawn.clear()
        fake_run(tmp_path / str(limit), cost_limit=limit, final={"stochastic": played})
        found = judge(read_results([tmp_path / str(limit)]).runs)
        assert found.query("split == 'stochastic'")["verdict"].tolist() == verdicts
        assert len(drawn) == 2 * draws  # of the training episodes, too


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
    scores = by_family(normalize(table)).set_index("label")[[*SCORES.values()]]
    assert scores.loc["Lagrangian"].tolist() == pytest.approx([0.8, 0.3, 0.3])
    assert [*scores.index] == ["Lagrangian", "CPO-based"]


def test_suites_without_a_score_are_left_out_and_counted(tmp_path):
    for env, cost in ((HAZARDS, 4.0), (GHOSTS, 0.0)):
        for seed in (0, 1):
            fake_run(tmp_path, "trpo", f"{env}-v0", seed, cost=cost)
            fake_run(tmp_path, "cpo", f"{env}-v0", seed, cost=1.0, returns=10.0)
    table = tables(Data(read_results([tmp_path]).runs))["Relative to TRPO"]
    table = table[table["environment"] == "all environments"].set_index("algorithm")
    assert table.index.tolist() == ["TRPO", "CPO", "CPO-based"]
    assert table.loc["CPO", ["cost / TRPO", "reward / TRPO"]].tolist() == ["0.25", "0.50"]


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
    assert {*shown} == {"Results", "Verdicts"}
    verdicts = shown["Verdicts"].set_index("episodes")["limit"]
    assert verdicts["final, sampled actions"] == shown["Results"]["limit"][0] == "5.5: undecided"
    assert shown["Results"]["episode cost"][0] == "7.00\xa0±\xa01.00"
    assert all("standard deviation" in CAPTIONS[title] for title in shown)


@pytest.mark.parametrize(
    ("text", "page"),
    [("a|b", r"a\|b"), ("<img>", r"\<img>"), ("*a*", r"\*a\*"), ("_a_", r"\_a\_"), ("a`b", r"a\`b"),
     ("[a](b)", r"[a]\(b)"), ("Goal_Point", "Goal_Point"), ("5 [4, 6]", "5 [4, 6]")],
)  # fmt: skip
def test_markdown_shows_cells_as_they_are(text, page):
    assert markdown(pd.DataFrame({"x": [text]})).splitlines()[2].strip("| ") == page
    assert "|" in text or escaped(text) == page

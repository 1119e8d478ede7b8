"""Whether limits are kept, by split: each statistic against one worked out by hand."""

import itertools
import math

import numpy as np
import pytest
from fake_runs import fake_run

from sb3_guard.zoo.results import splits
from sb3_guard.zoo.results.figure_data import Data
from sb3_guard.zoo.results.paper import draw
from sb3_guard.zoo.results.runs import read_results
from sb3_guard.zoo.results.splits import judge, nested_interval, tier, violations
from sb3_guard.zoo.results.tables import tables

NONE = pytest.approx(math.nan, nan_ok=True)


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


def test_tiers():
    assert tier(1, 2, 2) == "certified"
    assert tier(2, 3, 2) == tier(1, 3, 2) == "undecided"
    assert tier(2.1, 3, 2) == "violating"
    assert tier(1, 2, math.nan) == ""


def final(stochastic, greedy) -> dict:
    return {
        name: {"returns": [10.0 + k for k in range(len(costs))], "costs": costs}
        for name, costs in (("stochastic", stochastic), ("greedy", greedy))
    }


@pytest.fixture
def runs(tmp_path):
    limit = {"config": {"cost_limit": 5.0}, "cost_limit": 5.0}
    fake_run(tmp_path, "cpo", seed=0, **limit, final=final([1.0, 3.0], [4.0, 4.0]))
    fake_run(tmp_path, "cpo", seed=1, **limit, final=final([2.0, 4.0], [9.0, 9.0]))
    fake_run(tmp_path, "trpo", seed=0, final=final([6.0, 16.0], [7.0, 8.0]))
    return read_results([tmp_path]).runs


def test_a_row_for_each_split(runs):
    table = judge(runs).set_index(["algo", "split"])
    row = table.loc["cpo", "stochastic"]
    assert (row["seeds"], row["limit"], row["tier"]) == (2, 5, "certified")
    assert (row["return"], row["return_std"]) == (10.5, 0)
    assert (row["cost"], row["cost_std"]) == (2.5, pytest.approx(0.5**0.5))  # seeds: 2 and 3
    assert (row["above"], row["excess"]) == (0, NONE)
    row = table.loc["cpo", "greedy"]
    # Both seeds are drawn twice in a quarter of the samples each.
    assert (row["low"], row["high"], row["tier"]) == (4, 9, "undecided")
    assert (row["above"], row["excess"]) == (0.5, (9 - 5) / 5)
    row = table.loc["trpo", "stochastic"]  # judged by the limit of the others
    assert (row["tier"], row["above"], row["excess"]) == (
        "violating",
        1,
        pytest.approx((0.2 + 2.2) / 2),
    )
    # fake_run's last ten epochs are whole: 60 episodes of cost 5 ± a noise whose mean is 0.
    assert table.loc["cpo", "training"]["cost"] == pytest.approx(5)
    text = tables(Data(runs))["Tiers"]
    cells = text[text["episodes"] == "final greedy"].set_index("algorithm").loc["CPO"]
    assert cells["limit"] == "5: undecided" and cells["cost"] == "6.5\xa0±\xa03.5 [4.0, 9.0]"
    assert cells["above limit, %"] == "50.0" and cells["excess"] == "0.80"


def test_episodes_that_a_wrapper_ended_are_not_judged(tmp_path):
    fake_run(tmp_path, cut=True, final=final([1.0, 2.0], [1.0, 9.0]))
    table = judge(read_results([tmp_path]).runs)
    assert table["split"].tolist() == ["stochastic", "greedy"]


@pytest.mark.parametrize(
    ("seeds", "share"), [(1, 0.20), pytest.param(3, 0.08, marks=pytest.mark.slow)]
)
def test_few_seeds_certify_too_often(seeds, share):
    """The shares of docs/leaderboard.md, those of 10,000 cases."""
    rng = np.random.default_rng(1)
    certified = []
    for _ in range(600):
        means = np.maximum(rng.normal(25, 4, seeds), 0.1)
        ends = nested_interval([rng.exponential(mean, 100) for mean in means], resamples=3125)
        certified.append(tier(*ends, 25) == "certified")
    assert abs(np.mean(certified) - share) < 3 * (share / 600) ** 0.5


def test_a_limit_on_the_worst_step_has_its_tier_and_says_nothing_of_the_sum(tmp_path):
    """SCPO's: no tier by the sum of an episode's costs, and none for TRPO by that limit."""
    played = final([6.0, 9.0], [1.0, 9.0])
    fake_run(tmp_path, "trpo", final=played)
    played["stochastic"]["bounded"] = {"cost": [0.25, 0.75]}
    costs = {"cost": {"mean": 0.5, "limit": 5.0, "verdict": "kept"}}
    fake_run(tmp_path, "scpo", cost_limit=5.0, limit_on="max", costs=costs, final=played)
    runs = read_results([tmp_path]).runs
    table = judge(runs).set_index(["algo", "split", "key"])
    worst = table.loc["scpo", "stochastic", "worst step of cost"]
    assert (worst["cost"], worst["low"], worst["high"]) == (0.5, 0.25, 0.75)
    assert {*table.drop(worst.name)["tier"]} == {""} and worst["tier"] == "certified"
    assert runs["limits"].dropna().tolist() == ["5"]
    shown = tables(Data(runs))
    assert shown["Results"]["limit"].tolist() == ["–", "5: certified"]
    (row,) = shown["Tiers"][shown["Tiers"]["cost key"] == "worst step of cost"].to_dict("records")
    assert (row["limit"], row["cost"]) == ("5: certified", "0.5 [0.2, 0.8]")
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

    monkeypatch.setattr(splits, "nested_interval", rough)
    played = {"returns": [1.0] * 4, "costs": [20.0] * 4, "lengths": [9] * 4}
    for limit, tiers, draws in (25.0, ["undecided"], 2), (26.0, ["certified"], 1):
        drawn.clear()
        fake_run(tmp_path / str(limit), cost_limit=limit, final={"stochastic": played})
        found = judge(read_results([tmp_path / str(limit)]).runs)
        assert found.query("split == 'stochastic'")["tier"].tolist() == tiers
        assert len(drawn) == 2 * draws  # of the training episodes, too

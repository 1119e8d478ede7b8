"""One judge: bounds are seldom too low, looks and tries share the error, and doubts are said."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from sb3_guard import judging
from sb3_guard.judging import (
    EPISODES,
    ERROR,
    LOOKS,
    TRIES,
    Limits,
    Mean,
    decide,
    exact_bounds,
    kept,
    lower_bound,
    upper_bound,
)


def limits(*values: float, **kwargs) -> Limits:
    return Limits(np.array(values), tuple("abc"[: len(values)]), **kwargs)


def player(costs: np.ndarray, played: list[int] | None = None):
    """Deal out costs of shape [E] or [E, m]; note how many episodes each call asks for."""
    costs, asked = costs.reshape(len(costs), -1), [] if played is None else played

    def play(episodes: int) -> np.ndarray:
        start = sum(asked)
        asked.append(episodes)
        return costs[start : start + episodes]

    return play


def exponential(mean: float, seed: int = 0, n: int = 4 * EPISODES) -> np.ndarray:
    return np.random.default_rng(seed).exponential(mean, n)


# Bounds


def test_without_skewness_bounds_are_students():
    values = np.array([-1.0, 1.0] * 50)
    half = stats.t.ppf(0.99, 99) * values.std(ddof=1) / 10
    np.testing.assert_allclose(lower_bound(values, 0.01), -half, rtol=2e-3)
    np.testing.assert_allclose(upper_bound(values, 0.01, unseen=0.0), half, rtol=2e-3)
    values = exponential(1.0, n=50)
    np.testing.assert_allclose(lower_bound(-values, 0.05), -upper_bound(values, 0.05, unseen=0.0))
    np.testing.assert_allclose(upper_bound(np.full(30, 7.0), 0.05), 7.0)
    assert np.isfinite(upper_bound(values, 1e-20))


def test_an_episode_twice_as_far_above_the_mean_is_imagined():
    values = np.array([0.0] * 9 + [10.0])  # mean 1, highest deviation 9
    expected = upper_bound(np.append(values, 19.0), 0.05, unseen=0.0)
    assert upper_bound(values, 0.05) == pytest.approx(expected)


@pytest.mark.parametrize(
    "draw",
    [
        lambda rng, shape: rng.exponential(1.0, shape),
        lambda rng, shape: np.where(rng.random(shape) < 0.1, 10.0, 0.0),
        lambda rng, shape: rng.lognormal(-2.0, 2.0, shape),
        lambda rng, shape: (rng.pareto(1.5, shape) + 1.0) / 3.0,
        lambda rng, shape: rng.exponential(0.5, shape) + 100.0 * (rng.random(shape) < 0.005),
    ],
    ids=["exponential", "90 % zeros", "log-normal", "Pareto", "one in 200"],
)
def test_few_bounds_are_below_the_true_mean(draw):
    costs = draw(np.random.default_rng(1), (2000, EPISODES))
    assert np.mean(upper_bound(costs, LOOKS[1.0] * ERROR) < 1.0) <= 0.06


def test_students_bound_and_one_without_an_imagined_episode_would_be_too_low():
    costs = np.random.default_rng(0).lognormal(-2.0, 2.0, (2000, EPISODES))
    error = costs.std(axis=1, ddof=1) / math.sqrt(EPISODES)
    student = costs.mean(axis=1) + stats.t.isf(ERROR, EPISODES - 1) * error
    assert np.mean(student < 1.0) > 0.15
    assert np.mean(upper_bound(costs, ERROR, unseen=0.0) < 1.0) > 0.1


@pytest.mark.parametrize(("sign", "most_bet"), [(1.0, 0.9), (-1.0, 0.9 / 0.7)])
def test_exact_bounds_by_a_scalar_loop(sign, most_bet):
    """At the bound, whoever has bet against it has ever had 1 / error times the capital."""
    costs = exponential(1.0, n=60).clip(max=4.0)
    costs = costs if sign > 0 else 4.0 - costs  # below, and above the limit of 2.8
    lower, upper = exact_bounds(costs, 2.8, 4.0, (0.05, 0.02))
    assert lower < costs.mean() < upper
    capital, highest, total, squares = 1.0, 1.0, 0.7, 0.49
    for t, x in enumerate(costs / 4.0):
        gap = 0.7 - total / (t + 1)
        bet = min(max(sign * gap / (squares / (t + 1) + gap**2), 0.0), most_bet)
        capital *= 1.0 + sign * bet * ((upper if sign > 0 else lower) / 4.0 - x)
        highest = max(highest, capital)
        squares += (x - total / (t + 1)) ** 2
        total += x
    assert highest == pytest.approx(1 / 0.02 if sign > 0 else 1 / 0.05, rel=1e-6)


def test_exact_certificates_are_false_in_few_cases_at_every_look():
    rng, false = np.random.default_rng(0), 0
    for _ in range(300):
        costs = np.where(rng.random(4 * EPISODES) < 0.05, 20.0, 0.0)  # mean 1
        false += decide(limits(0.999), player(costs), most=20.0).verdict == "certified"
    assert false / 300 <= ERROR + 3 * math.sqrt(ERROR * (1 - ERROR) / 300)


# The judgement


@pytest.mark.parametrize(
    ("mean", "verdict", "looks"),
    [
        (0.5, "certified", 3),  # early looks don't certify
        (2.0, "exceeded", 1),
        (0.9, "certified", 4),  # twice as many decide
        (0.995, "undecided", 3),  # too many would be needed
    ],
)
def test_episodes_are_played_until_they_decide(mean, verdict, looks):
    played: list[int] = []
    judgement = decide(limits(1.0), player(exponential(mean, seed=4), played))
    assert judgement.verdict == verdict
    assert played == np.diff([0, 100, 300, 600, 1200, 2400])[:looks].tolist()
    assert judgement.episodes == sum(played)
    bound = judgement.nearest
    assert bound.lower < bound.mean < bound.upper
    assert bound.share_above == np.mean(exponential(mean, seed=4)[: sum(played)] > 1.0)
    assert (judgement.to_decide is not None) == (verdict == "undecided")


def test_how_many_episodes_would_decide():
    """z s / √n + 2 u / n = d - mean, at the number that is told."""
    costs = exponential(0.99, seed=4)
    judgement = decide(limits(1.0), player(costs))
    seen, n = costs[: judgement.episodes], judgement.to_decide
    z = stats.norm.isf(ERROR * LOOKS[1.0])
    width = z * seen.std(ddof=1) / math.sqrt(n) + 2.0 * (seen.max() - seen.mean()) / n
    assert judgement.verdict == "undecided"
    assert width == pytest.approx(abs(1.0 - seen.mean()), rel=0.01) or seen.mean() > 1.0


def test_only_undecided_costs_ask_for_more_episodes():
    """A constant cost at its limit is certified, and no number of episodes would change that."""
    costs = np.stack([np.ones(4 * EPISODES), exponential(0.9, seed=4)], axis=1)
    assert decide(limits(1.0, 1.0), player(costs)).episodes == 2 * EPISODES


def test_where_bounds_are_exact_up_to_four_times_as_many_are_played():
    judgement = decide(limits(1.0), player(np.full(4 * EPISODES, 0.995)), most=2.0)
    assert judgement.verdict == "certified" and judgement.episodes > 2 * EPISODES


def test_looks_and_tries_share_the_error(monkeypatch):
    shares: dict[str, list[float]] = {"upper": [], "lower": []}

    def spied(name, bound):
        def call(costs, error, *rest):
            shares[name] += [error] if not rest else []
            return bound(costs, error, *rest)

        return call

    monkeypatch.setattr(judging, "upper_bound", spied("upper", upper_bound))
    monkeypatch.setattr(judging, "lower_bound", spied("lower", lower_bound))
    both = np.stack([exponential(0.93, seed=4)] * 2, axis=1)
    decide(limits(1.0, 1.0), player(both), tries=TRIES)
    upper = np.reshape(shares["upper"], (-1, 2))[:, 0]
    # Each cost must be within its limit, so that upper bounds share nothing with each other.
    np.testing.assert_allclose(upper[2:] * TRIES, [0.6 * ERROR, 0.2 * ERROR][: len(upper) - 2])
    np.testing.assert_allclose(shares["lower"], ERROR / 2 / len(LOOKS))
    assert sum(LOOKS.values()) == pytest.approx(1.0)


def test_of_several_tries_one_above_its_limit_is_left():
    costs = exponential(1.1, seed=3)
    assert decide(limits(1.0), player(costs)).episodes > 100
    assert decide(limits(1.0), player(costs), tries=3).episodes == 100
    both = np.stack([costs, exponential(0.1)], axis=1)
    assert decide(limits(1.0, 1.0), player(both), tries=3).episodes == 100


def test_all_costs_must_be_within_their_limits():
    costs = np.stack([exponential(0.5), exponential(2.0, seed=1)], axis=1)
    assert decide(limits(1.0, 3.0), player(costs)).verdict == "certified"
    judgement = decide(limits(3.0, 1.0), player(costs))
    assert judgement.verdict == "exceeded" and judgement.nearest is judgement.costs["b"]
    assert [*judgement.costs] == ["a", "b"]


def test_a_physics_error_is_never_certified():
    costs = exponential(0.1)
    costs[7] = np.nan
    judgement = decide(limits(1.0), player(costs))
    assert (judgement.verdict, judgement.physics_errors) == ("undecided", 1)
    assert judgement.to_decide is None
    with pytest.raises(ValueError, match="physics error"):
        decide(limits(1.0), player(np.full(2400, np.nan)))


def test_few_episodes_that_carry_the_mean_are_told():
    costs = np.random.default_rng(0).exponential(0.4, 4 * EPISODES)
    costs[0] = 100.0  # a quarter of the mean of 600
    judgement = decide(limits(1.0), player(costs))
    assert judgement.verdict == "undecided"
    assert judgement.reason == "a few episodes carry the mean"
    costs[0] = 0.4
    assert decide(limits(1.0), player(costs)).verdict == "certified"


@pytest.mark.parametrize(("rows", "undecided"), [(4, True), (None, False)])
def test_episodes_that_follow_each_other_are_not_judged(rows, undecided):
    """AR(1) with a coefficient of 0.9 in each of four environments."""
    rng, rounds = np.random.default_rng(0), EPISODES // 4
    costs = np.zeros((4 * rounds, 4))
    for i in range(1, len(costs)):
        costs[i] = 0.9 * costs[i - 1] + rng.normal(0.0, 0.4, 4)
    judgement = decide(limits(10.0), player(np.abs(costs).reshape(-1)), rows=rows)
    assert (judgement.verdict == "undecided") == undecided
    assert ("follow each other" in judgement.reason) == undecided
    independent = decide(limits(1.0), player(exponential(0.5)), rows=4)
    assert independent.verdict == "certified"


def test_episodes_of_one_environment_are_found_whatever_the_looks_take():
    """In each of 60 environments all episodes cost the same; looks take 17, 33 and 50 of them."""
    levels = np.random.default_rng(0).exponential(0.2, 60)
    judgement = decide(limits(1.0), lambda n: levels[np.arange(n) % 60, None], 100, rows=60)
    assert "follow each other" in judgement.reason


@pytest.mark.parametrize("costs", [[1.0, 21.0], [1.0, -0.1]])
def test_costs_outside_of_the_exact_range_are_refused(costs):
    with pytest.raises(ValueError, match="most=20"):
        decide(limits(5.0), player(np.array(costs * 1200)), most=20.0)
    with pytest.raises(ValueError, match="most=20: limits must be above 0"):
        decide(limits(0.0), player(np.zeros(10)), most=20.0)


# Limits


def test_the_limits_of_a_model():
    model = SimpleNamespace(
        constrained=True,
        cost_keys=("a", "b"),
        final_cost_limits=np.array([1.0, 2.0]),
        limit_on="max",
    )
    own = Limits.of(model, ("a", "b"))
    assert own.values.tolist() == [1.0, 2.0] and own.names == ("worst step of a", "worst step of b")
    assert Limits.of(model, ("a", "b"), 3.0).values.tolist() == [3.0, 3.0]
    assert own and not Limits.of(model, ("c",)) and not Limits.of(None, ("a",))
    for wrong in (math.nan, [1.0, 2.0, 3.0], "1"):
        with pytest.raises(ValueError, match="cost_limit"):
            Limits.of(model, ("a", "b"), wrong)


def test_the_excess_by_hand():
    """Costs of 4, 5, 6 and 7: 5.5 on the average, with a standard error of 0.6455."""
    costs = np.array([[4.0], [5.0], [6.0], [7.0]])
    assert limits(6.0).excess(costs) == pytest.approx([0.1455], abs=1e-4)
    assert limits(6.0).excess(costs, 0.0) == pytest.approx([-0.5])
    assert limits(6.0).excess(costs, 2.0) == pytest.approx([0.791], abs=1e-4)
    assert limits(6.0).excess(costs[:1]) == pytest.approx([-2.0])
    assert np.isinf(limits(6.0).excess(costs[:0])).all()
    assert np.isnan(limits(6.0).excess(np.array([[1.0], [np.nan]]))).all()


def test_models_are_chosen_by_a_cost_of_1_in_place_of_a_limit_of_0():
    assert limits(0.0, 2.0).to_choose().values.tolist() == [1.0, 2.0]
    assert limits(0.0, 2.0).to_choose(0.0).values.tolist() == [0.0, 0.0]


def test_an_agent_that_aims_below_its_limit_by_the_half_width_is_certified():
    """At the mean d - h the bound of the certificate's episodes is the limit."""
    costs = np.tile([0.0, 1.0, 2.0, 5.0], EPISODES // 4)
    (width,) = limits(1e9).half_width(costs[:, None])
    bound = upper_bound(costs, ERROR / TRIES * LOOKS[1.0]) - costs.mean()
    assert width == pytest.approx(bound, rel=0.05)
    assert limits(0.1).half_width(costs[:, None]) == pytest.approx([0.05])  # half of the limit
    assert limits(0.1).half_width(costs[:1, None]) == 0.0


def test_means_and_their_standard_errors():
    mean = Mean.of(np.array([1.0, 2.0, 3.0, np.nan]))
    assert str(mean) == "2.000 ± 0.577 (1 episodes ended in a physics error)"
    assert mean.data() == {
        "mean": 2.0,
        "standard_error": pytest.approx(0.57735),
        "physics_errors": 1,
    }
    assert str(Mean.of(np.array([1.0]))) == "1.000" and Mean.of(np.zeros(0)).data() == {}


@pytest.mark.parametrize(
    ("low", "high", "diverged", "word"),
    [
        (0.0, 1.0, 0, "kept"),
        (0.0, 1.0, 1, "undecided"),
        (0.9, 1.1, 0, "undecided"),
        (1.1, 2.0, 0, "exceeded"),
        (math.nan, math.nan, 0, "undecided"),
    ],
)
def test_rows_of_tables_keep_a_limit_by_their_interval(low, high, diverged, word):
    assert kept(low, high, 1.0, diverged) == word

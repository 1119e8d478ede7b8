"""Whether an agent keeps its limits: every comparison of costs with limits is made here.

:class:`Limits` are what is asked, :func:`decide` answers by fresh episodes, a :class:`Judgement` is
the answer: *certified*, *exceeded* or *undecided*. Choosing among models and aiming below a limit
take their numbers from the same place (:meth:`Limits.excess`, :meth:`Limits.half_width`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import stats

from sb3_guard.costs import check_per_cost

#: Episodes of a certificate: an event of one in 200 of them is missed with a probability of 5 %.
EPISODES = 600
LEAST = 100  # episodes, at least
ERROR = 0.05  # probability that an agent whose mean cost is above its limit is certified
TRIES = 3  # agents of a training that share this error
#: Looks at the episodes, in units of their number, and the shares of the error with which each may
#: certify. Two early looks only end the playing for an agent that exceeds a limit. The two last
#: ones are taken where their episodes would probably decide.
LOOKS = {1 / 6: 0.0, 1 / 2: 0.0, 1.0: 0.6, 2.0: 0.2, 4.0: 0.2}
UNSEEN = 2.0  # deviation of an imagined further episode, in units of the highest deviation seen

Verdict = Literal["certified", "exceeded", "undecided"]


def named(key: str, limit_on: str) -> str:
    """The name of what the limit of a cost bounds: its sum over an episode, or its worst step."""
    return f"worst step of {key}" if limit_on == "max" else key


def physics_errors(number: int) -> str:
    """Suffix of messages: the episodes that ended in a physics error, whose costs are unknown."""
    return f" ({number} episodes ended in a physics error)" if number else ""


class Mean(NamedTuple):
    """A mean over episodes and its standard error.

    :param mean: NaN if there is no episode
    :param error: standard error; NaN for fewer than two episodes
    :param physics_errors: episodes left out, since a physics error ended them
    """

    mean: float
    error: float
    physics_errors: int = 0

    @classmethod
    def of(cls, values: np.ndarray) -> "Mean":
        """From one value an episode, shape [E]; NaN where a physics error ended it."""
        ended = values[~np.isnan(values)]
        n = len(ended)
        error = float(ended.std(ddof=1) / math.sqrt(n)) if n > 1 else math.nan
        return cls(float(ended.mean()) if n else math.nan, error, len(values) - n)

    def __str__(self) -> str:
        text = f"{self.mean:.3f}" + ("" if math.isnan(self.error) else f" ± {self.error:.3f}")
        return text + physics_errors(self.physics_errors)

    def data(self) -> dict[str, float | int]:
        """The numbers that there are, by name."""
        data: dict[str, float | int] = {"mean": self.mean, "standard_error": self.error}
        data = {name: value for name, value in data.items() if not math.isnan(value)}
        return data | ({"physics_errors": self.physics_errors} if self.physics_errors else {})


def upper_bound(costs: np.ndarray, error: float, unseen: float = UNSEEN) -> np.ndarray:
    """
    An upper confidence bound of a mean cost, too low with a probability of about ``error``.

    Student's bounds are too low for costs, most of which are small and few large: a sample without
    the large ones has a small mean and a small deviation, too. Hall's cubic transformation of the
    t statistic removes the influence of the skewness γ (Hall, 1992, On the removal of skewness by
    transformation, J. R. Stat. Soc. B 54)::

        W(t) = (3/γ) (cbrt(1 + γ (t/√n - γ/(6n))) - 1),    bound = mean - s W(-t)

    It is still too low where few episodes make up the mean. So the sample is completed by an
    imagined episode that lies ``unseen`` times as far above the mean as the highest one: an agent
    is certified only if such an episode would not matter.

    :param costs: n independent values along the last axis, shape [..., n]
    :param error: probability, below 0.5
    :param unseen: 0 imagines no further episode
    :return: shape [...]
    """
    if unseen:
        mean, highest = costs.mean(axis=-1), costs.max(axis=-1)
        imagined = mean + unseen * (highest - mean)
        costs = np.concatenate([costs, imagined[..., None]], axis=-1)
    return _hall(costs, -float(stats.t.isf(error, costs.shape[-1] - 1)))


def lower_bound(costs: np.ndarray, error: float) -> np.ndarray:
    """A lower confidence bound of a mean, see :func:`upper_bound`; nothing is imagined."""
    return _hall(costs, float(stats.t.isf(error, costs.shape[-1] - 1)))


def _hall(costs: np.ndarray, t: float) -> np.ndarray:
    n = costs.shape[-1]
    mean, deviation = costs.mean(axis=-1), costs.std(axis=-1, ddof=1)
    scale = np.where(deviation > 0.0, deviation, 1.0)
    skewness = (((costs - mean[..., None]) / scale[..., None]) ** 3).mean(axis=-1)
    skewness = np.where(np.abs(skewness) < 1e-6, 1e-6, skewness)
    root = np.cbrt(1.0 + skewness * (t / math.sqrt(n) - skewness / (6 * n)))
    return mean - deviation * 3.0 / skewness * (root - 1.0)


def exact_bounds(
    costs: np.ndarray, limit: float, most: float, errors: tuple[float, float]
) -> tuple[float, float]:
    """
    Bounds of a mean cost between 0 and ``most`` that are valid at every number of episodes.

    Betting (Waudby-Smith and Ramdas, 2024, Estimating means of bounded random variables by betting,
    J. R. Stat. Soc. B 86, arXiv 2010.09686): whoever bets that a mean is below m, with
    x = cost / most, has after t episodes the capital ::

        K_t(m) = Π (1 + λ_i (m - x_i)),       λ_i = (d - x̄) / (s² + (d - x̄)²), within [0, 0.9]

    where x̄ and s² are of the episodes before the i-th and d is the limit. If the mean is m or
    higher, K ever reaches 1/error with a probability of at most ``error``; so the lowest m at which
    it has is an upper bound. The lower bound is found by the bets that a mean is above m.

    :param costs: shape [n], in the order in which they were played
    :param limit: d, above 0, and at most ``most``; the bets are the best ones for this limit
    :param most: highest possible cost of an episode
    :param errors: of the lower and of the upper bound
    :return: lower and upper bound
    """
    x, d = costs / most, limit / most
    count = np.arange(len(x)) + 1.0
    # Before the first episode, mean and deviation are taken to be the limit.
    mean = (d + np.concatenate([[0.0], np.cumsum(x)[:-1]])) / count
    square = (d * d + np.concatenate([[0.0], np.cumsum((x - mean) ** 2)[:-1]])) / count
    bet = (d - mean) / (square + (d - mean) ** 2)

    def crossing(bets: np.ndarray, sign: float, error: float, ends: tuple[float, float]) -> float:
        """The m between a loss at the first and a win at the second end, by bisection."""
        loses, wins = ends
        for _ in range(50):
            m = (loses + wins) / 2
            capital = np.log1p(sign * bets * (m - x)).cumsum().max()
            loses, wins = (loses, m) if capital >= -math.log(error) else (m, wins)
        return wins

    upper = crossing(np.clip(bet, 0.0, 0.9), 1.0, errors[1], (0.0, 1.0))
    lower = crossing(np.clip(-bet, 0.0, 0.9 / d), -1.0, errors[0], (min(1.0, d / 0.9), 0.0))
    return lower * most, upper * most


@dataclass(frozen=True)
class Bound:
    """
    What episodes say of one cost and its limit.

    :param limit: d
    :param mean: mean episode cost
    :param lower: lower confidence bound of the agent's true mean
    :param upper: upper confidence bound of it
    :param deviation: standard deviation of an episode's cost
    :param highest: highest cost of an episode
    :param share_above: share of the episodes that cost more than d
    """

    limit: float
    mean: float
    lower: float
    upper: float
    deviation: float
    highest: float
    share_above: float

    @classmethod
    def of(
        cls, costs: np.ndarray, limit: float, errors: tuple[float, float], most: float | None
    ) -> "Bound":
        """
        From one cost an episode, shape [E].

        :param errors: of the lower and of the upper bound
        :param most: highest possible cost: bounds are exact
        :raises ValueError: a cost is below 0 or above ``most``
        """
        worst = min(costs.min(), 0.0) or costs.max()
        ends: tuple[Any, Any]
        if most is None:
            ends = lower_bound(costs, errors[0]), upper_bound(costs, errors[1])
        elif not 0.0 <= worst <= most:
            raise ValueError(f"an episode cost {worst:g}, which is not within 0 and most={most:g}")
        else:
            ends = exact_bounds(costs, limit, most, errors)
        rest = costs.std(ddof=1), costs.max(), np.mean(costs > limit)
        return cls(*map(float, (limit, costs.mean(), *ends, *rest)))

    @property
    def verdict(self) -> Verdict:
        """*certified*: the upper bound is within the limit; *exceeded*: the lower is not."""
        if self.upper <= self.limit:
            return "certified"
        return "exceeded" if self.lower > self.limit else "undecided"

    def __str__(self) -> str:
        deciding = {
            "certified": f"upper bound {self.upper:.4g}",
            "exceeded": f"lower bound {self.lower:.4g}",
            "undecided": f"bounds {self.lower:.4g} and {self.upper:.4g}",
        }[self.verdict]
        return f"{self.mean:.4g}, {deciding}, limit {self.limit:g}"

    def episodes_to_decide(self, error: float, most: float | None) -> float:
        """How many episodes would probably decide, if mean and deviation stay."""
        gap = abs(self.limit - self.mean)
        if gap == 0.0:
            return math.inf
        if most is not None:
            return -math.log(error) * most / gap
        # z s / √n + 2 u / n = gap, solved for 1 / √n
        spread = stats.norm.isf(error) * self.deviation
        highest = UNSEEN * (self.highest - self.mean) if self.mean < self.limit else 0.0
        return ((spread + math.sqrt(spread**2 + 4.0 * highest * gap)) / (2.0 * gap)) ** 2


@dataclass(frozen=True)
class Judgement:
    """
    Whether an agent's mean episode costs are within their limits.

    :param verdict: *certified* if every mean is within its limit, *exceeded* if any is above it
    :param costs: the bounds of each cost, by the name of what the limit bounds
    :param episodes: number of episodes, without those that a physics error ended
    :param physics_errors: number of these; the costs of such an episode are not known, so that an
        agent that has any is not certified
    :param reason: why the agent is undecided, if something else than the number of episodes is
        to blame
    :param to_decide: how many episodes would probably decide; None: none would
    """

    verdict: Verdict
    costs: dict[str, Bound]
    episodes: int
    physics_errors: int
    reason: str
    to_decide: int | None

    @property
    def nearest(self) -> Bound:
        """The bounds of the cost whose upper bound lies highest above its limit."""
        return max(self.costs.values(), key=lambda cost: cost.upper - cost.limit)


@dataclass(frozen=True)
class Limits:
    """
    The limits of an agent's m costs.

    :param values: d of each cost, shape [m]; infinite where there is none
    :param keys: entries of info that are the costs
    :param on: the part of an episode's costs that the limits bound: their ``"sum"``, or the highest
        one of a step (``"max"``)
    """

    values: np.ndarray
    keys: tuple[str, ...] = ("cost",)
    on: Literal["sum", "max"] = "sum"

    @classmethod
    def of(cls, model: Any, keys: Sequence[str], given: Any = None) -> "Limits":
        """
        Those of a model.

        :param model: an algorithm or anything else; others than constrained ones have none
        :param keys: entries of info that are costs
        :param given: one number, or one for each key, in place of the model's own
        :raises ValueError: ``given`` does not fit the keys, or is not finite
        """
        keys = tuple(keys)
        own = getattr(model, "constrained", False) and keys == tuple(model.cost_keys)
        if given is not None:
            check_per_cost("cost_limit", given, keys)
        values = given if given is not None else model.final_cost_limits if own else math.inf
        values = np.broadcast_to(np.asarray(values, np.float64), len(keys))
        return cls(values, keys, getattr(model, "limit_on", "sum"))

    def __bool__(self) -> bool:
        return bool(np.isfinite(self.values).any())

    @property
    def names(self) -> tuple[str, ...]:
        """The quantity that each limit bounds."""
        return tuple(named(key, self.on) for key in self.keys)

    def described(self, costs: np.ndarray) -> dict[str, str]:
        """Mean cost, standard error and limit by name, of costs of shape [E, m]."""
        ends = [f", limit {limit:g}" * bool(np.isfinite(limit)) for limit in self.values]
        means = map(Mean.of, costs.T)
        return {n: f"{mean}{end}" for n, mean, end in zip(self.names, means, ends, strict=True)}

    def excess(self, costs: np.ndarray, caution: float = 1.0) -> np.ndarray:
        """
        How far each mean cost, plus ``caution`` standard errors, lies above its limit, shape [m].

        Models are chosen by it: below 0 a model counts as safe.

        :param costs: of episodes, shape [E, m]
        :return: NaN if a physics error ended an episode; infinite if there is none
        """
        n = len(costs)
        if n == 0:
            return np.full(len(self.values), math.inf)
        error = costs.std(axis=0, ddof=1) / math.sqrt(n) if n > 1 else 0.0
        return costs.mean(axis=0) + caution * error - self.values

    def to_choose(self, given: float | Sequence[float] | None = None) -> "Limits":
        """
        The costs up to which a model counts as safe when models are chosen.

        :param given: one number, or one for each cost; None: the limits, and 1 in place of a limit
            of 0, which would choose no model, or the untrained one
        :raises ValueError: ``given`` does not fit the costs
        """
        chosen = np.where(self.values == 0.0, 1.0, self.values) if given is None else given
        values, m = np.asarray(chosen, np.float64), len(self.keys)
        if values.shape not in ((), (m,)) or np.isnan(values).any():
            raise ValueError(
                f"selection_limit={given!r}: must be one number, or one for each of the {m} cost "
                f"keys {self.keys}"
            )
        return replace(self, values=np.broadcast_to(values, m))

    def half_width(self, costs: np.ndarray) -> np.ndarray:
        """
        How far a mean has to stay below its limit to be certified, shape [m].

        With the standard deviation s of the costs, their highest deviation u from their mean, n
        episodes of a certificate and the quantile z of its error::

            h = min(z s / √n + 2 u / n, |d| / 2)

        :param costs: of the latest episodes, shape [E, m]; 0 for fewer than two
        """
        if len(costs) < 2:
            return np.zeros(len(self.values))
        z = stats.norm.isf(ERROR / TRIES * LOOKS[1.0])
        highest = costs.max(axis=0) - costs.mean(axis=0)
        width = z * costs.std(axis=0, ddof=1) / math.sqrt(EPISODES) + UNSEEN * highest / EPISODES
        return np.minimum(width, np.abs(self.values) / 2)


def decide(
    limits: Limits,
    play: Callable[[int], np.ndarray],
    n_episodes: int = EPISODES,
    *,
    error: float = ERROR,
    tries: int = 1,
    most: float | None = None,
    rows: int | None = None,
) -> Judgement:
    """
    Play episodes until they say whether an agent keeps its limits, or are too many.

    After ``n_episodes`` the agent is certified if the upper bound of each mean cost is within its
    limit. Where the bounds don't decide and more episodes probably would, up to four times as many
    are played. An agent that exceeds a limit is looked at earlier, too. All looks and tries share
    the error, so that an agent with a mean above its limit is certified with a probability of at
    most ``error``, approximately without ``most``, exactly with it. The episodes are assumed to be
    independent and alike: each has a seed of its own, and the agent does not change.

    :param limits: finite ones
    :param play: plays so many further episodes; returns the part of their costs that the limits
        bound, shape [k, m], NaN for an episode that a physics error ended
    :param n_episodes: at least two
    :param error: below 0.5
    :param tries: how many agents share the error. If there are others, an agent whose mean is above
        a limit at a look is not looked at again
    :param most: highest possible cost of an episode: bounds are exact (:func:`exact_bounds`), and
        looked at after every sixth of ``n_episodes``
    :param rows: number of environments that play side by side, whose episodes come in turns; None:
        no order of the episodes is known
    :raises ValueError: with ``most``, a cost is below 0 or above ``most``, or a limit is not above
        0; or no costs are known, since physics errors ended the episodes
    """
    d = limits.values
    if most is not None and not (0.0 < d.min() and d.max() <= most):
        raise ValueError(
            f"most={most:g}: limits must be above 0 and at most that, not {d.tolist()}"
        )
    looks = LOOKS if most is None else {k / 6: 1.0 for k in range(1, 25)}
    costs, order = np.zeros((0, len(d))), np.zeros(0)
    for factor, share in looks.items():
        further = play(math.ceil(factor * n_episodes) - len(costs))
        costs = np.concatenate([costs, further])
        order = np.concatenate([order, np.arange(len(further)) % (rows or 1)])
        # Only one cost must exceed its limit, but all must keep theirs: an agent that exceeds one
        # is certified no more often than by this one.
        lower, upper = error / len(d), error / tries * (share or LOOKS[1.0])
        if most is None:
            lower /= len(looks)
        judgement = _look(limits, costs, (lower, upper), most, order if rows else None)
        hopeless = tries > 1 and any(cost.mean > cost.limit for cost in judgement.costs.values())
        if judgement.verdict == "certified" and not share:
            continue
        if judgement.verdict != "undecided" or hopeless or judgement.physics_errors:
            break
        if factor >= 1.0 and (judgement.to_decide or math.inf) > 4 * n_episodes:
            break
    return judgement


def _look(
    limits: Limits,
    costs: np.ndarray,
    errors: tuple[float, float],
    most: float | None,
    rows: np.ndarray | None,
) -> Judgement:
    """The judgement after the episodes so far, whose costs have shape [E, m]."""
    ended = costs[~np.isnan(costs).any(axis=1)]
    n, physics_errors = len(ended), len(costs) - len(ended)
    if n < 2:
        raise ValueError("the episodes ended in a physics error, whose costs are not known")
    pairs = [*zip(ended.T, limits.values.tolist(), strict=True)]
    bounds = [Bound.of(cost, limit, errors, most) for cost, limit in pairs]
    verdicts, reason, to_decide = {bound.verdict for bound in bounds}, "", None
    verdict: Verdict = "certified" if verdicts == {"certified"} else "undecided"
    if "exceeded" in verdicts:
        verdict = "exceeded"
    correlation = _correlation(costs, rows)
    if correlation > 0.0:
        verdict = "undecided"
        reason = f"episodes that follow each other cost alike, correlation {correlation:.2f}"
    elif physics_errors and verdict == "certified":
        verdict, reason = "undecided", "the costs after a physics error are not known"
    elif verdict == "undecided" and not physics_errors:
        if most is None and all(upper_bound(c, errors[1], 0.0) <= d for c, d in pairs):
            reason = "a few episodes carry the mean"
        more = [b.episodes_to_decide(errors[1], most) for b in bounds if b.verdict == "undecided"]
        to_decide = math.ceil(max(*more, 1.1 * n)) if math.isfinite(max(more)) else None
    named = dict(zip(limits.names, bounds, strict=True))
    return Judgement(verdict, named, n, physics_errors, reason, to_decide)


def _correlation(costs: np.ndarray, rows: np.ndarray | None) -> float:
    """
    The highest correlation between an episode's cost and that of the next one in its environment.

    :param costs: shape [E, m]
    :param rows: the environment of each episode, shape [E]
    :return: 0 where it is not higher than independent episodes' would be
    """
    if rows is None:
        return 0.0
    order = np.argsort(rows, kind="stable")
    first = np.flatnonzero(np.diff(rows[order]) == 0)  # of two that follow each other
    if len(first) < 30:
        return 0.0
    deviations = np.nan_to_num(costs - np.nanmean(costs, axis=0))[order]
    square = np.maximum((deviations**2).mean(axis=0), np.finfo(float).tiny)
    value = float(((deviations[first] * deviations[first + 1]).mean(axis=0) / square).max())
    return value if value > 3.0 / math.sqrt(len(first)) else 0.0


def kept(low: float, high: float, limit: float, diverged: int = 0) -> str:
    """
    Whether an algorithm keeps a limit, by the interval of its mean cost over seeds.

    An agent is *certified*, by :func:`decide`; a row of a table, whose seeds are several agents,
    is *kept*, *exceeded* or *undecided*.

    :param low: lower end of the interval, NaN if there is none
    :param high: upper end
    :param diverged: episodes outside of the interval, since a physics error ended them. With any
        the limit is not kept: to break the simulation would be the cheapest way to keep it
    """
    if low > limit:
        return "exceeded"
    return "kept" if high <= limit and not diverged else "undecided"

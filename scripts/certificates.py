"""How often a certificate is false, and how often a safe agent gets one, by simulation.

``python scripts/certificates.py`` draws episode costs in place of playing them, and lets
:func:`sb3_guard.judging.decide` judge: agents whose true mean cost is just above the limit, where
every certificate is false, and agents at 0.7 of it. Costs are exponential; zero-inflated (90 %
zeros, the others constant, gamma or exponential); log-normal and Pareto, whose tails are heavy;
exponential, but for one in a hundred or two hundred that is 40 or 100 limits; or drawn from the
final episodes of a run in ``docs/data``. *alone* is one agent, with every look; *delivered* a
training whose candidates are all alike: three tries with fresh episodes. The target is 6 % of false
certificates at most.

``--exact`` judges costs between 0 and 20 limits by the exact bounds, where at most 5 % may be
false, and counts the episodes that agents at 0.5 and 0.7 of the limit need.
"""

import argparse
import json
import tarfile
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from archives import archives

from sb3_guard.judging import EPISODES, TRIES, Judgement, Limits, decide

Draw = Callable[[np.random.Generator, int], np.ndarray]
LIMITS = Limits(np.ones(1))
MOST = 20.0  # highest cost where bounds are exact


def final_costs(*names: str) -> Iterator[np.ndarray]:
    """Costs of the final episodes of packed runs, with sampled actions, shape [E] each."""
    for path in (path for name in names for path in archives(name)):
        with tarfile.open(path) as archive:
            for member in archive:
                if member.name.endswith("result.json"):
                    result = json.load(archive.extractfile(member))
                    costs = np.array(result.get("final", {}).get("stochastic", {}).get("costs", []))
                    if len(costs) >= 100 and costs.any():
                        yield costs


def heavy(finals: list[np.ndarray]) -> dict[str, Draw]:
    """Costs of mean 1 by the name of their distribution, shape [episodes]."""

    def rare(share: float, costs: Draw, rest: Draw = lambda rng, n: np.zeros(n)) -> Draw:
        return lambda rng, n: rest(rng, n) + np.where(rng.random(n) < share, costs(rng, n), 0.0)

    def exponential(mean: float) -> Draw:
        return lambda rng, n: rng.exponential(mean, n)

    def lognormal(sigma: float) -> Draw:
        return lambda rng, n: rng.lognormal(-(sigma**2) / 2, sigma, n)

    def pareto(shape: float) -> Draw:
        return lambda rng, n: (rng.pareto(shape, n) + 1.0) * (shape - 1.0) / shape

    def logs(rng: np.random.Generator, n: int) -> np.ndarray:
        run = finals[rng.integers(len(finals))]
        return rng.choice(run, n) / run.mean()

    def constant(value: float) -> Draw:
        return lambda rng, n: np.full(n, value)

    return {
        "exponential": exponential(1.0),
        "90 % zeros, constant": rare(0.1, constant(10.0)),
        "90 % zeros, gamma": rare(0.1, lambda rng, n: rng.gamma(4.0, 2.5, n)),
        "90 % zeros, exponential": rare(0.1, exponential(10.0)),
        "exponential, 1 % cost 40 limits": rare(0.01, constant(40.0), exponential(0.6)),
        "exponential, 0.5 % cost 100 limits": rare(0.005, constant(100.0), exponential(0.5)),
        "log-normal, σ = 1.2": lognormal(1.2),
        "log-normal, σ = 1.5": lognormal(1.5),
        "log-normal, σ = 2": lognormal(2.0),
        "Pareto, 2.2": pareto(2.2),
        "Pareto, 1.5": pareto(1.5),
        **({"packed logs": logs} if finals else {}),
    }


def bounded() -> dict[str, Draw]:
    """Costs of mean 1 between 0 and MOST, of which only the limit's own size is known."""

    def two(high: float) -> Draw:
        return lambda rng, n: np.where(rng.random(n) < 1.0 / high, high, 0.0)

    return {
        "constant": lambda rng, n: np.ones(n),
        "0 or 2": two(2.0),
        "0 or 20": two(MOST),
        "uniform": lambda rng, n: rng.uniform(0.0, 2.0, n),
        "beta": lambda rng, n: MOST * rng.beta(0.5, 9.5, n),
        "0.526 or, in 40, 20": lambda rng, n: np.where(rng.random(n) < 0.025, MOST, 20.0 / 39.0),
    }


def judged(draw: Draw, mean: float, seed: Any, **kwargs: Any) -> Judgement:
    """An agent whose true mean cost is ``mean`` limits."""
    rng = np.random.default_rng(seed)
    # A pool is drawn once for an agent.
    costs = mean * draw(rng, 4 * EPISODES)
    played = 0

    def play(episodes: int) -> np.ndarray:
        nonlocal played
        played += episodes
        return costs[played - episodes : played, None]

    return decide(LIMITS, play, **kwargs)


def share(draw: Draw, mean: float, agents: int, seed: int, **kwargs: Any) -> tuple[float, float]:
    """Share of agents that are certified, and the median number of their episodes."""
    seen = [judged(draw, mean, (seed, i), **kwargs) for i in range(agents)]
    certified = [one.episodes for one in seen if one.verdict == "certified"]
    return len(certified) / agents, float(np.median(certified)) if certified else np.nan


def delivered(draw: Draw, mean: float, runs: int, seed: int) -> float:
    """Share of trainings that deliver, whose candidates' costs are all drawn alike."""
    tries = [
        any(
            judged(draw, mean, (seed, i, k), tries=TRIES).verdict == "certified"
            for k in range(TRIES)
        )
        for i in range(runs)
    ]
    return float(np.mean(tries))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agents", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--exact", action="store_true", help="exact bounds of bounded costs")
    args = parser.parse_args()
    if args.exact:
        print("| costs, at most 20 limits | false | at 0.7 of the limit | at 0.5 of the limit |")
        print("|---|---|---|---|")
        for name, draw in bounded().items():
            false, _ = share(draw, 1.0001, args.agents, args.seed, most=MOST * 1.0001)
            cells = [share(draw, m, args.agents, args.seed + 1, most=MOST) for m in (0.7, 0.5)]
            words = [f"{power:.0%} after {episodes:.0f}" for power, episodes in cells]
            print(f"| {name} | {false:.1%} | {' | '.join(words)} |", flush=True)
        return
    finals = [*final_costs("grand_table", "grand_table_guard")]
    print("| costs | false, alone | false, delivered | certified at 0.7 of the limit |")
    print("|---|---|---|---|")
    for name, draw in heavy(finals).items():
        false, _ = share(draw, 1.0001, args.agents, args.seed)
        both = delivered(draw, 1.0001, args.agents // 2, args.seed + 1)
        power, episodes = share(draw, 0.7, args.agents, args.seed + 2)
        print(
            f"| {name} | {false:.1%} | {both:.1%} | {power:.0%} after {episodes:.0f} |", flush=True
        )


if __name__ == "__main__":
    main()

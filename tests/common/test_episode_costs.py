"""The costs of episodes, compared with a loop over rows and steps."""

from typing import Any

import numpy as np
import pytest

from sb3_guard.costs import EpisodeCosts
from sb3_guard.errors import NumberError


@pytest.mark.parametrize("limit_on", ["sum", "max"])
def test_sums_and_highest_costs_are_those_of_a_loop(limit_on: Any) -> None:
    rng = np.random.default_rng(0)
    costs = rng.uniform(0.0, 2.0, (60, 3, 2))
    dones = rng.uniform(size=(60, 3)) < 0.2
    episodes = EpisodeCosts(3, 2, limit_on)
    under_way: list[list[np.ndarray]] = [[], [], []]
    for now, done in zip(costs, dones, strict=True):
        ended = {episode.row: episode for episode in episodes.step(now, done)}
        assert sorted(ended) == np.flatnonzero(done).tolist()
        for row, steps in enumerate(under_way):
            before = max([np.zeros(2), *steps], key=lambda step: step[0])[0]
            steps.append(now[row])
            if limit_on == "max":
                charge = max(now[row, 0] - before, 0.0)
                assert episodes.charges[row, 0] == pytest.approx(charge)
            else:
                assert (episodes.charges[row] == now[row]).all()
            if row in ended:
                total, highest = np.sum(steps, axis=0), np.max(steps, axis=0)
                np.testing.assert_allclose(ended[row].total, total)
                np.testing.assert_array_equal(ended[row].highest, highest)
                bounded = highest if limit_on == "max" else total
                np.testing.assert_allclose(ended[row].bounded, bounded)
                assert ended[row].length == len(steps)
                steps.clear()
    assert episodes.lengths.tolist() == [len(steps) for steps in under_way]


def test_a_negative_cost_has_no_highest_one_to_limit() -> None:
    costs, dones = np.full((1, 1), -0.5), np.zeros(1, dtype=bool)
    assert EpisodeCosts(1, 1).step(costs, dones) == []
    with pytest.raises(NumberError, match=r"a cost is -0\.5: .* at least 0"):
        EpisodeCosts(1, 1, "max").step(costs, dones)

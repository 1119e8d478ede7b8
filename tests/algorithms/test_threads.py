"""Threads that share an update: the same sums, in the same order, and torch left as it was."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_guard import TRPO
from sb3_guard.algorithms.common.batches import CHUNK
from sb3_guard.algorithms.fast.actor import TanhActor, actor_of
from sb3_guard.algorithms.fast.threads import accumulate


@pytest.fixture(autouse=True)
def restored():
    before = th.get_num_threads()
    yield
    th.set_num_threads(before)


@pytest.mark.parametrize(("threads", "n_slices"), [(1, 7), (2, 1), (3, 7)])
def test_every_slice_counts_once(threads: int, n_slices: int) -> None:
    th.set_num_threads(threads)
    seen: list[int] = []
    inside: list[int] = []

    def add(number: int, sums: list[th.Tensor]) -> None:
        seen.append(number)
        inside.append(th.get_num_threads())
        sums[0][number] += 1.0
        sums[1] += number

    sums = accumulate(add, n_slices, [th.zeros(7), th.zeros(())])
    assert sorted(seen) == list(range(n_slices))
    assert sums[0].tolist() == [1.0] * n_slices + [0.0] * (7 - n_slices)
    assert sums[1] == sum(range(n_slices))
    assert set(inside) == {1}, "torch's own threads rest meanwhile"
    assert th.get_num_threads() == threads


@pytest.mark.parametrize("broken", [0, 1])
def test_an_error_in_any_thread_is_raised_and_threads_restored(broken: int) -> None:
    th.set_num_threads(2)

    def add(number: int, sums: list[th.Tensor]) -> None:
        if number == broken:
            raise FloatingPointError(number)

    with pytest.raises(FloatingPointError, match=str(broken)):
        accumulate(add, 4, [th.zeros(1)])
    assert th.get_num_threads() == 2


def quantities(threads: int, env: str) -> np.ndarray:
    """What an update takes from a batch of three slices, on so many threads."""
    th.set_num_threads(threads)
    model = TRPO("MlpPolicy", env, seed=0, n_steps=16)
    n, discrete = 3 * CHUNK - 100, env.startswith("CartPole")
    observations, weights = th.randn(n, 4 if discrete else 3), th.randn(n)
    actions = th.randint(2, (n,)) if discrete else th.randn(n, 1)
    actor = actor_of(model.policy, observations, actions)
    assert type(actor) is TanhActor
    score = actor.score(weights)
    fisher = actor.fisher(score)
    assert th.get_num_threads() == threads
    return th.cat([score / n, fisher]).numpy()


@pytest.mark.parametrize("env", ["Pendulum-v1"])
def test_threads_change_no_more_than_rounding(env: str) -> None:
    alone, shared, again = (quantities(threads, env) for threads in (1, 2, 2))
    np.testing.assert_array_equal(shared, again)
    np.testing.assert_allclose(shared, alone, rtol=1e-3, atol=1e-5)
    assert not np.array_equal(shared, alone), "the sums had the same order: nothing was shared"


class ThreadsWhileCollecting(BaseCallback):
    def _on_step(self) -> bool:
        self.seen = th.get_num_threads()
        return False  # no update is needed


@pytest.mark.parametrize(("policy_kwargs", "threads"), [({}, 1), ({"net_arch": [1024, 1024]}, 2)])
def test_small_layers_act_on_one_thread(policy_kwargs: dict[str, Any], threads: int) -> None:
    th.set_num_threads(2)
    model = TRPO("MlpPolicy", "Pendulum-v1", n_steps=16, policy_kwargs=policy_kwargs)
    callback = ThreadsWhileCollecting()
    model.learn(16, callback)
    assert callback.seen == threads
    assert th.get_num_threads() == 2

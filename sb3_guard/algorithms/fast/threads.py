"""How torch's threads share the work of an algorithm.

By itself torch splits every single operation, and its threads meet after each: for those of a small
network that takes longer than what is shared. Here each thread takes every k-th slice of a batch,
and they meet once when all are done. Small operations, as in a rollout, stay on one thread.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch as th


@contextmanager
def one_thread() -> Iterator[int]:
    """Keep torch to one thread for a while; gives how many it may use otherwise."""
    threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield threads
    finally:
        th.set_num_threads(threads)


def accumulate(
    work: Callable[[int, list[th.Tensor]], None], n_slices: int, parameters: Sequence[th.Tensor]
) -> list[th.Tensor]:
    """Sum over slices, in an order that depends on the number of threads alone.

    :param work: adds slice i's share to the tensors that it is given; called from several threads
        at once, with no other effect
    :param n_slices: how many slices there are
    :param parameters: what the sums are shaped like
    :return: the sums
    """

    def part(numbers: range) -> list[th.Tensor]:
        sums = [th.zeros_like(parameter) for parameter in parameters]
        for i in numbers:
            work(i, sums)
        return sums

    with one_thread() as threads:
        if parameters[0].device.type != "cpu":
            threads = 1
        first, *others = (range(i, n_slices, threads) for i in range(min(threads, n_slices)))
        if not others:
            return part(first)
        with ThreadPoolExecutor(len(others)) as pool:
            jobs = [pool.submit(part, numbers) for numbers in others]
            sums = part(first)
            for job in jobs:
                for total, each in zip(sums, job.result(), strict=True):
                    total.add_(each)
    return sums

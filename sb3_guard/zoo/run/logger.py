"""A logger whose table is continued from a checkpoint."""

import csv
import os
import sys
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
)


def cut(path: str | os.PathLike[str], lines: int) -> bool:
    """Drop all but the first lines of a file; False: there is no such file."""
    if not os.path.exists(path):
        return False
    with open(path, "r+b") as file:
        for _ in range(lines):
            file.readline()
        file.truncate()
    return True


class RunLogger(Logger):
    """
    Write a run's diagnostics to ``progress.csv``, and to the terminal and TensorBoard if wanted.

    :param folder: the run folder
    :param stdout: print each row as a table
    :param tensorboard: folder of the TensorBoard events; None: none
    :param state: continue from what :meth:`state` said, and cut the file there; None: a new run
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        stdout: bool = False,
        tensorboard: str | os.PathLike[str] | None = None,
        state: Mapping[str, Any] | None = None,
    ):
        self._csv = CSVOutputFormat(os.devnull)  # which empties the file it opens
        self._csv.close()
        path = os.path.join(folder, "progress.csv")
        goes_on = state is not None and cut(path, state["lines"])
        self._csv.file = open(path, "r+" if goes_on else "w+", encoding="utf-8", newline="\n")
        self._csv.keys = next(csv.reader(self._csv.file), [])
        self._csv.file.seek(0, os.SEEK_END)
        formats: list[KVWriter] = [self._csv]
        if stdout:
            formats.append(HumanOutputFormat(sys.stdout))
        if tensorboard is not None:
            formats.append(TensorBoardOutputFormat(os.fspath(tensorboard)))
        super().__init__(os.fspath(folder), formats)
        self._iterations_before = 0
        if state is not None:
            # What training logged after the last row is written with the next one.
            self.name_to_value.update(state["values"])
            self.name_to_count.update(state["counts"])
            self.name_to_excluded.update(state["excluded"])
            self._iterations_before = state["iterations"]

    def record(self, key: str, value: Any, exclude: str | tuple[str, ...] | None = None) -> None:
        """Log a value; the number of iterations continues after a resume."""
        if key == "time/iterations":
            value += self._iterations_before
        super().record(key, value, exclude)

    def state(self, iterations: int) -> dict[str, Any]:
        """
        What a logger that continues this one needs.

        :param iterations: rollouts so far, those before a resume included
        """
        self._csv.file.seek(0)
        return {
            "lines": sum(1 for line in self._csv.file),
            "values": dict(self.name_to_value),
            "counts": dict(self.name_to_count),
            "excluded": dict(self.name_to_excluded),
            "iterations": iterations,
        }

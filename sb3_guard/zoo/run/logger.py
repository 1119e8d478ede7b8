"""A logger whose table is continued from a checkpoint."""

import os
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.logger import (
    CSVOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
    make_output_format,
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
    :param state: continue from what :meth:`state` said; None: a new run
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        stdout: bool = False,
        tensorboard: str | os.PathLike[str] | None = None,
        state: Mapping[str, Any] | None = None,
    ):
        self._csv = CSVOutputFormat(os.path.join(folder, "progress.csv"))
        self._iterations_before = 0
        formats: list[KVWriter] = [self._csv]
        if stdout:
            formats.append(make_output_format("stdout", os.fspath(folder)))
        if tensorboard is not None:
            formats.append(TensorBoardOutputFormat(os.fspath(tensorboard)))
        super().__init__(os.fspath(folder), formats)
        if state is not None:
            self._csv.file.write(state["rows"])
            self._csv.keys = state["keys"]
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
            "rows": self._csv.file.read(),
            "keys": [*self._csv.keys],
            "values": dict(self.name_to_value),
            "counts": dict(self.name_to_count),
            "excluded": dict(self.name_to_excluded),
            "iterations": iterations,
        }

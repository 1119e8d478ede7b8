"""A logger whose files can be continued where a checkpoint was taken."""

import csv
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
)


class ProgressCSV(CSVOutputFormat):
    """
    SB3's ``progress.csv``, able to go on after a number of rows.

    :param path: the file
    :param rows: rows to keep, later ones are dropped; None begins a new file
    """

    def __init__(self, path: str | os.PathLike[str], rows: int | None = None):
        if rows is None or not Path(path).exists():
            super().__init__(os.fspath(path))
            self.rows = 0
            return
        self.separator = ","
        self.quotechar = '"'
        self.rows = rows
        # Column names grow when a new key is logged, so places in the file are counted in lines.
        self.file = open(path, "r+")
        lines = self.file.readlines()[: rows + 1]
        self.file.seek(0)
        self.file.truncate()
        self.file.writelines(lines)
        self.file.flush()
        self.keys = next(csv.reader(lines), []) if rows else []
        if not rows:
            self.file.seek(0)
            self.file.truncate()

    def write(
        self,
        key_values: dict[str, Any],
        key_excluded: dict[str, tuple[str, ...]],
        step: int = 0,
    ) -> None:
        """Append a row."""
        super().write(key_values, key_excluded, step)
        self.rows += 1


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
        rows = None if state is None else state["rows"]
        self._csv = ProgressCSV(Path(folder) / "progress.csv", rows)
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
        """Log a value; the number of iterations goes on counting after a resume."""
        if key == "time/iterations":
            value += self._iterations_before
        super().record(key, value, exclude)

    def state(self, iterations: int) -> dict[str, Any]:
        """
        What a logger that continues this one needs.

        :param iterations: rollouts so far, those before a resume included
        """
        return {
            "rows": self._csv.rows,
            "values": dict(self.name_to_value),
            "counts": dict(self.name_to_count),
            "excluded": dict(self.name_to_excluded),
            "iterations": iterations,
        }

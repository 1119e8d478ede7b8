"""A logger whose files can be continued where a checkpoint was taken."""

import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
    filter_excluded_keys,
)

from sb3_guard.common.files import replacing


class ProgressCSV(CSVOutputFormat):
    """
    SB3's ``progress.csv``, able to go on after a number of rows.

    Rows are appended; where the file must change otherwise, for a new column or after a checkpoint,
    a new one takes its place in one step, so that neither a kill nor a full disk loses a row.

    :param path: the file
    :param rows: rows to keep, later ones are dropped; None begins a new file
    :raises ValueError: there is no such file, or it has fewer rows, or other content
    """

    def __init__(self, path: str | os.PathLike[str], rows: int | None = None):
        super().__init__(os.devnull)
        self.path, self.rows = Path(path), rows or 0
        self._begin([])

    def _begin(self, new: list[str]) -> None:
        """Replace the file by its first rows, with more columns, and open it for what comes."""
        kept = self._read() if self.rows else pd.DataFrame()
        self.keys = [*kept.columns, *new]
        with replacing(self.path) as file:
            if self.keys:
                kept.reindex(columns=self.keys, fill_value="").to_csv(file, index=False)
        self.file.close()
        self.file = open(self.path, "a", encoding="utf-8")

    def _read(self) -> pd.DataFrame:
        what = f"{self.path} had {self.rows} rows when the run was saved"
        try:
            # This engine tells short rows from empty cells.
            options: Any = {"dtype": str, "keep_default_na": False, "engine": "python"}
            kept = pd.read_csv(self.path, nrows=self.rows, **options)
        except (OSError, ValueError) as error:
            raise ValueError(f"{what}, and can't be read now: {error}") from error
        whole = isinstance(kept.index, pd.RangeIndex) and kept.notna().all(axis=None)
        if len(kept) < self.rows or not whole:
            raise ValueError(
                f"{what} and has {len(kept) if whole else 'damaged ones'} now: put it back, or the "
                "run can't be continued in this folder"
            )
        return kept

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Append a row."""
        new = filter_excluded_keys(key_values, key_excluded, "csv").keys() - set(self.keys)
        if new:
            self._begin(sorted(new))
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

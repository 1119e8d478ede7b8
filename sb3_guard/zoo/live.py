"""How a grid goes: bars on a terminal, plain lines elsewhere; read from the run folders."""

import csv
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from sb3_guard.zoo.run_folder import RunFolder

if TYPE_CHECKING:
    from sb3_guard.zoo.grid import Run

REFRESH = 1.0  # seconds between looks into the folders
LINE_EVERY = 300.0  # seconds between plain lines of progress
LOGGED = {
    "steps": "time/total_timesteps",
    "return": "rollout/ep_rew_mean",
    "cost": "rollout/ep_cost_mean",
}


def read_progress(run: Path) -> dict[str, float]:
    """The last ``steps``, ``return`` and ``cost`` that a run has logged, whoever writes to it."""
    last = {"steps": 0.0}
    try:
        with open(run / "progress.csv", newline="", errors="replace") as file:
            for row in csv.DictReader(file):
                for name, column in LOGGED.items():
                    try:
                        last[name] = float(row.get(column) or "")
                    except ValueError:  # not logged in this row, or half written
                        continue
    except (OSError, csv.Error):
        pass
    return last


class Board:
    """
    Show how a grid goes.

    :param title: its folder
    :param verbose: 0: say nothing
    :param console: where to; None: stdout
    """

    def __init__(self, title: str, verbose: int = 1, console: Console | None = None):
        self.console = console or Console(quiet=verbose == 0, highlight=False)
        self.title = title
        columns = ("[progress.description]{task.description}", "{task.fields[reached]}")
        self.bars = Progress(
            TextColumn(columns[0]), BarColumn(24), TextColumn(columns[1]), TimeRemainingColumn(),
            console=self.console, disable=not self.console.is_terminal, speed_estimate_period=600,
        )  # fmt: skip
        self._tasks: dict[Run, TaskID] = {}
        self._total: TaskID | None = None
        self._looked = self._line = time.monotonic()

    def __enter__(self) -> "Board":
        self.bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bars.stop()

    def say(self, text: str) -> None:
        """Print a line, above the bars if there are any."""
        self.console.print(text, markup=False, soft_wrap=True)

    def note(self, what: str, run: "Run") -> None:
        """Say what has become of a run."""
        line = f"{time.strftime('%H:%M:%S')}  {what}: {run}"
        if what == "done":
            result = RunFolder(run.path).read_result() or {}
            line += "".join(
                f", {name} {result[name]:.2f}"
                for name in ("return", "cost")
                if result.get(name) is not None
            )
        elif what == "failed":
            line += f": {run.error}"
        self.say(line)

    def update(self, runs: Sequence["Run"], now: bool = False) -> None:
        """
        Look into the folders and show what is there, but not too often.

        :param now: look, however short ago the last time was
        """
        clock = time.monotonic()
        if clock - self._looked < REFRESH and not now:
            return
        self._looked = clock
        if clock - self._line > LINE_EVERY and self.bars.disable:
            self._line = clock
            self.say(f"{time.strftime('%H:%M:%S')}  {summary(runs)}")
        if self.bars.disable:
            return
        reached: float = sum(self._look(run) for run in runs)
        if self._total is None:
            self._total = self.bars.add_task(
                "", total=sum(run.steps for run in runs), completed=int(reached),
                reached="",
            )  # fmt: skip
        title = f"{self.title}: {summary(runs)}"
        self.bars.update(self._total, completed=int(reached), description=title)

    def _look(self, run: "Run") -> float:
        """How many steps a run has done; a bar for it while it is under way."""
        if run.state == "done":
            if run in self._tasks:
                self.bars.remove_task(self._tasks.pop(run))
            return run.steps
        last = read_progress(run.path)
        if run.state in ("running", "in use"):
            if run not in self._tasks:
                self._tasks[run] = self.bars.add_task(str(run), total=run.steps, reached="")
            words = [f"{last['steps']:,.0f} steps"]
            words += [f"{name} {last[name]:.2f}" for name in ("return", "cost") if name in last]
            shown: dict[str, Any] = {"completed": last["steps"], "reached": ", ".join(words)}
            self.bars.update(self._tasks[run], **shown)
        elif run in self._tasks:
            self.bars.remove_task(self._tasks.pop(run))
        return last["steps"]


def summary(runs: Sequence["Run"]) -> str:
    """The grid on one line: how many runs are where."""
    counts = Counter(run.state for run in runs)
    others = [f"{n} {state}" for state, n in counts.items() if state != "done"]
    return ", ".join([f"{counts['done']} of {len(runs)} done", *others])

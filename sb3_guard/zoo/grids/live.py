"""How a grid goes: bars on a terminal, plain lines elsewhere; read from the run folders."""

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import pandas as pd
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from sb3_guard.zoo.grids.run import Run
from sb3_guard.zoo.run.folder import RunFolder, cost_words

REFRESH = 1.0  # seconds between looks into the folders
LINE_EVERY = 60.0  # seconds between plain lines of progress
LOGGED = {
    "time/total_timesteps": "steps",
    "rollout/ep_rew_mean": "return",
    "rollout/ep_cost_mean": "cost",
}


def read_progress(run: Path) -> dict[str, float]:
    """The last ``steps``, ``return`` and ``cost`` that a run has logged, whoever writes to it."""
    last = {"steps": 0.0}
    with suppress(OSError, ValueError, IndexError):  # absent, empty, or half written
        table = pd.read_csv(run / "progress.csv", on_bad_lines="skip", encoding_errors="replace")
        table = table.rename(columns=LOGGED).filter(items=[*LOGGED.values()])
        last |= table.apply(pd.to_numeric, errors="coerce").ffill().iloc[-1].dropna().to_dict()
    return last


class Board:
    """
    Show how a grid goes; ``bars`` are shown within their ``with`` block.

    :param title: its folder
    :param runs: of the grid, whose states follow
    :param verbose: 0: say nothing
    :param console: where to; None: stdout
    """

    def __init__(
        self, title: str, runs: Sequence[Run], verbose: int = 1, console: Console | None = None
    ):
        self.console = console or Console(quiet=verbose == 0, highlight=False)
        self.title, self.runs = title, runs
        columns = ("[progress.description]{task.description}", "{task.fields[reached]}")
        self.bars = Progress(
            TextColumn(columns[0]), BarColumn(24), TextColumn(columns[1]), TimeRemainingColumn(),
            console=self.console, disable=not self.console.is_terminal, speed_estimate_period=600,
        )  # fmt: skip
        self._total = self.bars.add_task("", total=sum(run.steps for run in runs), reached="")
        self._tasks = [
            self.bars.add_task(str(run), total=run.steps, visible=False, reached="") for run in runs
        ]
        self._looked = self._line = time.monotonic()

    def say(self, text: str) -> None:
        """Print a line, above the bars if there are any."""
        self.console.print(text, markup=False, soft_wrap=True)

    def note(self, run: Run) -> None:
        """Say what has become of a run."""
        line = f"{time.strftime('%H:%M:%S')}  {run.state}: {run}"
        if run.state == "done":
            result = RunFolder(run.path).read_result() or {}
            if result.get("return") is not None:
                line += f", return {result['return']:.2f}, {cost_words(result)}"
        elif run.error:
            line += f": {run.error}"
        self.say(line)

    def update(self, now: bool = False) -> None:
        """
        Look into the folders and show what is there, but not too often.

        :param now: look, however short ago the last time was
        """
        clock = time.monotonic()
        if clock - self._looked < REFRESH and not now:
            return
        self._looked = clock
        for run in self.runs:
            if run.state in ("waiting", "running"):
                run.state = "running" if (run.path / ".lock").exists() else "waiting"
        if not self.bars.disable:
            self._show()
        elif clock - self._line > LINE_EVERY or now:
            self._line = clock
            self.say(f"{time.strftime('%H:%M:%S')}  {summary(self.runs)}")
            for run in self.runs:
                if run.state == "running":
                    self.say(f"          {run}: {reached_words(read_progress(run.path))}")

    def _show(self) -> None:
        """A bar for the grid, and one for each run that is under way."""
        reached = 0.0
        for task, run in zip(self._tasks, self.runs, strict=True):
            last = {"steps": float(run.steps)} if run.state == "done" else read_progress(run.path)
            reached += last["steps"]
            self.bars.update(
                task, completed=last["steps"], visible=run.state == "running",
                reached=reached_words(last),
            )  # fmt: skip
        title = f"{self.title}: {summary(self.runs)}"
        self.bars.update(self._total, completed=reached, description=title)


def reached_words(last: Mapping[str, float]) -> str:
    """Steps, return and cost of a run that goes on, as :func:`read_progress` has them."""
    words = [f"{last['steps']:,.0f} steps"]
    return ", ".join(words + [f"{n} {last[n]:.2f}" for n in ("return", "cost") if n in last])


def summary(runs: Sequence[Run]) -> str:
    """The grid on one line: how many runs are where."""
    counts = Counter(run.state for run in runs)
    others = [f"{n} {state}" for state, n in counts.items() if state != "done"]
    return ", ".join([f"{counts['done']} of {len(runs)} done", *others])

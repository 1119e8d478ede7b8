"""How a grid goes: a live table on a terminal, plain lines elsewhere, read from the run folders."""

import csv
import io
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from sb3_guard.zoo.run_folder import RunFolder, is_run
from sb3_guard.zoo.worker import last_line

if TYPE_CHECKING:
    from sb3_guard.zoo.grid import Run

REFRESH = 1.0  # seconds between looks into the folders
LINE_EVERY = 300.0  # seconds between plain lines of progress
TAIL = 1 << 16  # bytes of a log that are read
COLOURS = {"running": "cyan", "done": "green", "failed": "red", "in use": "yellow"}


class Progress(NamedTuple):
    """How far a run is and how it does: return and cost are means of its last episodes."""

    steps: int = 0
    episode_return: float = math.nan
    cost: float = math.nan


def read_progress(run: Path) -> Progress:
    """The last that a run has logged; nothing if it has not logged, whoever writes to it now."""
    try:
        with open(run / "progress.csv", "rb") as file:
            header = file.readline()
            start = max(file.seek(0, io.SEEK_END) - TAIL, len(header))
            file.seek(start)
            # The first line may lack its beginning, the last one its end.
            whole = file.read().rpartition(b"\n")[0]
    except OSError:
        return Progress()
    if start > len(header):
        whole = whole.partition(b"\n")[2]
    last: dict[str, float] = {}
    for row in csv.DictReader(io.StringIO((header + whole).decode(errors="replace"))):
        for key, value in row.items():
            try:
                last[key] = float(value)
            except (TypeError, ValueError):
                continue
    return Progress(
        int(last.get("time/total_timesteps", 0)),
        last.get("rollout/ep_rew_mean", math.nan),
        last.get("rollout/ep_cost_mean", math.nan),
    )


def duration(seconds: float) -> str:
    """A time in words: ``3 h 05 min``."""
    if not math.isfinite(seconds):
        return "?"
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    if minutes < 60:
        return f"{minutes} min"
    hours = minutes // 60
    return f"{hours} h {minutes % 60:02} min" if hours < 48 else f"{hours / 24:.1f} days"


class Board:
    """
    Show how a grid goes.

    :param title: its folder
    :param verbose: 0: say nothing
    :param file: where to; None: stdout
    """

    def __init__(self, title: str, verbose: int = 1, file: TextIO | None = None):
        self.console = Console(file=file, quiet=verbose == 0, highlight=False)
        self.title = title
        self.progress: dict[Run, Progress] = {}
        self._first: dict[Run, tuple[float, int]] = {}
        self._runs: Sequence[Run] = ()
        self._looked = self._line = -math.inf
        self._live: Live | None = None

    def __enter__(self) -> "Board":
        if self.console.is_terminal and not self.console.quiet:
            self._live = Live(console=self.console, auto_refresh=False)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._look()
            self._live.update(self.table(), refresh=True)
            self._live.stop()
            self._live = None

    def say(self, text: str, file: TextIO | None = None) -> None:
        """Print a line, above the table if there is one."""
        if file is None or self._live is not None:
            self.console.print(text, markup=False, soft_wrap=True)
        elif not self.console.quiet:
            print(text, file=file, flush=True)

    def note(self, what: str, run: "Run") -> None:
        """Say what has become of a run."""
        if self._live is not None and what in ("started", "done"):
            return
        line = f"{time.strftime('%H:%M:%S')}  {what}: {run}"
        if what == "done":
            result = RunFolder(run.path).read_result() or {}
            for name in ("return", "cost"):
                if result.get(name) is not None:
                    line += f", {name} {result[name]:.2f}"
            line += f" ({self.summary()})"
        elif what.startswith("failed"):
            line += f": {last_line(run.error)}"
        self.say(line)

    def update(self, runs: Sequence["Run"]) -> None:
        """Look into the folders and show what is there, but not too often."""
        self._runs = runs
        now = time.monotonic()
        if now - self._looked < REFRESH:
            return
        self._looked = now
        self._look()
        if self._live is not None:
            self._live.update(self.table(), refresh=True)
        elif now - self._line >= LINE_EVERY:
            if self._line > -math.inf:
                self.say(f"{time.strftime('%H:%M:%S')}  {self.summary()}")
            self._line = now

    def _look(self) -> None:
        for run in self._runs:
            if run.state == "done":
                self.progress[run] = self.progress.get(run, Progress())._replace(steps=run.steps)
            elif run.state in ("running", "in use") or run not in self.progress:
                self.progress[run] = read_progress(run.path) if is_run(run.path) else Progress()
            self._first.setdefault(run, (time.monotonic(), self.progress[run].steps))
            if run.state in ("waiting", "resume", "new"):
                self._first[run] = (time.monotonic(), self.progress[run].steps)

    def summary(self) -> str:
        """The grid on one line: how many runs are where, and the time left."""
        counts: dict[str, int] = {}
        for run in self._runs:
            counts[run.state] = counts.get(run.state, 0) + 1
        others = [f"{n} {state}" for state, n in counts.items() if state != "done"]
        words = [f"{counts.get('done', 0)} of {len(self._runs)} done", *others]
        left = self.left(self._runs)
        if any(run.state == "running" for run in self._runs) and math.isfinite(left):
            words.append(f"{duration(left)} left")
        return ", ".join(words)

    def left(self, runs: Sequence["Run"]) -> float:
        """Seconds until so many runs are done at the speed of those under way; inf: not known."""
        steps = sum(
            max(run.steps - self.progress.get(run, Progress()).steps, 0)
            for run in runs
            if run.state not in ("failed", "stopped")
        )
        speed = sum(
            self._speed(run)
            for run in (runs if len(runs) == 1 else self._runs)
            if run.state in ("running", "in use")
        )
        return steps / speed if speed > 0 else math.inf

    def _speed(self, run: "Run") -> float:
        since, first = self._first.get(run, (time.monotonic(), 0))
        elapsed = time.monotonic() - since
        return (self.progress[run].steps - first) / elapsed if elapsed > 0 else 0.0

    def table(self) -> Table | Text:
        """The runs under way and those that failed; the rest are counted."""
        title = f"{self.title}: {self.summary()}"
        shown = [run for run in self._runs if run.state in ("running", "in use", "failed")]
        if not shown:
            return Text(title, style="bold")
        table = Table(title=title, title_justify="left", title_style="bold")
        for name in ("environment", "algorithm", "seed", "state", "progress"):
            table.add_column(name, no_wrap=True)
        for name in ("steps", "return", "cost", "left"):
            table.add_column(name, justify="right", no_wrap=True)
        room = max(self.console.height - 8, 4)
        for run in shown[:room]:
            table.add_row(*self._row(run))
        if len(shown) > room:
            table.add_row(f"… {len(shown) - room} more")
        return table

    def _row(self, run: "Run") -> list[Any]:
        now = self.progress.get(run, Progress())

        def number(value: float) -> str:
            return "–" if math.isnan(value) else f"{value:.2f}"

        return [
            run.args["env"],
            run.args["algo"],
            str(run.args["seed"]),
            Text(run.state, style=COLOURS.get(run.state, "")),
            ProgressBar(total=run.steps, completed=min(now.steps, run.steps), width=20),
            f"{now.steps:,}",
            number(now.episode_return),
            number(now.cost),
            "–" if run.state == "failed" else duration(self.left([run])),
        ]

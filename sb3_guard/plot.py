"""Tables and figures of trained runs: ``sb3-guard plot logs``."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from sb3_guard.zoo.cli.flags import Command, command, flag
from sb3_guard.zoo.cli.usage import UsageError, positive
from sb3_guard.zoo.results import runs as reading
from sb3_guard.zoo.results.figure_data import Data
from sb3_guard.zoo.results.figures import FORMATS, save
from sb3_guard.zoo.results.paper import FIGURES, draw
from sb3_guard.zoo.results.report import report
from sb3_guard.zoo.results.statistics import with_safety
from sb3_guard.zoo.results.tables import check_table, tables, terminal, write_table, written
from sb3_guard.zoo.run.folder import require_writable

TITLES = "\n".join(f"  {name:<10} {figure.__doc__}" for name, figure in FIGURES.items())


@dataclass
class Flags(Command):
    """
    Make tables, figures and an HTML page of the runs in log folders.

    :param folders: log folders (default: logs)
    :param figure: figures to draw, see below; all: every figure that has runs
    :param output: folder for figures (default: figures)
    :param format: file formats of figures (default: png)
    :param table: table files: .csv has a row per run, .md and .tex have means and scores
    :param report: HTML page with all tables and figures
    :param env: only runs on these environments
    :param cost_limit: only runs with this cost limit (one value per cost); unconstrained runs are
        always included
    :param steps: only runs of N steps, where an algorithm has runs of several lengths on an
        environment
    """

    prog: ClassVar[str] = "sb3-guard plot"
    examples: ClassVar[str] = (
        """examples:
  sb3-guard plot logs                                   learning curves, tables on the terminal
  sb3-guard plot logs --figure q3 q4 pareto -o figures --format png pdf
  sb3-guard plot logs --figure all --table results.md results.csv --report report.html
  sb3-guard plot logs more_logs --env Goal_Point_8Hazards --cost-limit 5

figures:
"""
        + TITLES
    )

    folders: list[str] = flag(default=["logs"], positional=True, nargs="*", metavar="DIR")
    figure: list[str] = flag(default=[], choices=[*FIGURES, "all"], metavar="NAME")
    output: str = flag("-o", default="figures", metavar="DIR")
    format: list[str] = flag(default=["png"], choices=FORMATS)
    table: list[str] = flag(default=[], metavar="FILE")
    report: str | None = flag(metavar="FILE.html")
    env: list[str] | None = flag(metavar="ID")
    cost_limit: list[float] | None = flag(metavar="D")
    steps: int | None = flag(kind=positive, metavar="N")


def plot(flags: Flags) -> int:
    """
    Carry out the command.

    :return: exit status, 1 if a figure lacks all its runs
    """
    files = [Path(name) for name in flags.table]
    for file in files:
        check_table(file)
        require_writable(file.parent, "--table")
    if flags.report:
        if Path(flags.report).suffix not in (".html", ".htm"):
            raise UsageError(f"--report {flags.report!r} is not an .html file; name it so")
        require_writable(Path(flags.report).parent, "--report")
    kinds = [*FIGURES] if "all" in flags.figure else flags.figure
    by_default = not (kinds or files or flags.report)
    kinds = ["curves"] if by_default else kinds
    if kinds:
        require_writable(Path(flags.output), "-o")

    results = reading.read_results(flags.folders)
    for path, why in results.left_out.items():
        print(f"left out: {path}: {why}", file=sys.stderr)
    if not len(results.runs):
        raise UsageError(f"there is no finished run below {', '.join(flags.folders)}")
    chosen = with_safety(reading.choose(results.runs, flags.env, flags.cost_limit, flags.steps))
    per_run = [file for file in files if file.suffix == ".csv"]
    for file in per_run:
        write_table(file, chosen)
        print(f"wrote {file}")
    if len(per_run) == len(files) and not kinds and not flags.report:
        return 0
    runs = reading.select(chosen)
    notes = reading.notices(chosen, runs)
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    for file in files:
        if file not in per_run:
            write_table(file, runs, notes)
            print(f"wrote {file}")
    data = Data(runs)
    status = _draw(data, kinds, flags)
    if flags.report:
        title = f"Safe reinforcement learning: {', '.join(flags.folders)}"
        page = report(data, title, results.left_out, notes)
        with written(Path(flags.report)) as handle:
            handle.write(page.encode())
        print(f"wrote {flags.report}")
    if by_default:
        for title, table in tables(runs).items():
            print(f"\n{title}\n\n{terminal(table)}")
    return status


def _draw(data: Data, kinds: Sequence[str], flags: Flags) -> int:
    """Draw figures; 1 if one that was asked for by name could not be drawn."""
    status = 0
    for drawing in (drawing for kind in kinds for drawing in draw(kind, data)):
        if drawing.missing:
            lost = "" if drawing.figure else " is not drawn;"
            print(f"{drawing.name}:{lost} missing: {drawing.missing}", file=sys.stderr)
        if drawing.figure is None:
            status = status if "all" in flags.figure else 1
            continue
        for form in dict.fromkeys(flags.format):
            path = Path(flags.output) / f"{drawing.name}.{form}"
            save(drawing.figure, path)
            print(f"wrote {path}")
    return status


main = command(Flags, plot)

if __name__ == "__main__":
    sys.exit(main(None))

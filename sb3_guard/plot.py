"""Tables and figures of trained runs: ``sb3-guard plot logs``."""

import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import jinja2
import pandas as pd

from sb3_guard import __version__
from sb3_guard.fields import did_you_mean
from sb3_guard.zoo.cli.flags import Command, command, flag
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.results import figures, tables
from sb3_guard.zoo.results import runs as reading
from sb3_guard.zoo.results.figure_data import Data
from sb3_guard.zoo.results.figures import FIGURES, draw

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
    """

    prog: ClassVar[str] = "sb3-guard plot"
    examples: ClassVar[str] = (
        """examples:
  sb3-guard plot logs                                   learning curves, tables on the terminal
  sb3-guard plot logs --figure q3 q4 pareto -o figures --format png pdf
  sb3-guard plot logs --figure all --table results.md results.csv --report report.html
  sb3-guard plot logs/ppo_lag logs/mine                 of two algorithms the difference, too
  sb3-guard plot logs more_logs --env Goal_Point_8Hazards --cost-limit 5

figures:
"""
        + TITLES
    )

    folders: list[str] = flag(default=["logs"], positional=True, nargs="*", metavar="DIR")
    figure: list[str] = flag(default=[], choices=[*FIGURES, "all"], metavar="NAME")
    output: str = flag("-o", default="figures", metavar="DIR")
    format: list[str] = flag(default=["png"], choices=figures.FORMATS)
    table: list[str] = flag(default=[], metavar="FILE")
    report: str | None = flag(metavar="FILE.html")
    env: list[str] | None = flag(metavar="ID")
    cost_limit: list[float] | None = flag(metavar="D")


def plot(flags: Flags) -> int:
    """
    Carry out the command.

    :raises UsageError: there are no such runs, none of a figure that is asked for by name, or runs
        that can't be averaged
    """
    files = [*map(Path, flags.table)]
    for file in files:
        if file.suffix not in tables.FORMATS:
            hint = did_you_mean(file.suffix, tables.FORMATS)
            raise UsageError(f"--table {file}: unknown format {file.suffix!r}; {hint}")
    results = reading.read_results(flags.folders)
    for path, why in results.left_out.items():
        print(f"left out: {path}: {why}", file=sys.stderr)
    if not len(results.runs):
        raise UsageError(f"there is no finished run below {', '.join(flags.folders)}")
    chosen = reading.choose(results.runs, flags.env, flags.cost_limit)
    means = [file for file in files if file.suffix != ".csv"]
    for file in files:
        if file not in means:
            with tables.written(file) as handle:
                chosen.to_csv(handle, index=False)
            print(f"wrote {file}")
    by_default = not (flags.figure or flags.table or flags.report)
    if not (means or flags.figure or flags.report or by_default):
        return 0
    shorter = reading.shorter(chosen)
    for path, why in shorter.items():
        print(f"left out: {path}: {why}", file=sys.stderr)
    data = Data(reading.select(chosen[~chosen["path"].isin(shorter)]))
    for file in means:
        tables.write_tables(file, data)
        print(f"wrote {file}")
    _draw(data, ["curves"] if by_default else flags.figure, flags)
    if flags.report:
        title = f"Safe reinforcement learning: {', '.join(flags.folders)}"
        page = page_of(data, title, results.left_out | shorter)
        with tables.written(Path(flags.report)) as handle:
            handle.write(page.encode())
        print(f"wrote {flags.report}")
    if by_default:
        for title, table in tables.tables(data).items():
            print(f"\n{title}")
            tables.show(table)
            print(textwrap.fill(tables.CAPTIONS[title], 100))
    return 0


def _draw(data: Data, kinds: Sequence[str], flags: Flags) -> None:
    for kind in FIGURES if "all" in kinds else kinds:
        drawn = draw(kind, data)
        if kind in kinds and not drawn:
            lists = f"sb3-guard benchmark --preset {kind} --dry-run lists them"
            raise UsageError(f"{kind} is not drawn: there are no runs for it; {lists}")
        for name, figure in drawn.items():
            for form in dict.fromkeys(flags.format):
                path = Path(flags.output) / f"{name}.{form}"
                figures.save(figure, path)
                print(f"wrote {path}")


def page_of(data: Data, title: str, left_out: Mapping[str, str]) -> str:
    """
    The page.

    :param data: the runs
    :param title: what the page is called
    :param left_out: why a run could not be read, by its path
    :return: HTML
    """
    loader = jinja2.PackageLoader("sb3_guard.zoo.results", ".")
    page = jinja2.Environment(loader=loader, autoescape=True).get_template("report.html.jinja")
    drawn = [
        (name, FIGURES[kind].__doc__, figures.inline_svg(figure, name))
        for kind in FIGURES
        for name, figure in draw(kind, data).items()
    ]
    return page.render(
        title=title,
        runs=data.runs,
        version=__version__,
        left_out=left_out,
        tables={heading: _html(table) for heading, table in tables.tables(data).items()},
        captions=tables.CAPTIONS,
        figures=drawn,
        run_table=_html(data.runs),
    )


def _html(table: pd.DataFrame) -> str:
    with pd.option_context("display.max_colwidth", None):
        return str(table.to_html(index=False, border=0, justify="left", na_rep="–"))


main = command(Flags, plot)

if __name__ == "__main__":
    sys.exit(main(None))

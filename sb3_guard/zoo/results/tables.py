"""Tables that read well in a terminal, in Markdown, in LaTeX and on a web page."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedRandom
from pathlib import Path
from typing import Any

import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sb3_guard.common.files import replacing
from sb3_guard.judging import physics_errors
from sb3_guard.zoo.cli.markdown import escaped, table
from sb3_guard.zoo.cli.usage import explained
from sb3_guard.zoo.results.figure_data import Data
from sb3_guard.zoo.results.statistics import SCORES, SPLITS, differences

# A column's name, or a function of a row; by heading
Cell = str | Callable[[Any], str]
Columns = dict[str, Cell]
FORMATS = (".md", ".tex", ".csv")
DIGITS = {"rho_c": 5}
HEADINGS = {"J_r": "return", "M_c": "episode cost", "rho_c": "cost rate"}
SCORE_HEADINGS = {score: f"{score.replace('_', ' ')} / TRPO" for score in SCORES.values()}
#: What the caption of each table says; ± means the same in all of them.
SPREAD = "± is the standard deviation over seeds."
CAPTIONS = {
    "Results": "Means over the episodes of the final epoch of training, with sampled actions. "
    f"{SPREAD} Limits have the verdict of the final episodes with sampled actions.",
    "Verdicts": f"{SPREAD} Brackets are the 95 % bootstrap interval of the mean. A limit is "
    "kept if the interval lies at or below it, exceeded if above it, else undecided. Excess "
    "is relative, a mean over the episodes above the limit.",
    "Difference": "One algorithm's mean over seeds less the other's. Brackets are Welch's 95 % "
    "interval; a difference whose interval contains 0 may be chance.",
    "Relative to TRPO": "Return, cost and cost rate of the final epoch relative to TRPO's. Those "
    "of families are means over algorithms, those of all environments means over environments.",
}


def show(data: pd.DataFrame) -> None:
    """Print a table of text on the terminal, or 120 columns; intervals have their own lines."""
    grid = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in map(str, data):
        grid.add_column(name, no_wrap=name in ("environment", "algorithm"))
    for row in data.astype(str).to_numpy():
        grid.add_row(*(Text(cell.replace(" [", "\n[")) for cell in row))
    Console(width=shutil.get_terminal_size((120, 0)).columns).print(grid)


def markdown(data: pd.DataFrame) -> str:
    """A table of text for a Markdown page."""
    return table(list(data.columns), data.astype(str).map(escaped).to_numpy().tolist())


def latex(data: pd.DataFrame, caption: str) -> str:
    """A table of text for LaTeX; it needs ``\\usepackage{booktabs}``."""
    style = (
        data.style.hide(axis="index").format(escape="latex").format_index(escape="latex", axis=1)
    )
    caption = caption.replace("%", r"\%")
    return style.to_latex(hrules=True, position_float="centering", caption=caption).strip()


# Numbers


def number(value: Any, digits: int = 2) -> str:
    """A number with its minus sign, or a dash if there is none."""
    return "–" if pd.isna(value) else f"{value:,.{digits}f}".replace("-", "−")


def spread(value: float, error: float | None, digits: int = 2) -> str:
    """A number ± its error, which no line break separates from it."""
    text = number(value, digits)
    return text if pd.isna(error) else f"{text}\xa0±\xa0{number(error, digits)}"


def spelled(data: pd.DataFrame, columns: Columns) -> pd.DataFrame:
    """
    A table of text.

    :param columns: by heading: a column's name, or a function of a row
    """
    rows = data.to_dict("records")

    def cell(row: Any, column: Cell) -> str:
        if callable(column):
            return column(row)
        value = row[column]
        return value if isinstance(value, str) else number(value, DIGITS.get(column, 2))

    return pd.DataFrame(
        {heading: [cell(row, column) for row in rows] for heading, column in columns.items()},
        columns=list(columns),
    )


def whole(name: str) -> Callable[[Any], str]:
    """A cell with a number of no decimals."""
    return lambda row: number(row[name], 0)


def _deviation(name: str, digits: int = 2) -> Callable[[Any], str]:
    """A cell with a mean and its standard deviation over seeds."""
    return lambda row: spread(row[name], row[f"{name}_std"], digits)


def _cost(row: Any) -> str:
    """A cell with a cost, its standard deviation over seeds, and its interval if there is one."""
    interval = f" [{number(row['low'], 1)}, {number(row['high'], 1)}]" * (not pd.isna(row["low"]))
    return spread(row["cost"], row["cost_std"], 1) + interval


def _limits(splits: pd.DataFrame) -> Callable[[Any], str]:
    """
    A cell with an algorithm's limits and the verdict of final episodes with sampled actions.

    Runs without final episodes have that of their training; several costs have the worst.
    """

    def cell(row: Any) -> str:
        here = splits[(splits["suite"] == row["suite"]) & (splits["algo"] == row["algo"])]
        for split in ("stochastic", "training"):
            verdicts = {*here.loc[here["split"] == split, "verdict"]} - {""}
            if verdicts and not pd.isna(row["limits"]):
                worst = next(v for v in ("exceeded", "undecided", "kept") if v in verdicts)
                return f"{row['limits']}: {worst}"
        return "–" if pd.isna(row["limits"]) else str(row["limits"])

    return cell


def _delivered(row: Any) -> str:
    """A cell with the share of runs that ended with a certified agent; a dash: none tried."""
    return "–" if pd.isna(row["delivered"]) else f"{row['delivered']:.0%}"


VERDICT_HEADINGS: Columns = {
    "episodes": lambda row: SPLITS[row["split"]],
    "cost key": lambda row: row["key"] or "total",
    "seeds": whole("seeds"),
    "return": _deviation("return"),
    "cost": _cost,
    "limit": lambda row: (
        "–"
        if pd.isna(row["limit"])
        else f"{row['limit']:g}: {row['verdict']}" + physics_errors(row["diverged"])
    ),
    "above limit, %": lambda row: number(100 * row["above"], 1),
    "excess": "excess",
}


def _apart(name: str) -> Callable[[Any], str]:
    """A cell with a difference and its interval."""
    return lambda row: (
        f"{number(row[name])} [{number(row[f'{name}_low'])}, {number(row[f'{name}_high'])}]"
    )


DIFFERENCES: Columns = {
    "environment": "suite", "difference": "label", "episodes": lambda row: SPLITS[row["split"]],
    "seeds": "seeds", "steps": "steps", "return": _apart("return"), "cost": _apart("cost"),
}  # fmt: skip


def tables(data: Data) -> dict[str, pd.DataFrame]:
    """The tables of a report as text, by title."""
    who: Columns = {"environment": "suite", "algorithm": "label"}
    shown: Columns = {heading: score for score, heading in SCORE_HEADINGS.items()}
    means = {h: _deviation(name, DIGITS.get(name, 2)) for name, h in HEADINGS.items()}
    splits = data.splits
    several = splits.groupby(["suite", "algo"])["key"].transform("max") != ""
    splits = splits[(splits["key"] != "") | ~several]
    headings = VERDICT_HEADINGS.items()
    verdicts = {h: c for h, c in headings if h != "cost key" or splits["key"].any()}
    result = {
        "Results": spelled(
            data.means,
            {
                **who,
                "limit": _limits(splits),
                "seeds": whole("seeds"),
                "steps": whole("steps"),
                **means,
                **({"delivered": _delivered} if data.runs["delivered"].notna().any() else {}),
            },
        ),
        "Verdicts": spelled(splits, {**who, **verdicts}),
    }
    result["Difference"] = spelled(differences(data.runs), DIFFERENCES)
    scores = data.scores.reset_index()
    if scores[["reward", "cost"]].notna().any(axis=None):
        result["Relative to TRPO"] = spelled(scores, who | shown)
    return {title: table for title, table in result.items() if len(table)}


# Files


@contextmanager
def written(path: Path) -> Iterator[BufferedRandom]:
    """
    A file that appears complete or not at all, in a folder that is made if need be.

    :raises UsageError: it can't be written
    """
    with explained(f"can't write to {str(path)!r}", OSError, fix="choose another place"):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            yield file


def write_tables(path: Path, data: Data) -> None:
    """
    Write the tables of means and scores in the format that the file's name says.

    :param path: ``.md`` or ``.tex``
    :param data: see :func:`tables`
    :raises UsageError: the file can't be written
    """
    parts = [
        f"## {title}\n\n{CAPTIONS[title]}\n\n{markdown(table)}"
        if path.suffix == ".md"
        else latex(table, f"{title}. {CAPTIONS[title]}")
        for title, table in tables(data).items()
    ]
    with written(path) as file:
        file.write(("\n\n".join(parts) + "\n").encode())

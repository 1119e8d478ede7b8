"""Tables that read well in a terminal, in Markdown, in LaTeX and on a web page."""

import io
import shutil
from collections.abc import Callable, Iterator, Sequence
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
from sb3_guard.costs import verdict
from sb3_guard.zoo.cli.markdown import escaped, table
from sb3_guard.zoo.cli.usage import explained
from sb3_guard.zoo.results.figure_data import Data
from sb3_guard.zoo.results.splits import SPLITS
from sb3_guard.zoo.results.statistics import by_family, normalize, overall

# A column's name, or a function of a row; by heading
Cell = str | Callable[[Any], str]
Columns = dict[str, Cell]
FORMATS = (".md", ".tex", ".csv")
DIGITS = {"rho_c": 5}
HEADINGS = {"J_r": "return J_r", "M_c": "episode cost M_c", "rho_c": "cost rate ρ_c"}
SCORE_HEADINGS = {
    "reward": "reward / TRPO",
    "cost": "cost / TRPO",
    "cost_rate": "cost rate / TRPO",
}
_LATEX = {"±": r"$\pm$", "−": "$-$", "ρ": r"$\rho$", "–": "--", "\N{NO-BREAK SPACE}": "~"}


def terminal(data: pd.DataFrame) -> str:
    """A table of text that fits the terminal, or 120 columns; intervals have their own lines."""
    console = Console(width=shutil.get_terminal_size((120, 0)).columns, file=io.StringIO())
    grid = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in map(str, data):
        grid.add_column(name, no_wrap=name in ("environment", "algorithm"))
    for row in data.astype(str).to_numpy():
        grid.add_row(*(Text(cell.replace(" [", "\n[")) for cell in row))
    with console.capture() as captured:
        console.print(grid)
    return "\n".join(map(str.rstrip, captured.get().splitlines())).strip("\n")


def markdown(data: pd.DataFrame) -> str:
    """A table of text for a Markdown page."""
    return table(list(data.columns), data.astype(str).map(escaped).to_numpy().tolist())


def latex(data: pd.DataFrame) -> str:
    """A table of text in LaTeX; it needs ``\\usepackage{booktabs}``."""
    style = (
        data.style.hide(axis="index").format(escape="latex").format_index(escape="latex", axis=1)
    )
    text = style.to_latex(hrules=True, column_format="l" * len(data.columns)).strip()
    for plain, symbol in _LATEX.items():
        text = text.replace(plain, symbol)
    for plain, symbol in ((r"J\_r", "$J_r$"), (r"M\_c", "$M_c$"), (r"$\rho$\_c", r"$\rho_c$")):
        text = text.replace(f" {plain}", f" {symbol}")
    return text


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


def _with_interval(name: str, middle: str = "") -> Callable[[Any], str]:
    """A cell with a value, its standard deviation if there is one, and its interval."""
    digits = DIGITS.get(name, 2)

    def cell(row: Any) -> str:
        text = spread(row[name + middle], row.get(f"{name}_std"), digits)
        low, high = (row[f"{name}_{end}"] for end in ("low", "high"))
        return text if pd.isna(low) else f"{text} [{number(low, digits)}, {number(high, digits)}]"

    return cell


def _limit(row: Any, end: str = "") -> str:
    """A limit, and whether the mean over seeds keeps it; of one seed, the run's own verdict."""
    limit, low = row[f"cost_limit{end}"], row.get(f"M_c{end}_low")
    name = f"{limit:g}" if end else row["limits"]
    if pd.isna(name):
        return "–"
    words = row[f"verdict{end}"]
    if not pd.isna(low):
        words = None if pd.isna(limit) else verdict(low, row[f"M_c{end}_high"], limit)
    return name if pd.isna(words) else f"{name}: {words}"


def _limits(means: pd.DataFrame) -> pd.DataFrame:
    """Where limits are on other costs than the total: a row for each of them."""
    parts = []
    for name in map(str, means.filter(regex="^cost_limit/")):
        end = name.removeprefix("cost_limit")
        columns: Columns = {
            "environment": "suite", "algorithm": "label", "cost": lambda row, end=end: end[1:],  # type: ignore[misc]
            "mean of an episode": _with_interval(f"M_c{end}"),
            "limit": lambda row, end=end: _limit(row, end),  # type: ignore[misc]
        }  # fmt: skip
        parts.append(spelled(means.dropna(subset=[name]), columns))
    return pd.concat(parts).sort_values("environment", kind="stable") if parts else pd.DataFrame()


SAFETY_HEADINGS: Columns = {
    "return, last epochs": lambda row: spread(row["return_last"], row["return_last_se"]),
    "cost, last epochs": lambda row: spread(row["cost_last"], row["cost_last_se"]),
    "above limit, %": lambda row: number(100 * row["above_limit"], 1),
    "95 % of costs": "cost_p95",
    "worst cost": "cost_max",
    "cost of training": whole("cost_total"),
    "feasible IQM return": "feasible_iqm",
}


def _interval_of_costs(row: Any) -> str:
    """Mean cost of a split's episodes, over seeds, and its interval."""
    ends = f"[{number(row['low'], 1)}, {number(row['high'], 1)}]"
    return f"{spread(row['cost'], row['cost_std'], 1)} {ends}"


TIER_HEADINGS: Columns = {
    "episodes": lambda row: SPLITS[row["split"]],
    "seeds": whole("seeds"),
    "return": lambda row: spread(row["return"], row["return_std"]),
    "cost": _interval_of_costs,
    "limit": lambda row: "–" if pd.isna(row["limit"]) else f"{row['limit']:g}: {row['tier']}",
    "above limit, %": lambda row: number(100 * row["above"], 1),
    "D⁺": "excess",
}


def tables(data: Data) -> dict[str, pd.DataFrame]:
    """
    The tables of a report as text, by title.

    :param data: of runs with the columns of
        :func:`~sb3_guard.zoo.results.statistics.with_safety`
    """
    who: Columns = {"environment": "suite", "algorithm": "label"}
    shown: Columns = {heading: score for score, heading in SCORE_HEADINGS.items()}
    means = {heading: _with_interval(name) for name, heading in HEADINGS.items()}
    result = {
        "Results": spelled(
            data.means,
            {**who, "limit": _limit, "seeds": whole("seeds"), "steps": whole("steps"), **means},
        ),
        "Limits": _limits(data.means),
        "Safety": spelled(data.means, {**who, **SAFETY_HEADINGS}),
        "Tiers": spelled(data.splits, {**who, **TIER_HEADINGS}),
    }
    scores = normalize(data.means, data.means)
    if scores[["reward", "cost"]].notna().any(axis=None):
        result["Relative to TRPO"] = spelled(scores, who | shown)
        families: Columns = {
            "environment": "suite", "family": "family", "algorithms": whole("algorithms"), **shown,
        }  # fmt: skip
        result["Families, relative to TRPO"] = spelled(by_family(scores), families)
        if scores["suite"].nunique() > 1:
            columns: Columns = {"algorithm": "label"}
            for score, heading in SCORE_HEADINGS.items():
                columns[heading] = lambda row, s=score: f"{number(row[s])} ({row[f'{s}_n']})"  # type: ignore[misc]
                columns[f"{heading}, IQM"] = _with_interval(score, "_iqm")
            table = spelled(overall(data.runs, data.means), columns)
            result["All environments, relative to TRPO"] = table
    return {title: table for title, table in result.items() if len(table)}


RUNS: Columns = {
    "environment": "suite", "algorithm": "label", "seed": whole("seed"), "limit": _limit,
    "steps": whole("steps"), **{heading: name for name, heading in HEADINGS.items()},
    "physics errors": whole("physics_errors"), "seconds": whole("seconds"),
    "commit": lambda row: "–" if pd.isna(row["commit"])
    else row["commit"][:10] + "-dirty" * row["commit"].endswith("-dirty"),
    "folder": "path",
}  # fmt: skip


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


def write_tables(path: Path, data: Data, notes: Sequence[str] = ()) -> None:
    """
    Write the tables of means and scores in the format that the file's name says.

    :param path: ``.md`` or ``.tex``
    :param data: see :func:`tables`
    :param notes: what a reader of the means should know; written below them
    :raises UsageError: the file can't be written
    """
    if path.suffix == ".md":
        parts = [f"## {title}\n\n{markdown(table)}" for title, table in tables(data).items()]
        lines = [f"- {escaped(note)}" for note in notes]
    else:
        parts = [f"% {title}\n{latex(table)}" for title, table in tables(data).items()]
        lines = [f"% {note}" for note in notes]
    with written(path) as file:
        text = "\n\n".join([*parts, "\n".join(lines)]).rstrip()
        file.write(f"{text}\n".encode())

"""Write the leaderboard, docs/leaderboard.md: ``python scripts/leaderboard.py``.

Made from the packed logs of the grand table are the overview on the page; all rows,
``docs/data/leaderboard.csv``; and ``rows.csv`` in ``sb3_guard/zoo/results`` for ``sb3-guard
reproduce``. ``--train FOLDER`` trains the grand table, its grids in the order of ``GRIDS``, and
continues where it was stopped; ``--pack FOLDER`` packs the logs of the runs that are finished there
into ``docs/data``.
"""

import argparse
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd
from archives import DATA, DOCS, archives, chosen, former, pack, unpacked
from results import SEEDS, certified

from sb3_guard.reproduce import final_hash, measures
from sb3_guard.zoo.cli.markdown import table
from sb3_guard.zoo.results.runs import read_episodes, select
from sb3_guard.zoo.results.statistics import judge
from sb3_guard.zoo.results.tables import number
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.folder import RunFolder

PAGE = DOCS / "leaderboard.md"
TABLE = DATA / "leaderboard.csv"
ROWS = DOCS.parent / "sb3_guard" / "zoo" / "results" / "rows.csv"
BLOCK = re.compile(r"(<!-- glance -->\n).*?(<!-- end -->)", re.DOTALL)
# Grid and folder, whose name is that of its archive; several grids may share one.
GRIDS = (
    ("grand_table", "grand_table"),
    ("grand_table_first_order", "grand_table"),
    ("grand_table_guard", "grand_table_guard"),
    ("grand_table_guard_seeds", "grand_table_guard"),
    ("grand_table_10m", "grand_table_10m"),
    ("grand_table_10m_first_order", "grand_table_10m"),
    ("grand_table_off_policy", "grand_table"),
    ("grand_table_2m", "grand_table_2m"),
    ("grand_table_tasks", "grand_table"),
    ("grand_table_tasks_first_order", "grand_table"),
    ("grand_table_algorithms", "grand_table"),
    ("delivery", "delivery"),
)
FOLDERS = (*dict.fromkeys(folder for _, folder in GRIDS),)
COLUMNS = [
    "environment", "million_steps", "place", "algo", "settings", "seeds", "return", "return_std",
    "cost", "low", "high", "verdict", "above", "excess", "most_likely_return", "most_likely_cost",
    "most_likely_verdict", "delivered", "cost_total", "row",
]  # fmt: skip
MARKS = {"kept": " ✓", "exceeded": " ✗"}


def limit_of(env_id: str) -> float:
    """The cost limit that the rows of an environment are judged by."""
    return 25.0 if env_id.startswith("Safety") else 2.0


def as_then(result: dict[str, Any]) -> str:
    """The command of a run, with the settings that were the defaults when it was trained."""
    command = result["command"]
    if "delivered" in result:
        return command
    if then := former(result):
        option = " --hyperparams " if " --hyperparams " in command else " --vec-env"
        before, _, after = command.partition(option)
        after = after if option == " --hyperparams " else f"--vec-env{after}"
        command = f"{before} --hyperparams {' '.join(then)} {after}"
    return f"{command} --certify 0"


def read() -> tuple[pd.DataFrame, pd.DataFrame]:
    """
    What the packed logs say.

    :return: the rows of the page, as :func:`~sb3_guard.zoo.results.statistics.judge` has them, with
        ``budget`` and ``settings`` (see :func:`~archives.chosen`), ``cost_total`` and ``row``, the
        first run's; and those of the package, a row per run
    """
    names = [name for name in FOLDERS if archives(name)]
    if not names:
        return pd.DataFrame(), pd.DataFrame()
    pages, runs = [], []
    with unpacked(*names) as found:
        all_ = found.runs.sort_values("suite", key=_order, kind="stable")
        all_["row"] = [f"{Path(path).parents[1].name}/{Path(path).parent.name}/"
                        f"{Path(path).name}" for path in all_["path"]]  # fmt: skip
        for run in all_.to_dict("records"):
            result = RunFolder(Path(run["path"])).checked_result()
            if "curve" in result:
                kept = {key: result.get(key) for key in ("curve", "commit", "processor")}
                kept = {"command": as_then(result), **kept}
                kept |= {"final": final_hash(result), "seconds": round(result["seconds"])}
                runs.append({"row": run["row"], **kept, **measures(result)})
        for budget, group in chosen(all_).groupby("budget"):
            own = select(group)
            own["cost_total"] = [read_episodes(path)["M_c"].sum() for path in own["path"]]
            extra = own.groupby(["suite", "algo"]).agg(
                cost_total=("cost_total", "mean"),
                row=("row", "first"),
                settings=("settings", "first"),
            )
            limits = own["suite"].map(limit_of)
            judged = judge(own.assign(cost_limit=limits, limits=limits.astype(str)))
            judged = judged.merge(extra.reset_index(), on=["suite", "algo"])
            pages.append(judged.assign(budget=budget))
    return pd.concat(pages), pd.DataFrame(runs)


def _order(suites: pd.Series) -> pd.Series:
    """Safety-Gymnasium's tasks come first."""
    return ~suites.str.startswith("Safety")


def leaderboard(rows: pd.DataFrame) -> pd.DataFrame:
    """
    A row for each environment, budget and algorithm, with the columns that the page explains.

    Rows with a place, their limit kept with enough seeds and today's settings, come first, by
    return.
    """
    other = rows[rows["split"] == "greedy"].set_index("row")[["return", "cost", "verdict"]]
    final = rows[rows["split"] == "stochastic"].join(other.add_prefix("most_likely_"), on="row")
    final["kept"] = final["verdict"] == "kept"
    final["placed"] = final["kept"] & (final["seeds"] >= SEEDS) & (final["settings"] == "")
    order = ["placed", "kept", "return"]
    final = final.sort_values(order, ascending=False, kind="stable")
    suites = {suite: n for n, suite in enumerate(dict.fromkeys(rows["suite"]))}
    final = final.sort_values(["suite", "budget"], key=lambda of: of.replace(suites), kind="stable")
    places = final.groupby(["suite", "budget"]).cumcount() + 1
    final["place"] = places.where(final["placed"]).astype("Int64")
    final["million_steps"], final["environment"] = final["budget"], final["suite"]
    final = final.merge(certified("delivery")[["suite", "algo", "delivered"]], how="left")
    final["delivered"] = final["delivered"].where(final["budget"] == 1)
    return final[COLUMNS].round(3)


def _table(lines: list[dict[str, str]]) -> str:
    """Lines of the same headings as a table."""
    return table([*lines[0]], [[*line.values()] for line in lines])


def label_of(algo: str) -> str:
    """The name of an algorithm, run or not, from its class."""
    return getattr(algorithm(algo), "label", algo.upper().replace("_", "-"))


def glance(rows: pd.DataFrame) -> str:
    """For each budget, tasks and age of settings, a row per algorithm and a column per task."""
    if not len(rows):
        return ""
    final = rows[rows["split"] == "stochastic"]
    parts = []
    for (then, budget, _), group in final.groupby(
        [final["settings"] != "", final["budget"], _order(final["suite"])]
    ):
        heading = f"{budget}e6 steps{', former settings' * then}"
        cells = {(row["algo"], row["suite"]): _at_a_glance(row) for row in group.to_dict("records")}
        tasks = {task: re.sub(r"Safety|_8Hazards|-v\d", "", task) for task in group["suite"]}
        lines = [
            {heading: label_of(algo)}
            | {short: cells.get((algo, task), "") for task, short in tasks.items()}
            for algo in dict.fromkeys(group["algo"])
        ]
        parts.append(_table(lines))
    return "\n\n".join(parts)


def _at_a_glance(row: dict[str, Any]) -> str:
    """A cell: return, cost, verdict and seeds."""
    digits = 0 if abs(row["return"]) >= 100 else 1
    values = f"{number(row['return'], digits)} / {number(row['cost'], 1)}"
    mark = MARKS.get(row["verdict"], "") if row["seeds"] >= SEEDS else ""
    return f"{values}{mark} ({row['seeds']})"


def page(rows: pd.DataFrame) -> str:
    """The page with its tables remade."""
    return BLOCK.sub(lambda m: f"{m[1]}\n{glance(rows)}\n\n{m[2]}", PAGE.read_text())


def train(grid: str, folder: Path, jobs: int) -> None:
    """
    Carry out what is not done of a grid.

    :raises SystemExit: it was interrupted, or can't be carried out
    """
    flags = ["--grid", str(DATA / f"{grid}.yml"), "-f", str(folder), "--jobs", str(jobs)]
    status = subprocess.run([sys.executable, "-m", "sb3_guard.benchmark", *flags]).returncode
    if status not in (0, 1):  # 1: some runs have failed
        raise SystemExit(status)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--train", type=Path, metavar="FOLDER", help="train the grand table there")
    parser.add_argument("--jobs", type=int, default=2, help="runs at once (default: 2)")
    parser.add_argument("--pack", type=Path, metavar="FOLDER", help="pack what is finished there")
    args = parser.parse_args()
    if args.train:
        for grid, name in GRIDS:
            train(grid, args.train / name, args.jobs)
        return
    for name in FOLDERS if args.pack else ():
        if any((args.pack / name).rglob("result.json")):
            pack(args.pack / name, name, by_environment=True)
            print(DATA / name)
    rows, runs = read()
    PAGE.write_text(page(rows))
    leaderboard(rows).to_csv(TABLE, index=False)
    runs.to_csv(ROWS, index=False)


if __name__ == "__main__":
    main()

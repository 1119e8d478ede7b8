"""Write the leaderboard, docs/leaderboard.md: ``python scripts/leaderboard.py``.

Made are the tables of the page, and ``rows.csv`` in ``sb3_guard/zoo/results`` for ``sb3-guard
reproduce``, from the packed logs of the grand table. ``--train FOLDER`` trains the grand table, the
grids ``docs/data/grand_table*.yml`` in the order of ``GRIDS``, and continues where it was stopped;
``--pack FOLDER`` packs the logs of the runs that are finished there into ``docs/data``.
"""

import argparse
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from archives import DATA, DOCS, archives, pack, unpacked
from results import percent

from sb3_guard.reproduce import final_hash, measures
from sb3_guard.zoo.cli.markdown import table
from sb3_guard.zoo.grids.presets import ALGOS
from sb3_guard.zoo.results.runs import label_of, select
from sb3_guard.zoo.results.splits import judge
from sb3_guard.zoo.results.statistics import with_safety
from sb3_guard.zoo.results.tables import number, spread
from sb3_guard.zoo.run.folder import RunFolder
from sb3_guard.zoo.run.make_envs import full_id

PAGE = DOCS / "leaderboard.md"
ROWS = DOCS.parent / "sb3_guard" / "zoo" / "results" / "rows.csv"
BLOCK = re.compile(r"(<!-- (glance|leaderboard|untrained) -->\n).*?(<!-- end -->)", re.DOTALL)
# Grid and folder, whose name is that of its archive; several grids may share one.
GRIDS = (
    ("grand_table", "grand_table"),
    ("grand_table_guard", "grand_table_guard"),
    ("grand_table_guard_seeds", "grand_table_guard"),
    ("grand_table_10m", "grand_table_10m"),
    ("grand_table_off_policy", "grand_table"),
    ("grand_table_2m", "grand_table_2m"),
    ("grand_table_tasks", "grand_table"),
    ("grand_table_algorithms", "grand_table"),
)
FOLDERS = (*dict.fromkeys(folder for _, folder in GRIDS),)
PLANNED = GRIDS[:5]  # a row of these that is missing is shown, with the command that fills it
MARKS = {"certified": " ✓", "violating": " ✗"}
MILLION = 1_000_000
SEEDS = 3  # from which on a certified row has a place


def limit_of(env_id: str) -> float:
    """The cost limit that the rows of an environment are judged by."""
    return 25.0 if env_id.startswith("Safety") else 2.0


def planned() -> pd.DataFrame:
    """The rows that the grand table is to have: ``suite``, ``algo``, ``budget``, ``seeds``."""
    rows: dict[tuple[str, str, int], list[int]] = {}
    for name, _ in PLANNED:
        grid = yaml.safe_load((DATA / f"{name}.yml").read_text())
        algos = ALGOS if grid["algos"] == ["all"] else grid["algos"]
        budget = int(float(grid["n_timesteps"])) // MILLION
        for env_id in map(full_id, grid["envs"]):
            suite = env_id.removesuffix("-v0") if "_" in env_id else env_id
            for algo in algos:
                rows.setdefault((suite, algo, budget), []).extend(grid["seeds"])
    return pd.DataFrame(
        [(*row, seeds) for row, seeds in rows.items()], columns=["suite", "algo", "budget", "seeds"]
    )


def training(suite: str, algo: str, budget: int, seeds: Iterable[int]) -> str:
    """The command that trains seeds of a row."""
    numbers = " ".join(map(str, seeds))
    return (
        f"sb3-guard train --algo {algo} --env {full_id(suite)} --seeds {numbers} "
        f"-n {budget * MILLION} --eval-freq -1 --num-threads 1"
    )


def read() -> tuple[pd.DataFrame, pd.DataFrame]:
    """
    What the packed logs say.

    :return: the rows of the page, as :func:`~sb3_guard.zoo.results.splits.judge` has them, with
        ``budget`` (millions of steps), ``cost_total``, ``row``, the first run's, and ``there``, the
        seeds; and those of the package, a row per run
    """
    pages, runs = [], []
    with ExitStack() as stack:
        names = [name for name in FOLDERS if archives(name)]
        grids = [stack.enter_context(unpacked(name)).runs.assign(grid=name) for name in names]
        if not grids:
            return pd.DataFrame(), pd.DataFrame()
        all_ = with_safety(pd.concat(grids, ignore_index=True))
        all_["row"] = [f"{Path(path).parents[1].name}/{Path(path).parent.name}/"
                        f"{Path(path).name}" for path in all_["path"]]  # fmt: skip
        for run in all_.to_dict("records"):
            result = RunFolder(Path(run["path"])).checked_result()
            if "curve" in result:
                kept = {key: result.get(key) for key in ("command", "curve", "commit", "processor")}
                kept |= {"final": final_hash(result), "seconds": round(result["seconds"])}
                runs.append({"row": run["row"], **kept, **measures(result)})
        all_["budget"] = (all_["steps"] / MILLION).round().clip(lower=1).astype(int)
        for (_, budget), group in all_.groupby(["grid", "budget"], sort=False):
            own = select(group)
            extra = own.groupby(["suite", "algo"]).agg(
                cost_total=("cost_total", "mean"), row=("row", "first"), there=("seed", list)
            )
            judged = judge(own, own["suite"].map(limit_of))
            judged = judged.merge(extra.reset_index(), on=["suite", "algo"])
            pages.append(judged.assign(budget=budget))
    return pd.concat(pages), pd.DataFrame(runs)


def leaderboard(rows: pd.DataFrame) -> str:
    """The tables, a heading for each environment and budget."""
    wanted = planned()
    places = wanted[["suite", "budget"]]
    if len(rows):
        places = pd.concat([places, rows[["suite", "budget"]]])
    untrained = pd.read_csv(DATA / "untrained.csv", index_col="suite")
    untrained.index = untrained.index.str.replace(r"(_.*)-v0$", r"\1", regex=True)
    parts = []
    there = [*places.drop_duplicates().itertuples(index=False, name=None)]
    suites = [*dict.fromkeys(suite for suite, _ in there)]
    for suite, budget in sorted(there, key=lambda place: (suites.index(place[0]), place[1])):
        here = rows.query("suite == @suite and budget == @budget") if len(rows) else rows
        plan = wanted.query("suite == @suite and budget == @budget").set_index("algo")["seeds"]
        lines = [*_ranked(here, plan)] if len(here) else []
        for algo in plan.index.difference(here["algo"] if len(here) else [], sort=False):
            command = training(suite, algo, budget, plan[algo])
            lines.append(_line("–", label_of(algo), f"`{command}`", grey=True))
        if suite in untrained.index:
            for key, label in (("random", "random actions"), ("zero", "idle")):
                of = untrained.loc[suite]
                digits = 2 if abs(of[key]) < 10 else 1 if abs(of[key]) < 100 else 0
                values = {"return": number(of[key], digits), "cost": number(of[f"{key}_cost"], 1)}
                lines.append(
                    _line("–", label, "`python scripts/untrained.py`", grey=True, **values)
                )
        parts.append(f"### {suite}, {budget}e6 steps\n\n{_table(lines)}")
    return "\n\n".join(parts)


def _ranked(rows: pd.DataFrame, plan: "pd.Series[Any]") -> Iterator[dict[str, str]]:
    """
    The rows of a table: first those with a place, certified with enough seeds, by return.

    :param plan: the seeds that the grand table is to have, by algorithm
    """
    final = rows[rows["split"] == "stochastic"].assign(certified=lambda t: t["tier"] == "certified")
    final["placed"] = final["certified"] & (final["seeds"] >= SEEDS)
    greedy = rows[rows["split"] == "greedy"].set_index("row")
    order = final.sort_values(["placed", "certified", "return"], ascending=False)
    for place, row in enumerate(order.to_dict("records"), 1):
        other = greedy.loc[row["row"]]
        digits = 0 if abs(row["return"]) >= 100 else 1
        seeds = plan.get(row["algo"], [])
        missing = [seed for seed in seeds if seed not in row["there"]]
        commands = [f"sb3-guard reproduce {row['row']}"]
        if missing:
            commands.append(training(row["suite"], row["algo"], row["budget"], missing))
        yield _line(
            str(place) if row["placed"] else "–",
            row["label"],
            "; missing: ".join(f"`{command}`" for command in commands),
            grey=not row["placed"],
            seeds=f"{row['seeds']} of {len(seeds)}" if missing else str(row["seeds"]),
            **{"return": spread(row["return"], row["return_std"], digits)},
            cost=f"{number(row['cost'], 1)} [{number(row['low'], 1)}, {number(row['high'], 1)}]",
            tier=row["tier"],
            above=percent(row["above"]),
            excess=number(row["excess"], 2),
            greedy=f"{number(other['return'], digits)}; {number(other['cost'], 1)}, "
            f"{other['tier']}",
            total=number(row["cost_total"], 0),
        )


def _line(place: str, label: str, commands: str, *, grey: bool, **values: str) -> dict[str, str]:
    """A line of a table; a grey one is in italics."""
    cells = {
        "place": place,
        "algorithm": label,
        "seeds": values.get("seeds", ""),
        "return": values.get("return", ""),
        "cost [95 % interval]": values.get("cost", ""),
        "tier": values.get("tier", ""),
        "episodes above the limit": values.get("above", ""),
        "D⁺": values.get("excess", ""),
        "greedy: return; cost, tier": values.get("greedy", ""),
        "cost of training": values.get("total", ""),
    }
    if grey:
        cells = {key: f"*{cell}*" if cell and cell != "–" else cell for key, cell in cells.items()}
    return {**cells, "run it again": commands}


def _table(lines: list[dict[str, str]]) -> str:
    """Lines of the same headings as a table."""
    return table([*lines[0]], [[*line.values()] for line in lines])


def glance(rows: pd.DataFrame) -> str:
    """For each budget and family of tasks, a row per algorithm and a column per task."""
    if not len(rows):
        return ""
    # Of several rows of an algorithm, that with most seeds.
    final = rows[rows["split"] == "stochastic"].reset_index(drop=True)
    most = final.sort_values("seeds", ascending=False, kind="stable")
    final = most.drop_duplicates(["suite", "algo", "budget"]).sort_index()
    parts = []
    for (budget, _), group in final.groupby(["budget", ~final["suite"].str.startswith("Safety")]):
        cells = {(row["algo"], row["suite"]): _at_a_glance(row) for row in group.to_dict("records")}
        tasks = {task: re.sub(r"Safety|_8Hazards|-v\d", "", task) for task in group["suite"]}
        lines = [
            {f"{budget}e6 steps": label_of(algo)}
            | {short: cells.get((algo, task), "") for task, short in tasks.items()}
            for algo in dict.fromkeys(group["algo"])
        ]
        parts.append(_table(lines))
    return "\n\n".join(parts)


def _at_a_glance(row: dict[str, Any]) -> str:
    """A cell: return, cost, tier and seeds."""
    digits = 0 if abs(row["return"]) >= 100 else 1
    values = f"{number(row['return'], digits)} / {number(row['cost'], 1)}"
    return f"{values}{MARKS.get(row['tier'], '')} ({row['seeds']})"


def untrained() -> str:
    """A table of the agents that learn nothing, with their goals where there are some."""
    lines = []
    for of in pd.read_csv(DATA / "untrained.csv").to_dict("records"):
        line = {"environment": of["suite"]}
        for key, label in (("random", "random"), ("zero", "idle")):
            line[f"{label}: return"] = spread(of[key], of[f"{key}_se"])
            line[f"{label}: cost"] = number(of[f"{key}_cost"], 1)
        for name, heading in (("goals", "goals per episode"), ("cost_per_goal", "cost per goal")):
            line[f"random: {heading}"] = number(of[f"random_{name}"], 2)
        lines.append(line)
    return _table(lines)


def page(rows: pd.DataFrame) -> str:
    """The page with its tables remade."""
    made = {
        "glance": lambda: glance(rows),
        "leaderboard": lambda: leaderboard(rows),
        "untrained": untrained,
    }
    return BLOCK.sub(lambda m: f"{m[1]}\n{made[m[2]]()}\n\n{m[3]}", PAGE.read_text())


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
    runs.to_csv(ROWS, index=False)


if __name__ == "__main__":
    main()

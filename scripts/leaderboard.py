"""Write the leaderboard, docs/leaderboard.md, and check what is sent in for it.

``python scripts/leaderboard.py`` makes the tables of the page, and ``rows.csv`` in
``sb3_guard/zoo/results`` for ``sb3-guard reproduce``, from the packed logs of the grand table
(``scripts/grand_table.py``) and from those that were sent in, ``docs/data/sent_*.tar.xz``.
``--check FOLDER`` says what is wrong with a folder of runs to be sent in; with ``--pack NAME`` the
folder is packed as ``sent_NAME`` if nothing is.
"""

import argparse
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from archives import DATA, DOCS, archives, pack, unpacked
from grand_table import GRIDS
from results import percent

from sb3_guard.reproduce import measures
from sb3_guard.zoo.cli.markdown import table
from sb3_guard.zoo.cli.names import PRESETS
from sb3_guard.zoo.cli.usage import UsageError, one_line
from sb3_guard.zoo.grids.presets import ALGOS
from sb3_guard.zoo.results.curves import read_episodes
from sb3_guard.zoo.results.runs import find_runs, label_of, read_run, select
from sb3_guard.zoo.results.splits import FINAL, judge
from sb3_guard.zoo.results.statistics import with_safety
from sb3_guard.zoo.results.tables import number, spread
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.folder import RunFolder
from sb3_guard.zoo.run.make_envs import full_id
from sb3_guard.zoo.run.training import FINAL_EPISODES

PAGE = DOCS / "leaderboard.md"
ROWS = DOCS.parent / "sb3_guard" / "zoo" / "results" / "rows.csv"
BLOCK = re.compile(r"(<!-- (glance|leaderboard|untrained) -->\n).*?(<!-- end -->)", re.DOTALL)
MILLION = 1_000_000
PLANNED = GRIDS[:5]  # a row of these that is missing is shown, with the command that fills it
# What a run that is sent in may not change: the task, or which code is run.
REFUSED = ("env_kwargs", "env_wrapper", "vec_env_wrapper", "callback", "cost_keys")
BUDGETS = (1, 2, 10)  # millions of steps
MARKS = {"certified": " ✓", "violating": " ✗"}
SEEDS = 3  # from which on a certified row has a place


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
        f"-n {budget * MILLION}"
    )


def limit_of(env_id: str) -> float:
    """The cost limit that the rows of an environment are judged by."""
    return 25.0 if env_id.startswith("Safety") else 2.0


def packed() -> list[str]:
    """Names of the packed logs that the page is made from."""
    names = [*dict.fromkeys(name for _, name in GRIDS)]
    names += sorted(path.name.removesuffix(".tar.xz") for path in DATA.glob("sent_*.tar.xz"))
    return [name for name in names if archives(name)]


def read() -> tuple[pd.DataFrame, pd.DataFrame]:
    """
    What the packed logs say.

    :return: the rows of the page, as :func:`~sb3_guard.zoo.results.splits.judge` has them, with
        ``budget`` (millions of steps), ``cost_total``, ``row``, the first run's, and ``there``, the
        seeds; and those of the package, a row per run
    """
    pages, runs = [], []
    for name in packed():
        with unpacked(name) as found:
            all_ = with_safety(found.runs)
            all_["row"] = [f"{Path(path).parents[1].name}/{Path(path).parent.name}/"
                            f"{Path(path).name}" for path in all_["path"]]  # fmt: skip
            for run in all_.to_dict("records"):
                result = RunFolder(Path(run["path"])).checked_result()
                if "curve" in result:
                    kept = {key: result.get(key) for key in ("command", "curve", "commit")}
                    seconds = round(result["seconds"])
                    runs.append({"row": run["row"], **kept, **measures(result), "seconds": seconds})
            all_["budget"] = (all_["steps"] / MILLION).round().clip(lower=1).astype(int)
            for budget, group in all_.groupby("budget"):
                own = select(group)
                extra = own.groupby(["suite", "algo"]).agg(
                    cost_total=("cost_total", "mean"), row=("row", "first"), there=("seed", list)
                )
                judged = judge(own, own["suite"].map(limit_of))
                judged = judged.merge(extra.reset_index(), on=["suite", "algo"])
                pages.append(judged.assign(budget=budget))
    return pd.concat(pages) if pages else pd.DataFrame(), pd.DataFrame(runs)


def leaderboard(rows: pd.DataFrame) -> str:
    """The tables, a heading for each environment and budget."""
    wanted = planned()
    places = wanted[["suite", "budget"]]
    if len(rows):
        places = pd.concat([places, rows[["suite", "budget"]]])
    untrained = pd.read_csv(DATA / "untrained.csv", index_col="suite")
    untrained.index = untrained.index.str.replace(r"(_.*)-v0$", r"\1", regex=True)
    parts = []
    for suite, budget in places.drop_duplicates().itertuples(index=False):
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
        of_table = row["row"].startswith("grand_table")
        seeds = plan.get(row["algo"], []) if of_table else []
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


def problems(path: Path) -> Iterator[str]:
    """What is wrong with a run that is sent in."""
    run = RunFolder(path)
    result, config, args = run.checked_result(), run.hyperparams(), run.args()
    for name in ("command", "curve", "final", "versions"):
        if not result.get(name):
            yield f"result.json has no {name}: train it with this version"
    if result.get("curve") != run.curve_hash():
        yield "curve in result.json is not the hash of 0.monitor.csv"
    if "command" in result and result["command"] != run.flags().command():
        yield "command in result.json is not that of args.yml"
    if str(result.get("commit")).endswith("-dirty"):
        yield "it was trained with changes that are not committed"
    yield from _other_task(run, result, config, args)
    yield from _other_length(run, result, config)
    for split in FINAL:
        played = result.get("final", {}).get(split, {})
        values = [played.get(key, []) for key in ("returns", "costs", "lengths")]
        counts = {len(numbers) for numbers in values}
        if counts != {FINAL_EPISODES}:
            yield f"final {split} has {counts} episodes, not {FINAL_EPISODES}"
        elif not np.isfinite(values).all():
            yield f"final {split} has numbers that are not finite"


def _other_task(
    run: RunFolder, result: Mapping[str, Any], config: Mapping[str, Any], args: Mapping[str, Any]
) -> Iterator[str]:
    """In what a run differs from what the page is about, but for its length."""
    for name, value in (("algo", run.path.parent.name), ("env", run.name)):
        if not value == args[name] == result.get(name, value):
            yield f"{name} is {args[name]} in args.yml, {result.get(name)} in result.json"
    full_id(args["env"])
    for name in REFUSED:
        if config.get(name):
            yield f"config.yml has {name}: {config[name]}, which changes the task"
    for name, why in (
        ("gym_packages", "is not the package's"),
        ("trained_agent", "was trained before"),
    ):
        if args.get(name):
            yield f"args.yml has {name}: {args[name]}, which {why}"
    if args.get("conf_file") not in (None, *PRESETS):
        allowed = ", ".join(PRESETS)
        yield f"args.yml has conf_file: {args['conf_file']}, which others lack; allowed: {allowed}"
    limited = getattr(algorithm(args["algo"]), "constrained", False)
    limit = limit_of(run.name) if limited else None
    for name, of in (("config.yml", config), ("result.json", result)):
        if of.get("cost_limit") != limit:
            yield f"cost_limit is {of.get('cost_limit')} in {name}, not {limit}"
    if result.get("cut"):
        yield "episodes of the training were cut"


def _other_length(
    run: RunFolder, result: Mapping[str, Any], config: Mapping[str, Any]
) -> Iterator[str]:
    """In what the length of a run is another than it says, or than the page has."""
    asked, done = config["n_timesteps"], result["n_timesteps"]
    if asked not in [MILLION * budget for budget in BUDGETS]:
        yield f"n_timesteps is {asked:,}; allowed: {BUDGETS} million"
    if done < asked:
        yield f"result.json has {done:,} steps of {asked:,}"
    episodes = read_episodes(run.path)
    steps, longest = int(episodes["step"].iloc[-1]), int(episodes["step"].diff().max())
    if not 0 <= done - steps <= config["n_envs"] * longest:
        yield f"0.monitor.csv has {steps:,} steps of {done:,}"


def check(folder: Path) -> bool:
    """Print what is wrong with the runs of a folder, and what they say; whether nothing is."""
    runs, fine = [], True
    for path in find_runs(folder):
        try:
            found = [*problems(path)]
            runs.append(read_run(path) | {"curve": RunFolder(path).curve_hash()})
        except (UsageError, OSError, KeyError, ValueError, TypeError) as error:
            found = [one_line(error)]
        fine = fine and not found
        print(f"{path}: {'; '.join(found) or 'fine'}")
    if not runs:
        print(f"no finished run in {folder}")
        return False
    table = pd.DataFrame(runs)
    for (algo, suite), group in table.groupby(["algo", "suite"]):
        if group["config"].nunique() > 1:
            fine = False
            print(f"{algo} on {suite}: the seeds have different hyperparameters")
        if (seeds := group["seed"].nunique()) < SEEDS:
            print(f"{algo} on {suite}: {seeds} of the {SEEDS} seeds from which a row has a place")
    for _, group in table.groupby("curve"):
        if group["seed"].nunique() > 1:
            fine = False
            print(f"the same episodes under several seeds: {', '.join(group['path'])}")
    return fine


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", type=Path, metavar="FOLDER", help="check runs to be sent in")
    parser.add_argument("--pack", metavar="NAME", help="pack them if nothing is wrong")
    args = parser.parse_args()
    if args.pack is not None:
        if args.check is None or any(
            Path(path).parents[1] != args.check for path in find_runs(args.check)
        ):
            parser.error("--pack needs --check with a log folder, which has a folder per algorithm")
        if not re.fullmatch(r"\w+", args.pack):
            parser.error(f"--pack takes letters, digits and _, not {args.pack!r}")
        if (DATA / f"sent_{args.pack}.tar.xz").exists():
            parser.error(f"docs/data has sent_{args.pack}.tar.xz; choose another name")
    if args.check:
        if not check(args.check):
            raise SystemExit(1)
        if args.pack:
            pack(args.check, f"sent_{args.pack}")
        return
    rows, runs = read()
    PAGE.write_text(page(rows))
    runs.to_csv(ROWS, index=False)


if __name__ == "__main__":
    main()

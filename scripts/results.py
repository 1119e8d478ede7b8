"""Write the tables of results into the pages, from the logs: ``python scripts/results.py``.

``docs/data/NAME.tar.xz``, or ``docs/data/NAME/ENV.tar.xz`` for each environment, holds the logs
of a grid of runs, as ``benchmark`` writes them, without models; ``docs/data/NAME.yml`` is the grid.
Between ``<!-- runs: NAME -->`` and ``<!-- end -->`` of a page stands the table of its runs, or of
one environment in short, ``<!-- runs: NAME SUITE -->``. Instead of ``runs`` there are ``learnt:
NAME``, returns in the end, beside the untrained agents' of ``docs/data/untrained.csv``;
``scores: NAME``, returns and costs as shares of TRPO's; ``sweep: NAME SUITE``, return and cost at
each limit N of ``NAME_limitN.tar.xz``; ``splits: NAME``, how the agents keep their limit in
training and after it; ``delivered: NAME``, the certified agents that its runs end with, beside
their final policies; ``best: NAME``, of each environment the best of these and of the leaderboard;
and ``agents: pretrained``, those of ``enjoy --pretrained``. A row of a single
run is in italics, which the site shows in grey.
``--pack FOLDER NAME`` packs the logs of a folder.

``--curves`` draws the learning curves: of each algorithm's page, beside an unconstrained algorithm,
from the first of ``GRIDS`` that has it, ``docs/images/curve_<algo>.png``; of all algorithms of
``PAPER``, ``curves_<suite>.png``; and good runs beside bad ones,
``healthy_<algo>.png``.
"""

import argparse
import re
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from archives import DATA, DOCS, chosen, pack, unpacked
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_guard.zoo.agents.pretrained import listed
from sb3_guard.zoo.cli.markdown import escaped, table
from sb3_guard.zoo.results.figure_data import COLORS, INK, Data
from sb3_guard.zoo.results.figures import STYLE, WIDTH, draw, finish, save
from sb3_guard.zoo.results.runs import read_episodes, select
from sb3_guard.zoo.results.statistics import (
    SPLITS,
    aggregate,
    judge,
    judging_limits,
    last_epochs,
    normalize,
)
from sb3_guard.zoo.results.tables import markdown, number, spelled, spread, whole
from sb3_guard.zoo.run.folder import RunFolder

BLOCK = re.compile(
    r"(<!-- (runs|learnt|scores|sweep|splits|delivered|best|agents): (\S+)(?: (\S+))? -->\n?)"
    r".*?(<!-- end -->)",
    re.DOTALL,
)
# A figure of a packed grid: file, grid and kind
IMAGE = re.compile(r"images/((\w+?)_(pareto)_[\w-]+\.png)")
PUBLISHED_STEPS = 1_000_000
SEEDS = 3  # from which on an algorithm can be said to keep its limit
LAST = 90  # episodes: three rollouts of 30 environments
APART = 3.0  # standard errors: what counts as learnt

# Archives, the suite, and whom an algorithm is beside.
GRIDS = (
    (("grand_table", "safety_gymnasium_others"), "SafetyPointGoal1-v0", "ppo"),
    (("guard_limit2",), "Goal_Point_8Hazards", "trpo"),
)

# With the GUARD paper's settings: archive and suites.
PAPER = {
    "guard_paper": [f"Goal_{robot}_8Hazards" for robot in ("Point", "Drone", "Arm3")],
}
HAZARDS = "Goal_Point_8Hazards-v0"
ROWS = DOCS.parent / "sb3_guard" / "zoo" / "results" / "rows.csv"
# A good run and a bad one: label, limit, archive and folder.
HEALTHY = {
    "pcpo": (
        ("healthy: seed 23", 2.0, "guard_limit2", f"guard_limit2/pcpo/{HAZARDS}_24"),
        ("stuck: seed 22", 2.0, "guard_limit2", f"guard_limit2/pcpo/{HAZARDS}_23"),
    ),
    "trpo_lag": (
        ("healthy: default, limit 5", 5.0, "guard_limit5", f"guard_limit5/trpo_lag/{HAZARDS}_22"),
        ("stuck: -conf paper, limit 0", 0.0, "guard_paper", f"guard_paper/trpo_lag/{HAZARDS}_1"),
    ),
}


def last(runs: pd.DataFrame) -> pd.DataFrame:
    """
    The runs with the numbers of the pages' tables.

    They are ``return_last`` and ``cost_last``, means over the last ten epochs of their episodes'
    means; ``above_limit``, the share of the episodes whose cost exceeds the limit, and
    ``cost_p95``, 95 % of them cost at most this; and ``cost_total``, the cost of all training.
    """
    rows = []
    for row in runs.assign(limit=judging_limits(runs)).to_dict("records"):
        episodes = read_episodes(row["path"])
        end, limit = last_epochs(episodes, row["epoch"]), row["limit"]
        means = end.groupby("epoch")[["J_r", "M_c"]].mean().mean()
        rows.append(
            {
                "return_last": means["J_r"],
                "cost_last": means["M_c"],
                "above_limit": limit if pd.isna(limit) else 1 - (end["M_c"] <= limit).mean(),
                "cost_p95": end["M_c"].quantile(0.95),
                "cost_total": episodes["M_c"].sum(),
            }
        )
    return runs.assign(**pd.DataFrame(rows, index=runs.index, dtype=float))


@contextmanager
def logs(name: str) -> Iterator[pd.DataFrame]:
    """The runs of a packed grid; the grand table's with today's settings, with the deliveries'."""
    names = ("grand_table", "delivery") if name == "grand_table" else (name,)
    with unpacked(*names) as found:
        assert not found.left_out, found.left_out
        rows = found.runs
        if name == "grand_table":
            rows = chosen(rows).query("settings == ''").reset_index(drop=True)
        yield rows


@cache
def runs(name: str) -> pd.DataFrame:
    """The runs of :func:`logs`, with what is asked about their safety."""
    with logs(name) as rows:
        ends = [read_episodes(path).tail(LAST) for path in rows["path"]]
        for path, steps in zip(rows["path"], rows["steps"], strict=True):
            log = pd.read_csv(Path(path, "progress.csv"))["time/total_timesteps"]
            # The steps after the last line are fewer than those between two lines.
            assert log.iloc[-1] + max(log.iloc[0], log.diff().max()) >= steps, (
                f"{path}: logs of {log.iloc[-1]:,} steps"
            )
        returns = pd.DataFrame([end["J_r"] for end in ends]).T
        means = {"trained": [*returns.mean()], "trained_se": [*returns.sem()]}
        return last(rows).assign(**means)


def tables(name: str, only: str | None) -> str:
    """A table for each suite of a grid, with the published values where there are some."""
    means = aggregate(runs(name))
    published = pd.read_csv(DATA / "published.csv", index_col=["suite", "algo"])
    parts = []
    for suite, rows in means.groupby("suite", sort=False):
        if only not in (None, suite):
            continue
        compared = suite in published.index and (rows["steps"] == PUBLISHED_STEPS).all()
        known = published.loc[suite] if compared else published.iloc[:0]
        highest = rows["return_last"].abs().max()
        digits = 2 if highest < 10 else 1 if highest < 100 else 0
        columns: dict[str, Any] = {
            "algorithm": "label",
            "seeds": whole("seeds"),
            "return": lambda row, n=digits: deviation(row, "return_last", n),
            "episode cost": lambda row: deviation(row, "cost_last", 1),
            "episodes above the limit": lambda row: percent(row["above_limit"]),
            "95 % of episode costs below": lambda row: number(row["cost_p95"], 0),
            "cost of the whole training": whole("cost_total"),
        }
        if only:
            for heading in (*columns,)[-2:]:
                del columns[heading]
        if len(known):
            columns["published return"] = lambda row, of=known: _published(of, row["algo"])
            columns["published cost"] = lambda row, of=known: (
                number(of.loc[row["algo"], "cost"], 0) if row["algo"] in of.index else "–"
            )
        heading = "" if only else f"**{suite}**\n\n"
        parts.append(heading + grey(rows, columns))
    return "\n\n".join(parts)


def percent(share: float) -> str:
    """A share in percent; a dash where there is none, as for a limit on the worst step."""
    return "–" if pd.isna(share) else f"{100 * share:.0f}\xa0%"


def deviation(row: Any, name: str, digits: int) -> str:
    """A mean over seeds ± their standard deviation; of a single one the number alone."""
    return spread(row[name], row[f"{name}_std"], digits)


def grey(rows: pd.DataFrame, columns: dict[str, Any]) -> str:
    """A table in Markdown whose rows of a single seed are in italics."""
    texts = spelled(rows, columns).map(escaped)
    lines = [
        [f"*{cell}*" if seeds == 1 and cell else cell for cell in line]
        for line, seeds in zip(texts.to_numpy().tolist(), rows["seeds"], strict=True)
    ]
    return table(list(columns), lines)


def learnt(name: str) -> str:
    """Returns of one seed, a row for each robot and a column for each task; bold: learnt."""
    untrained = pd.read_csv(DATA / "untrained.csv", index_col="suite")
    untrained.index = untrained.index.str.removesuffix("-v0")
    rows = runs(name).set_index("suite").join(untrained)
    error = (rows["trained_se"] ** 2 + rows["random_se"] ** 2) ** 0.5
    apart = (rows["trained"] - rows[["random", "zero"]].max(axis=1)) / error
    cells = rows["trained"].map(lambda mean: number(mean, 2))
    cells += apart.map(lambda errors: f" ({number(errors, 1)})")
    cells = cells.where(apart < APART, "**" + cells + "**")
    names = [suite.split("_")[:2] for suite in untrained.index if suite in rows.index]
    tasks, robots = ([*dict.fromkeys(of)] for of in zip(*names, strict=True))
    lines = [[robot, *(cells[f"{task}_{robot}_8Hazards"] for task in tasks)] for robot in robots]
    return table(["robot", *tasks], lines)


def scores(name: str) -> str:
    """A table of the algorithms' returns and costs as parts of TRPO's, a column per suite."""
    found = runs(name)
    means = aggregate(found.assign(J_r=found["return_last"], M_c=found["cost_last"]))
    rows = normalize(means).set_index(["suite", "label"])
    labels = pd.DataFrame({"label": means["label"].unique()})

    def cell(row: Any, suite: str) -> str:
        if (suite, row["label"]) not in rows.index:
            return "–"
        of = rows.loc[(suite, row["label"])]
        return f"{number(of['reward'])}; {number(of['cost'])}"

    suites = {suite: lambda row, of=suite: cell(row, of) for suite in means["suite"].unique()}
    return markdown(spelled(labels, {"algorithm": "label", **suites}))


def sweep(name: str, suite: str) -> str:
    """A table of return and cost at each limit that a suite was run with, over all seeds."""
    found = {}
    for path in DATA.glob(f"{name}_limit*.tar.xz"):
        archive = path.name.removesuffix(".tar.xz")
        rows = aggregate(runs(archive)).set_index("label")
        found[int(archive.rpartition("_limit")[2])] = rows[rows["suite"] == suite]
    limits = sorted(found)
    common = set.intersection(*(set(rows.index) for rows in found.values()))
    shared = [label for label in found[limits[0]].index if label in common]
    rows = pd.DataFrame({"limit": limits})

    def cell(row: Any, label: str, name: str) -> str:
        return deviation(found[row["limit"]].loc[label], name, 1)

    columns = {
        f"{label}, {what}": lambda row, label=label, name=name: cell(row, label, name)
        for label in shared
        for what, name in (("return", "return_last"), ("cost", "cost_last"))
    }
    return markdown(spelled(rows, {"limit": whole("limit"), **columns}))


def splits(name: str) -> str:
    """A table of how the agents of a grid keep their limit, a row for each split."""
    with unpacked(name) as found:
        rows = judge(select(found.runs))
    highest = rows["return"].abs().max()
    digits = 0 if highest >= 100 else 1
    columns: dict[str, Any] = {
        "algorithm": "label",
        "episodes": lambda row: SPLITS[row["split"]],
        "seeds": whole("seeds"),
        "return": lambda row: spread(row["return"], row["return_std"], digits),
        "cost": lambda row: spread(row["cost"], row["cost_std"], 1),
        "95 % interval of the cost": lambda row: f"[{row['low']:.1f}, {row['high']:.1f}]",
        "verdict": "verdict",
        "episodes above the limit": lambda row: percent(row["above"]),
        "D⁺": lambda row: number(row["excess"], 2),
    }
    if rows["suite"].nunique() > 1:
        columns = {"environment": "suite", **columns}
    return grey(rows, columns)


@cache
def certified(name: str) -> pd.DataFrame:
    """A row per environment and algorithm: how many of its runs deliver, and what, in the mean."""
    rows = []
    with unpacked(name) as found:
        for (suite, algo), group in found.runs.groupby(["suite", "algo"], sort=False):
            results = [RunFolder(Path(path)).checked_result() for path in group["path"]]
            given = [one["delivered"] for one in results if one["delivered"]]
            means = pd.DataFrame(
                [{"return": one["return"], **next(iter(one["costs"].values()))} for one in given],
                columns=["return", "mean", "upper", "share_above"],
            ).mean()
            row = {"suite": suite, "algo": algo, "label": group["label"].iloc[0], **means}
            row["delivered"] = f"{len(given)} of {len(results)}"
            row["sampled"] = sum(not one.get("deterministic", True) for one in given)
            for kind in ("stochastic", "greedy"):
                final = pd.DataFrame([one["final"][kind] for one in results])
                row[kind] = tuple(final[key].map(np.mean).mean() for key in ("returns", "costs"))
            rows.append(row)
    return pd.DataFrame(rows)


def delivered(name: str) -> str:
    """A table of the certified agents that runs end with, beside their final policies."""
    rows = []
    for row in certified(name).to_dict("records"):
        digits = _digits(row["stochastic"][0])
        given = row["delivered"] + (f", {row['sampled']} sampled" if row["sampled"] else "")
        cells = [row["suite"], row["label"], given, number(row["return"], digits)]
        cells += [number(row["mean"], 1), number(row["upper"], 1), percent(row["share_above"])]
        for kind in ("stochastic", "greedy"):
            cells.append(f"{number(row[kind][0], digits)} / {number(row[kind][1], 1)}")
        rows.append(cells)
    header = ["environment", "algorithm", "delivered", "return", "cost", "bound", "above the limit",
              "final, sampled", "final, most likely"]  # fmt: skip
    return table(header, rows)


def _digits(value: float) -> int:
    """Decimals of a return."""
    return 0 if abs(value) >= 100 else 1


def best(name: str) -> str:
    """
    A row per environment: the highest return of an agent within the limit.

    Of the runs of a grid what was certified counts, if half of them deliver, of the leaderboard's
    rows with today's settings the final policy with sampled actions; both need three seeds. Where
    nothing is within the limit, an undecided one stands there, else the lowest cost. Minutes are
    the median over seeds.
    """
    board, runs = pd.read_csv(DATA / "leaderboard.csv"), pd.read_csv(ROWS)
    took = (runs["seconds"] / 60).groupby(runs["row"].str.rsplit("_", n=1).str[0]).median()
    board = board[board["settings"].isna()].copy()
    few = (board["verdict"] == "kept") & (board["seeds"] < SEEDS)
    board["verdict"] = board["verdict"].mask(few, "undecided")
    board["minutes"] = board["row"].str.rsplit("_", n=1).str[0].map(took)
    found = certified(name).rename(columns={"suite": "environment", "mean": "cost"})
    found = found.assign(verdict="certified", million_steps=1, seeds=found["delivered"])
    counts = [map(int, text.split(" of ")) for text in found["delivered"]]
    half = [2 * some >= all_ >= SEEDS for some, all_ in counts]
    found = found[half].merge(
        board.loc[board["million_steps"] == 1, ["environment", "algo", "minutes"]], how="left"
    )
    rows = pd.concat([board, found])
    rank = rows["verdict"].map({"undecided": 1, "exceeded": 0}).fillna(2)
    rows = rows.assign(rank=rank, worth=rows["return"].where(rank > 0, -rows["cost"]))
    rows = rows.sort_values(["rank", "worth"], ascending=False).drop_duplicates("environment")
    rows = rows.set_index("environment").loc[board["environment"].unique()].reset_index()
    rows["limit"] = np.where(rows["environment"].str.startswith("Safety"), 25, 2)
    columns = {
        "environment": "environment",
        "limit": whole("limit"),
        "algorithm": lambda row: f"`{row['algo']}`",
        "return": lambda row: number(row["return"], _digits(row["return"])),
        "cost": lambda row: number(row["cost"], 1),
        "verdict": "verdict",
        "seeds": lambda row: str(row["seeds"]),
        "steps": lambda row: f"{row['million_steps']}e6",
        "minutes": lambda row: number(row["minutes"], 0),
    }
    texts = spelled(rows, columns)
    return table([*texts], texts.to_numpy().tolist())


def _published(known: pd.DataFrame, algo: str) -> str:
    if algo not in known.index:
        return "–"
    row = known.loc[algo]
    digits = 2 if abs(row["return"]) < 1 else 1 if abs(row["return"]) < 100 else 0
    return spread(row["return"], row["return_std"], digits)


def filled(page: str) -> str:
    """A page with its tables remade."""

    def remade(match: re.Match[str]) -> str:
        begin, kind, name, only, end = match.groups()
        made = {
            "learnt": learnt, "scores": scores, "splits": splits, "delivered": delivered,
            "best": best, "agents": lambda _: listed(),
        }  # fmt: skip
        if kind == "sweep":
            text = sweep(name, only)
        else:
            text = made[kind](name) if kind in made else tables(name, only)
        return f"{begin}\n{text}\n\n{end}"

    return BLOCK.sub(remade, page)


def pages() -> dict[Path, str]:
    """Every page that has such a table, as it should be."""
    files = [
        DOCS.parent / "README.md",
        *sorted(DOCS.glob("*.md")),
        *sorted(DOCS.parent.glob("lab/*.md")),
    ]
    texts = {path: path.read_text() for path in files}
    return {path: filled(text) for path, text in texts.items() if BLOCK.search(text)}


def draw_healthy(algo: str) -> Figure:
    """A good and a bad run: return, J_C beside its limit, and what is to keep the limit."""
    rows, columns = (2, 2) if algo == "pcpo" else (1, 3)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 0.7 + 2.1 * rows), layout="constrained")
        axes = figure.subplots(rows, columns).ravel()
        for (name, limit, archive, folder), color in zip(
            HEALTHY[algo], (COLORS[2], COLORS[1]), strict=True
        ):
            with tarfile.open(DATA / f"{archive}.tar.xz") as packed:
                file = packed.extractfile(f"{folder}/progress.csv")
                assert file is not None
                log = pd.read_csv(file, index_col="time/total_timesteps")
            log.columns = log.columns.str.rpartition("/").get_level_values(-1)
            means = log.rolling(10, min_periods=3).mean()
            lines = {"return": log["ep_rew_mean"]}
            lines["episode cost"] = means["constraint_violation"] + limit
            if algo == "pcpo":
                lines["margin below the limit"] = log["cost_margin"]
                lines["change by an update"] = means["cost_change"]
                axes[3].plot(
                    means["cost_change_promised"], color=color, linestyle=(0, (5, 1.5)),
                    label=f"{name}, predicted",
                )  # fmt: skip
            else:
                # Older logs call the weight "price". In the paper's units λ itself is the weight.
                column = next(c for c in ("cost_weight", "price", "multiplier") if c in log)
                lines["weight of the cost"] = log[column]
            for axis, (label, line) in zip(axes, lines.items(), strict=True):
                axis.plot(line, color=color, linewidth=1.5, label=name)
                axis.set(xlabel="steps", ylabel=label, xlim=(0, line.index[-1]))
                axis.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes[1].axhline(limit, color=INK, linestyle=(0, (1, 2)), label=f"limit, {limit:g}")
        for axis in axes[1:3]:
            axis.set_ylim(bottom=0)
        finish(figure)
    return figure


def draw_curves(runs: pd.DataFrame, name: str) -> None:
    """Save the curves of runs of a suite as an image."""
    (figure,) = draw("curves", Data(runs)).values()
    save(figure, DOCS / "images" / f"{name}.png")
    print(name)


def curves() -> None:
    """Draw all of them."""
    left = {page.stem for page in DOCS.glob("algorithms/*.md")}
    for names, suite, reference in GRIDS:
        with unpacked(*names) as found:
            runs = found.runs[found.runs["suite"] == suite]
            for algo in sorted(left & {*runs["algo"]}):
                draw_curves(runs[runs["algo"].isin([algo, reference])], f"curve_{algo}")
                left.remove(algo)
    print("without logs:", *sorted(left))
    for name, suites in PAPER.items():
        with unpacked(name) as found:
            for suite in suites:
                draw_curves(found.runs[found.runs["suite"] == suite], f"curves_{suite}")
    for algo in HEALTHY:
        save(draw_healthy(algo), DOCS / "images" / f"healthy_{algo}.png")


def figures(text: str) -> Iterator[tuple[str, Figure]]:
    """The figures of packed grids that a page names, with their files' names."""
    images = IMAGE.findall(text)
    for name, kind in sorted({(name, kind) for _, name, kind in images}):
        with logs(name) as rows:
            runs = last(rows)
            # Drawn is what the tables have: the last ten epochs, not the last one.
            means = {"J_r": runs["return_last"], "M_c": runs["cost_last"]}
            drawings = draw(kind, Data(runs.assign(**means)))
        for drawn, figure in drawings.items():
            if (file := f"{name}_{drawn}.png", name, kind) in images:
                yield file, figure


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pack", nargs=2, metavar=("FOLDER", "NAME"), help="pack a folder's logs")
    parser.add_argument("--curves", action="store_true", help="draw the learning curves instead")
    args = parser.parse_args()
    if args.curves:
        return curves()
    if args.pack:
        pack(Path(args.pack[0]), args.pack[1])
    for path, text in pages().items():
        path.write_text(text)
        print(path)
        for file, figure in figures(text):
            save(figure, DOCS / "images" / file)


if __name__ == "__main__":
    main()

"""Write the tables of results into the pages, from the logs: ``python scripts/make_tables.py``.

``docs/data/NAME.tar.xz`` holds the logs of a grid of runs, as ``benchmark`` writes them, without
models; ``docs/data/NAME.yml`` is the grid. Between ``<!-- runs: NAME -->`` and ``<!-- end -->`` of
a page stands what this makes of them, or of one suite in short, ``<!-- runs: NAME SUITE -->``.
Instead of ``runs`` there are ``learnt: NAME``, what the agents earned in the end beside the
untrained ones of ``docs/data/untrained.csv``, ``scores: NAME``, returns and costs as parts of
TRPO's, ``sweep: NAME SUITE``, what was earned and paid at each limit N of ``NAME_limitN.tar.xz``,
and, within a line, ``beside: NAME SUITE ALGO``, what an algorithm earned and paid. ``--pack FOLDER
NAME`` packs the logs of a folder.
"""

import argparse
import re
import tarfile
import tempfile
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_guard.zoo.figures import Data, save
from sb3_guard.zoo.paper import draw
from sb3_guard.zoo.runs import read_episodes, read_results
from sb3_guard.zoo.statistics import aggregate, normalize, with_safety
from sb3_guard.zoo.tables import markdown, number, spelled, spread, whole

DOCS = Path(__file__).parents[1] / "docs"
DATA = DOCS / "data"
BLOCK = re.compile(
    r"(<!-- (runs|learnt|scores|sweep|beside): (\S+)(?: (\S+))?(?: (\S+))? -->\n?).*?"
    r"(<!-- end -->)",
    re.DOTALL,
)
PUBLISHED_STEPS = 1_000_000
LAST = 90  # episodes: three rollouts of 30 environments
APART = 3.0  # standard errors: what counts as learnt
LOGS = ("progress.csv", "0.monitor.csv", "result.json", "args.yml", "config.yml")


@cache
def runs(name: str) -> pd.DataFrame:
    """The runs of a packed grid, with what is asked about their safety."""
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(DATA / f"{name}.tar.xz") as archive:
            archive.extractall(folder, filter="data")
        found = read_results([folder])
        assert not found.left_out, found.left_out
        ends = [read_episodes(path).tail(LAST) for path in found.runs["path"]]
        for path, steps in zip(found.runs["path"], found.runs["steps"], strict=True):
            log = pd.read_csv(Path(path, "progress.csv"))["time/total_timesteps"]
            # A callback that ends a run leaves the last rollout without a line.
            assert log.iloc[-1] + log.iloc[0] >= steps, f"{path}: logs of {log.iloc[-1]:,} steps"
        returns = pd.DataFrame([end["J_r"] for end in ends]).T
        means = {"trained": [*returns.mean()], "trained_se": [*returns.sem()]}
        return with_safety(found.runs).assign(**means)


def tables(name: str, only: str | None) -> str:
    """A table for each suite of a grid, with the published values where there are some."""
    found = runs(name)
    means = aggregate(found)
    speeds = (found["steps"] / found["seconds"]).groupby([found["suite"], found["algo"]]).max()
    published = pd.read_csv(DATA / "published.csv", index_col=["suite", "algo"])
    parts = []
    for suite, rows in means.groupby("suite", sort=False):
        if only not in (None, suite):
            continue
        compared = suite in published.index and (rows["steps"] == PUBLISHED_STEPS).all()
        known = published.loc[suite] if compared else published.iloc[:0]
        digits = 2 if rows["return_last"].abs().max() < 100 else 0
        columns: dict[str, Any] = {
            "algorithm": "label",
            "seeds": whole("seeds"),
            "return": lambda row, n=digits: spread(row["return_last"], row["return_last_se"], n),
            "episode cost": lambda row: spread(row["cost_last"], row["cost_last_se"], 1),
            "episodes above the limit": lambda row: number(100 * row["above_limit"], 0) + "\xa0%",
            "95 % of costs below": lambda row: number(row["cost_p95"], 0),
            "cost of training": whole("cost_total"),
            "steps/s": lambda row, of=speeds[suite]: number(of[row["algo"]], 0),
        }
        if only:
            for heading in ("seeds", "95 % of costs below", "cost of training", "steps/s"):
                del columns[heading]
        if len(known):
            columns["published return"] = lambda row, of=known: _published(of, row["algo"])
            columns["published cost"] = lambda row, of=known: (
                number(of.loc[row["algo"], "cost"], 0) if row["algo"] in of.index else "–"
            )
        heading = "" if only else f"**{suite}**\n\n"
        parts.append(heading + markdown(spelled(rows, columns)))
    return "\n\n".join(parts)


def learnt(name: str) -> str:
    """A table of what was learnt on each suite, by one seed, beside random and zero actions."""
    untrained = pd.read_csv(DATA / "untrained.csv", index_col="suite")
    untrained.index = untrained.index.str.removesuffix("-v0")
    rows = runs(name).set_index("suite").join(untrained)
    rows = rows.loc[[suite for suite in untrained.index if suite in rows.index]].reset_index()
    error = (rows["trained_se"] ** 2 + rows["random_se"] ** 2) ** 0.5
    columns: dict[str, Any] = {
        "suite": "suite",
        "random": lambda row: spread(row["random"], row["random_se"]),
        "zero": lambda row: spread(row["zero"], row["zero_se"]),
        "trained": lambda row: spread(row["trained"], row["trained_se"]),
        "apart": lambda row: number(row["apart"], 1),
        "learnt": lambda row: "yes" if row["apart"] >= APART else "no",
        "episode cost": lambda row: number(row["cost_last"], 1),
    }
    rows["apart"] = (rows["trained"] - rows[["random", "zero"]].max(axis=1)) / error
    return markdown(spelled(rows, columns))


def scores(name: str) -> str:
    """A table of the algorithms' returns and costs as parts of TRPO's, a column per suite."""
    found = runs(name)
    means = aggregate(found.assign(J_r=found["return_last"], M_c=found["cost_last"]))
    rows = normalize(means, means).set_index(["suite", "label"])
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

    def cell(row: Any, label: str) -> str:
        of = found[row["limit"]].loc[label]
        earned = spread(of["return_last"], of["return_last_se"], 1)
        return f"{earned} at {spread(of['cost_last'], of['cost_last_se'], 1)}"

    columns = {label: lambda row, label=label: cell(row, label) for label in shared}
    return markdown(spelled(rows, {"limit": whole("limit"), **columns}))


def beside(name: str, suite: str, algo: str) -> str:
    """An algorithm's return and cost on a suite of a grid, beside the published ones."""
    rows = aggregate(runs(name)).set_index(["suite", "algo"])
    known = pd.read_csv(DATA / "published.csv", index_col=["suite", "algo"])
    ours, theirs = rows.loc[(suite, algo)], known.loc[(suite, algo)]
    return (
        f"{ours['return_last']:.1f} at a cost of {ours['cost_last']:.0f}, published "
        f"{theirs['return']:.1f} at {theirs['cost']:.0f}"
    )


def _published(known: pd.DataFrame, algo: str) -> str:
    if algo not in known.index:
        return "–"
    row = known.loc[algo]
    digits = 2 if abs(row["return"]) < 1 else 1 if abs(row["return"]) < 100 else 0
    return spread(row["return"], row["return_std"], digits)


def filled(page: str) -> str:
    """A page with its tables remade."""

    def table(match: re.Match[str]) -> str:
        begin, kind, name, only, algo, end = match.groups()
        if kind == "beside":
            return f"{begin}{beside(name, only, algo)}{end}"
        made = {"learnt": learnt, "scores": scores}
        if kind == "sweep":
            text = sweep(name, only)
        else:
            text = made[kind](name) if kind in made else tables(name, only)
        return f"{begin}\n{text}\n\n{end}"

    return BLOCK.sub(table, page)


def pages() -> dict[Path, str]:
    """Every page that has such a table, as it should be."""
    files = [DOCS.parent / "README.md", *sorted(DOCS.glob("*.md"))]
    texts = {path: path.read_text() for path in files}
    return {path: filled(text) for path, text in texts.items() if BLOCK.search(text)}


def pack(folder: Path, name: str) -> None:
    """Pack the logs of finished runs, the same bytes for the same logs wherever they were."""
    done = sorted(path.parent for path in folder.rglob("result.json"))
    with tarfile.open(DATA / f"{name}.tar.xz", "w:xz", preset=9) as archive:
        for path in (path for run in done for path in sorted(run.rglob("*"))):
            if path.name not in LOGS:
                continue
            text = path.read_bytes()
            if path.name == "args.yml":
                text = re.sub(rb"(?m)^log_folder: .*", f"log_folder: logs/{name}".encode(), text)
            info = tarfile.TarInfo(str(Path(name) / path.relative_to(folder)))
            info.size = len(text)
            archive.addfile(info, BytesIO(text))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pack", nargs=2, metavar=("FOLDER", "NAME"), help="pack a folder's logs")
    args = parser.parse_args()
    if args.pack:
        pack(Path(args.pack[0]), args.pack[1])
    for path, text in pages().items():
        path.write_text(text)
        print(path)
        for _, kind, name, only, *_ in BLOCK.findall(text):
            if only or kind != "runs":
                continue
            # Drawn is what the tables have: the last ten epochs, not the last one.
            found = runs(name)
            found = found.assign(J_r=found["return_last"], M_c=found["cost_last"])
            for drawing in draw("pareto", Data(found)):
                file = f"{name}_{drawing.name}.png"
                if drawing.figure is not None and file in text:
                    save(drawing.figure, DOCS / "images" / file)


if __name__ == "__main__":
    main()

"""The packed logs of ``docs/data``: grids of runs, as ``benchmark`` writes them, without models.

``NAME.tar.xz`` holds a grid, or ``NAME/ENV.tar.xz`` its runs of an environment.
"""

import json
import re
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from sb3_guard.algorithms import TrustRegion
from sb3_guard.zoo.results.runs import Results, read_results
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.folder import RunFolder
from sb3_guard.zoo.run.hyperparams import read_hyperparams

DOCS = Path(__file__).parents[1] / "docs"
DATA = DOCS / "data"
FRACTION = re.compile(rb"-?\d+\.\d+(?:e[-+]?\d+)?")
LOGS = ("progress.csv", "0.monitor.csv", "result.json", "args.yml", "config.yml")


def archives(name: str) -> list[Path]:
    """The files of a packed grid: one, or one for each environment."""
    return [*DATA.glob(f"{name}.tar.xz"), *sorted(DATA.glob(f"{name}/*.tar.xz"))]


def completed(result: dict[str, Any]) -> dict[str, Any]:
    """A result with what those written before the first release lack: costs by key, final ones."""
    limit = result.get("cost_limit")
    mean = None if "limit_on" in result else result["cost"]  # of several costs the total
    cost = {"mean": mean, "limit": None if isinstance(limit, list) else limit}
    return {**result, "costs": {"cost": cost}, "final": {}, **result}


@contextmanager
def unpacked(*names: str) -> Iterator[Results]:
    """The runs of packed grids, whose logs are there within the block."""
    with tempfile.TemporaryDirectory() as folder:
        for path in (path for name in names for path in archives(name)):
            with tarfile.open(path) as archive:
                archive.extractall(folder, filter="data")
        for file in Path(folder).rglob("result.json"):
            file.write_text(json.dumps(completed(json.loads(file.read_bytes()))))
        yield read_results([folder])


def former(result: dict[str, Any]) -> list[str]:
    """The settings of a run of the grand table that were defaults then and are no more."""
    if "delivered" in result:  # younger than the last change
        return []
    then = ["aim:mean"] if "aim" in read_hyperparams(result["algo"], result["env"]) else []
    if issubclass(algorithm(result["algo"]), TrustRegion):
        then += ["batch_size:None", "n_critic_updates:80"]
    return then


def chosen(runs: pd.DataFrame) -> pd.DataFrame:
    """
    The runs that answer for an algorithm on an environment after so many steps.

    They are those with today's settings, if there are any, and of several grids' those of the grid
    with most seeds.

    :return: the runs with ``budget`` (millions of steps) and ``settings``, the former defaults
    """
    paths = [Path(path) for path in runs["path"]]
    runs = runs.assign(
        settings=[" ".join(former(RunFolder(path).checked_result())) for path in paths],
        budget=(runs["steps"] / 1e6).round().clip(lower=1).astype(int),
    )
    case = [runs[name] for name in ("suite", "algo", "budget")]
    seeds = runs["seed"].groupby([*case, [path.parents[1].name for path in paths]])
    rank = seeds.transform("nunique") + 1000 * (runs["settings"] == "")
    return runs[rank == rank.groupby(case).transform("max")]


def pack(folder: Path, name: str, by_environment: bool = False) -> None:
    """
    Pack the logs of finished runs, the same bytes for the same logs wherever they were.

    Logs keep four significant digits of fractions: a run takes a third of the room.

    :param by_environment: an archive for each, so that new runs change few of them; as before if
        there are such
    """
    by_environment = by_environment or (DATA / name).is_dir()
    done: dict[Path, list[Path]] = {}
    for run in sorted(path.parent for path in folder.rglob("result.json")):
        env_id = run.name.rpartition("_")[0]
        file = Path(name, env_id) if by_environment else Path(name)
        done.setdefault(DATA / f"{file}.tar.xz", []).append(run)
    for file, runs in done.items():
        file.parent.mkdir(exist_ok=True)
        if lost := _runs_in(file) - {f"{name}/{run.relative_to(folder)}" for run in runs}:
            raise SystemExit(f"{file} has runs that {folder} lacks: unpack it there; {min(lost)}")
        with tarfile.open(file, "w:xz", preset=9) as archive:
            for path in (path for run in runs for path in sorted(run.rglob("*"))):
                if path.name in LOGS:
                    text = _packed(path, name)
                    info = tarfile.TarInfo(str(Path(name) / path.relative_to(folder)))
                    info.size = len(text)
                    archive.addfile(info, BytesIO(text))


def _runs_in(file: Path) -> set[str]:
    """Run folders in an archive, as they are named there; none if it does not exist yet."""
    if not file.exists():
        return set()
    with tarfile.open(file) as archive:
        return {str(Path(path).parent) for path in archive.getnames() if path.endswith(".json")}


def with_log_folder(path: Path, folder: str) -> bytes:
    """The flags of a run, ``args.yml``, with another log folder than that of this machine."""
    flags = yaml.safe_load(path.read_text(encoding="utf-8"))
    return yaml.safe_dump({**flags, "log_folder": folder}).encode()


def _packed(path: Path, name: str) -> bytes:
    """A log as an archive has it."""
    text = path.read_bytes()
    if path.suffix == ".csv":
        text = FRACTION.sub(lambda digits: b"%.4g" % float(digits[0]), text)
    if path.name == "args.yml":
        text = with_log_folder(path, f"logs/{name}")
    return text

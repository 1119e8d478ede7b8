"""Train the grand table, grid by grid: ``python scripts/grand_table.py logs/grand --jobs 2``.

The grids are ``docs/data/grand_table*.yml``, in the order of ``GRIDS``. The Python that runs this
may have the package from a wheel: the checkout's own code is not imported. Stopped and called
again, it continues where it was. ``--pack`` packs the logs of the runs that are finished into
``docs/data`` and trains nothing.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from archives import DATA, pack

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


def train(grid: str, folder: Path, jobs: int) -> None:
    """
    Carry out what is not done of a grid.

    :raises SystemExit: it was interrupted, or can't be carried out
    """
    flags = ["--grid", str(DATA / f"{grid}.yml"), "-f", str(folder), "--jobs", str(jobs)]
    # -P: not from the folder that this is called in, which may be a checkout.
    status = subprocess.run([sys.executable, "-P", "-m", "sb3_guard.benchmark", *flags]).returncode
    if status not in (0, 1):  # 1: some runs have failed
        raise SystemExit(status)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="where the runs are")
    parser.add_argument("--jobs", type=int, default=2, help="runs at once (default: 2)")
    parser.add_argument("--pack", action="store_true", help="pack what is finished instead")
    args = parser.parse_args()
    if args.pack:
        for name in dict.fromkeys(name for _, name in GRIDS):
            if any((args.folder / name).rglob("result.json")):
                pack(args.folder / name, name, by_environment=True)
                print(DATA / name)
        return
    for grid, name in GRIDS:
        train(grid, args.folder / name, args.jobs)


if __name__ == "__main__":
    main()

"""
Kill a run or a grid at random moments, again and again, and compare it with an undisturbed one.

    python scripts/kill_campaign.py train --kills 10
    python scripts/kill_campaign.py grid --kills 30 -- --algos cpo trpo_lag --jobs 2

``kill -9`` hits the main process or one of its workers: half of the time soon after the start, else
after some episodes. The command is then given again until it ends by itself. What follows ``--`` is
added to the flags of the command. The exit status is 0 if both folders hold the same results.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import pandas as pd
import psutil

RUN = (
    "-n 40000 -params n_envs:4 n_steps:500 --eval-freq -1 --checkpoint-every 0 --device cpu "
    "--num-threads 1"
).split()
FLAGS = {
    "train": ["--algo", "cpo", "--env", "Goal_Point_8Hazards", "--seed", "3", *RUN],
    "grid": ["--suites", "Goal_Point_8Hazards", "--algos", "cpo", "trpo", "--seeds", "0", *RUN],
}
MODULES = {"train": "sb3_guard.train", "grid": "sb3_guard.benchmark"}
CLOCKS = {"t", "time/fps", "time/time_elapsed"}
NOT_COMPARED = {"seconds", "learned", "commit"}


class Campaign:
    """
    One command that is killed until it has survived enough.

    :param what: ``train`` or ``grid``
    :param flags: of the command
    :param folder: its log folder
    :param rng: when to kill, and whom
    """

    def __init__(self, what: str, flags: list[str], folder: Path, rng: random.Random):
        self.what, self.folder, self.rng = what, folder, rng
        self.flags = [*FLAGS[what], *flags]
        self.kills = {"main": 0, "worker": 0}

    def start(self) -> psutil.Popen:
        """Give the command, or give it again."""
        begun = [path.parent for path in self.folder.glob("*/*/checkpoint.zip")]
        flags = [*self.flags, "-f", str(self.folder)]
        if self.what == "train" and begun:  # a single run is continued, not begun again
            flags = ["-i", str(begun[0])]
            if "--gym-packages" in self.flags:
                named = self.flags.index("--gym-packages")
                flags += self.flags[named : named + 2]
        elif self.what == "train":
            shutil.rmtree(self.folder, ignore_errors=True)
        return psutil.Popen(
            [sys.executable, "-m", MODULES[self.what], *flags],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def episodes(self) -> int:
        """How many lines all monitor files have."""
        files = self.folder.glob("*/*/0.monitor.csv")
        return sum(file.read_bytes().count(b"\n") for file in files)

    def wait(self, process: psutil.Popen, whom: str, patience: float) -> bool:
        """Wait for the moment of the next kill; False if the command has done its work before."""
        end = time.monotonic() + self.rng.uniform(0.5, patience)
        goal = self.episodes() + self.rng.randint(1, 20) if self.rng.random() < 0.5 else None
        while process.poll() is None:
            if whom == "worker" and self.what == "grid" and not workers(process):
                end = time.monotonic() + 0.5
            elif self.episodes() >= goal if goal is not None else time.monotonic() > end:
                return True
            time.sleep(0.05)
        return process.returncode != 0

    def kill(self, process: psutil.Popen, whom: str) -> None:
        """Kill the main process or a worker; without the main one, all workers must end, too."""
        children = workers(process)
        if children and whom == "worker":
            self.kills["worker"] += 1
            os.kill(self.rng.choice(children).pid, signal.SIGKILL)
            return
        self.kills["main"] += 1
        process.kill()
        process.wait()
        _, alive = psutil.wait_procs(children, timeout=30)
        if alive:
            raise SystemExit(f"{alive} outlived the command")

    def run(self, kills: Sequence[str] = (), patience: float = 15.0) -> None:
        """
        Kill these, ``main`` or ``worker``, then let the command end.

        Runs that were killed too often make it fail; it may do so a few times.
        """
        process = self.start()
        for whom in kills:
            if not self.wait(process, whom, patience):
                break
            with suppress(ProcessLookupError, psutil.NoSuchProcess):  # ended meanwhile
                self.kill(process, whom)
            if process.poll() is not None:
                process = self.start()
        for _ in range(5):
            if process.wait() == 0:
                return
            process = self.start()
        process.kill()
        raise SystemExit("the command does not come to its end")


def workers(process: psutil.Popen) -> list[psutil.Process]:
    """The processes that a command has started, except for multiprocessing's own."""
    found = []
    for one in process.children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # ended meanwhile
            if "resource_tracker" not in " ".join(one.cmdline()):
                found.append(one)
    return found


def outcome(run: Path) -> tuple[dict[str, object], list[pd.DataFrame]]:
    """All that a run computed: its result, episodes and log, clocks left out."""
    result = json.loads((run / "result.json").read_text())
    tables = [pd.read_csv(run / "0.monitor.csv", skiprows=1), pd.read_csv(run / "progress.csv")]
    return (
        {name: value for name, value in result.items() if name not in NOT_COMPARED},
        [table[sorted({*table} - CLOCKS)] for table in tables],
    )


def differences(one: Path, other: Path) -> list[str]:
    """In which runs two log folders differ, to the last bit."""
    runs = [{run.parent.relative_to(f) for run in f.rglob("result.json")} for f in (one, other)]
    found = [f"{run} is in one folder only" for run in sorted(runs[0] ^ runs[1])]
    for run in sorted(runs[0] & runs[1]):
        (result, tables), (result2, tables2) = outcome(one / run), outcome(other / run)
        if result != result2:
            found.append(f"{run}: {result} is not {result2}")
        if not all(a.equals(b) for a, b in zip(tables, tables2, strict=True)):
            found.append(f"{run}: episodes or log differ")
    return found if runs[0] else ["there are no results"]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=FLAGS)
    parser.add_argument("--kills", type=int, default=10, metavar="N", help="default: 10")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default: 0)")
    parser.add_argument("--folder", type=Path, help="for both log folders (default: temporary)")
    cut = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    args, flags = parser.parse_args(sys.argv[1:cut]), sys.argv[cut + 1 :]
    folder = args.folder or Path(tempfile.mkdtemp(prefix="kill_campaign_"))
    rng = random.Random(args.seed)
    killed = Campaign(args.what, flags, folder / "killed", rng)
    began = time.monotonic()
    killed.run(rng.choices(["main", "worker"], k=args.kills))
    print(f"killed: {killed.kills}, {time.monotonic() - began:.0f} s", flush=True)
    undisturbed = Campaign(args.what, flags, folder / "undisturbed", rng)
    undisturbed.run()
    found = differences(folder / "undisturbed", folder / "killed")
    print("\n".join(found) or f"equal to an undisturbed {args.what}: {folder}")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())

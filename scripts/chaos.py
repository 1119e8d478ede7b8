"""Kill a run, a grid or a tuner at random moments, again and again: is anything lost?

    python scripts/chaos.py train --kills 10
    python scripts/chaos.py grid --kills 30 -- --algos cpo trpo_lag --jobs 2
    python scripts/chaos.py tune --kills 60 --trials 40 --storage postgresql

``kill -9`` hits the main process of a run or grid or one of its workers: half of the time soon
after the start, else after some episodes. The command is given again until it ends by itself. Then
it must have the bits of an undisturbed one. What follows ``--`` is added to its flags.

``tune`` starts three workers on one study, kills one of them every second or so and replaces it; a
PostgreSQL server of its own is stopped, or crashed, and started again in between. Trainings are
stand-ins of a quarter of a second. At the end the study must have the finished trials that were
asked for, and at most one more for each further worker; none was done twice, and each one whose
worker was killed was done again. The exit status is 0 if all that is so.
"""

import argparse
import multiprocessing
import random
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from kills import DONE, Campaign, TrialState, campaign, differences, faults
from postgres import running


def repeat(args: argparse.Namespace, flags: list[str], folder: Path) -> list[str]:
    """Kill a run or a grid; how it differs from an undisturbed one."""
    rng = random.Random(args.seed)
    killed = Campaign(args.command, flags, folder / "killed", rng)
    began = time.monotonic()
    killed.run(rng.choices(["main", "worker"], k=args.kills))
    print(f"killed: {killed.kills}, {time.monotonic() - began:.0f} s", flush=True)
    Campaign(args.command, flags, folder / "undisturbed", rng).run()
    return differences(folder / "undisturbed", folder / "killed")


def search(args: argparse.Namespace, folder: Path) -> list[str]:
    """Kill workers of a study, and its database; its faults."""
    random.seed(args.seed)
    numbers = (args.trials, args.workers, args.kills)
    with ExitStack() as stack:
        server, storage = None, str(folder / "study.journal")
        if args.storage == "postgresql":
            server = stack.enter_context(running())
            storage = server.url
        study = campaign(storage, folder, *numbers, server=server, say=print)
        wrong = faults(study)
        again = len(study.get_trials(deepcopy=False, states=(TrialState.FAIL,)))
        done = len(study.get_trials(deepcopy=False, states=DONE))
    print(f"{done} of {args.trials} trials; workers were killed in {again}")
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=["train", "grid", "tune"])
    parser.add_argument("--kills", type=int, default=10, metavar="N", help="default: 10")
    parser.add_argument("--seed", type=int, default=0, help="of the moments (default: 0)")
    parser.add_argument("--folder", type=Path, help="for log folders (default: temporary)")
    parser.add_argument("--storage", choices=["journal", "postgresql"], default="journal")
    parser.add_argument("--trials", type=int, default=40, help="of tune (default: 40)")
    parser.add_argument("--workers", type=int, default=3, help="of tune (default: 3)")
    cut = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    args, flags = parser.parse_args(sys.argv[1:cut]), sys.argv[cut + 1 :]
    folder = args.folder or Path(tempfile.mkdtemp(prefix="chaos_"))
    wrong = search(args, folder) if args.command == "tune" else repeat(args, flags, folder)
    print("\n".join(wrong) or f"nothing is lost: {folder}")
    return int(bool(wrong))


if __name__ == "__main__":
    multiprocessing.set_forkserver_preload(["sb3_guard.zoo.tuning.search"])
    sys.exit(main())

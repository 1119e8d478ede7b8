"""Train a grid, suites × algorithms × seeds: ``python -m sb3_guard.benchmark --preset main8``."""

import argparse
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_guard import train
from sb3_guard.spelling import did_you_mean
from sb3_guard.zoo.usage import KeyValues, Parser, UsageError, one_line, run

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from sb3_guard.zoo.grid import Run

EXAMPLES = """examples:
  python -m sb3_guard.benchmark --suites Goal_Point_8Hazards --algos cpo trpo_lag -n 1e6 --jobs 2
  python -m sb3_guard.benchmark --preset main8 --scale 0.1 --dry-run
  python -m sb3_guard.benchmark --preset q5 -params cost_limit:25 -f logs/q5
  python -m sb3_guard.benchmark --grid my_grid.yml -f logs/mine
  python -m sb3_guard.benchmark -f logs/mine                     go on with what is not done
  python -m sb3_guard.benchmark --preset paper45 --executor dask --scheduler tcp://node1:8786
"""
FOLDER = "logs/benchmark"
# The file that says what a grid is, in its folder; `--grid` reads such a file.
RECORD = "grid.yml"
DEFAULTS: dict[str, Any] = {
    **train.DEFAULTS,
    "log_folder": FOLDER,
    "suites": None,
    "preset": None,
    "algos": None,
    "seeds": [0, 1],
    "scale": 1.0,
    "dry_run": False,
    "jobs": None,
    "executor": "local",
    "scheduler": None,
}
# Flags that say how and where a grid is carried out, not what it is.
HOW = {"grid", "log_folder", "jobs", "executor", "scheduler", "dry_run", "verbose", "help"}


def parser() -> Parser:
    """The flags; those of ``train`` where they say how each run is trained."""
    result = Parser(
        prog="sb3-guard benchmark",
        description="Train a grid of suites, algorithms and seeds. What is done already is "
        "skipped, what was cut goes on from its checkpoint.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    grid = result.add_argument_group("the grid")
    grid.add_argument("--suites", nargs="+", metavar="ENV", help="environment ids")
    grid.add_argument(
        "--preset",
        metavar="NAME",
        help="one of the paper's grids instead: paper45, main8, q1 … q8, ladder",
    )
    grid.add_argument(
        "--algos",
        nargs="+",
        metavar="ALGO",
        help="algorithms; 'all' is the eight of the paper (default: all, or the preset's)",
    )
    grid.add_argument("--seeds", type=int, nargs="+", metavar="K", help="a run each (default: 0 1)")
    grid.add_argument(
        "--grid", metavar="FILE", help="YAML file with these flags, e.g. 'suites: [a, b]'"
    )
    grid.add_argument(
        "--scale", type=_scale, metavar="X", help="factor of every run's length, e.g. 0.1"
    )
    train.training_flags(result.add_argument_group("how each run is trained"))
    train.evaluation_flags(result)

    files = result.add_argument_group("files")
    files.add_argument(
        "-f", "--log-folder", metavar="DIR", help=f"the grid's folder (default: {FOLDER})"
    )
    train.file_flags(files)

    running = result.add_argument_group("running")
    running.add_argument("--dry-run", action="store_true", help="list the runs and do nothing")
    train.jobs_flag(running)
    running.add_argument(
        "--executor",
        choices=["local", "dask"],
        help="where: this machine, or a Dask cluster that shares the folder (default: local)",
    )
    running.add_argument(
        "--scheduler", metavar="ADDRESS", help="of the Dask cluster, e.g. tcp://node1:8786"
    )
    running.add_argument(
        "--log-interval", type=int, metavar="N", help="log every N rollouts; -2 never (default: 1)"
    )
    running.add_argument(
        "--num-threads", type=int, metavar="N", help="threads of each run (default: 1)"
    )
    running.add_argument("--verbose", type=int, choices=[0, 1], help="0: errors only (default: 1)")
    return result


def _scale(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; it must be a number above 0")
    return value


def read_grid(path: Path) -> list[str]:
    """
    The flags that a grid file stands for.

    :raises UsageError: it can't be read, or has an unknown entry
    """
    import yaml

    from sb3_guard.plain_yaml import load_yaml

    try:
        content = load_yaml(path.read_text())
    except FileNotFoundError:
        raise UsageError(f"there is no grid file {path}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"can't read {path}: {one_line(error)}") from error
    except yaml.YAMLError as error:
        raise UsageError(f"{path} is not valid YAML: {one_line(error)}") from error
    if not isinstance(content, dict):
        raise UsageError(f"{path} must map flags to values, such as 'suites: [Goal_Point_8Ghosts]'")
    actions = {
        action.dest: action for action in parser()._actions if action.dest not in HOW - {"jobs"}
    }
    arguments: list[str] = []
    for name, value in content.items():
        action = actions.get(str(name).replace("-", "_"))
        if action is None:
            raise UsageError(f"{path}: unknown entry {name!r}; {did_you_mean(name, actions)}")
        if value is None or value is False:
            continue
        arguments.append(action.option_strings[-1])
        switch, pairs = action.nargs == 0, isinstance(action, KeyValues)
        if pairs and isinstance(value, dict):
            arguments += [f"{key}:{one!r}" for key, one in value.items()]
        elif action.nargs == "+" and not pairs and isinstance(value, list) and value:
            arguments += [str(one) for one in value]
        elif isinstance(value, dict | list) or (value is True) != switch:
            several = "a mapping" if pairs else "one value or a list of them"
            allowed = several if action.nargs == "+" else "true or false" if switch else "one value"
            raise UsageError(f"{path}: {name}: {value!r} is not allowed; it must be {allowed}")
        elif not switch:
            arguments.append(str(value))
    try:
        parser().parse_args(arguments)
    except UsageError as error:
        raise UsageError(f"{path}: {one_line(error)}") from None
    return arguments


def _pairs(args: dict[str, Any]) -> list[tuple[str, str]]:
    """The environments and algorithms that the flags ask for."""
    from sb3_guard.zoo.presets import ALL, preset

    algos: list[str] | None = None
    if args["algos"] is not None:
        algos = [one for algo in args["algos"] for one in (ALL if algo == "all" else [algo])]
    if args["preset"] is not None:
        if args["suites"] is not None:
            raise UsageError("--preset names suites itself; leave out --suites or --preset")
        return preset(args["preset"], algos)
    if args["suites"] is None:
        raise UsageError(
            "which grid? Give --suites, --preset or --grid, or the folder of a grid to go on "
            f"with: -f FOLDER (there is no {Path(args['log_folder']) / RECORD})"
        )
    return [(suite, algo) for suite in args["suites"] for algo in algos or ALL]


@contextmanager
def executor(args: dict[str, Any], folder: Path) -> Iterator["Executor"]:
    """
    What carries out the runs.

    :param folder: the grid's; its record is there
    :raises UsageError: there is no Dask, no scheduler, or a worker that can't do the work
    """
    if args["executor"] == "local":
        from sb3_guard.zoo.grid import LocalExecutor

        with LocalExecutor(args["jobs"]) as local:
            yield local
        return
    try:
        from distributed import Client
        from distributed.comm import get_address_host_port
    except ImportError:
        raise UsageError(
            "--executor dask needs Dask's scheduler; install it with: pip install distributed"
        ) from None
    from sb3_guard import __version__
    from sb3_guard.zoo.worker import looks

    # What goes wrong is said here, in a line; its own tracebacks would bury that.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)

    address = args["scheduler"]
    try:
        get_address_host_port(address)
        client = Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise UsageError(
            f"no Dask scheduler answers at {address}: {one_line(error)}; "
            "start one with: dask scheduler"
        ) from error
    with client:
        try:
            seen = client.run(looks, folder / RECORD)
        except Exception as error:
            raise UsageError(
                f"a Dask worker can't use sb3_guard: {one_line(error)}; install it there"
            ) from error
        for worker, (version, visible) in seen.items():
            if version != __version__:
                raise UsageError(
                    f"Dask worker {worker} has sb3_guard {version}, this is {__version__}; "
                    "install the same version"
                )
            if not visible:
                raise UsageError(
                    f"Dask worker {worker} does not see the folder {folder}; "
                    "choose one on a disk that all workers share, with -f"
                )
        yield client.get_executor(pure=False)


def _record(folder: Path, given: dict[str, Any]) -> None:
    """
    Write down what was asked for, so that the folder is enough to go on.

    The record of a grid that is not part of this one is kept under another name.
    """
    import yaml

    from sb3_guard.common.files import replacing

    what = {name: value for name, value in given.items() if name not in HOW}
    text = yaml.safe_dump(what, sort_keys=False)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        kept = _keep_record(folder, yaml.safe_load(text))
        with replacing(folder / RECORD) as file:
            file.write(text.encode())
    except OSError as error:
        raise UsageError(
            f"can't write to log folder {str(folder)!r}: {error.strerror}; choose another with -f"
        ) from error

    if kept is not None and given.get("verbose", 1):
        print(
            f"{folder} was another grid's, which is now {kept.name} there; go on with that one "
            f"with: sb3-guard benchmark -f {folder} --grid {kept}"
        )


def _keep_record(folder: Path, new: dict[str, Any]) -> Path | None:
    """Rename the record in a grid's folder, unless a new one has all its runs or it was kept."""
    import yaml

    try:
        text = (folder / RECORD).read_text()
        old = yaml.safe_load(text)
    except (FileNotFoundError, UnicodeDecodeError, yaml.YAMLError):
        return None
    if not isinstance(old, dict) or _contains(new, old):
        return None
    number = 1
    while (kept := folder / f"grid-{number}.yml").exists():
        if kept.read_bytes() == text.encode():
            return None
        number += 1
    (folder / RECORD).rename(kept)
    return kept


def _contains(new: dict[str, Any], old: dict[str, Any]) -> bool:
    """Whether one grid has all the runs of another, as far as their flags tell."""
    lists = ("suites", "algos", "seeds")
    if any(new.get(name) != old.get(name) for name in {*new, *old} - {*lists}):
        return False
    for name in lists:
        mine, its = (grid.get(name, DEFAULTS[name]) or ["all"] for grid in (new, old))
        if "all" not in mine and not {*its} <= {*mine}:
            return False
    return True


def _list(runs: Sequence["Run"]) -> None:
    """Print the runs and how far they are."""
    for one in runs:
        print(f"{one.state:<7} {one.path}  {one.steps:,} steps")
    states = [one.state for one in runs]
    counts = ", ".join(f"{states.count(state)} {state}" for state in ("done", "resume", "new"))
    print(f"{len(runs)} runs ({counts}), {sum(one.steps for one in runs):,} steps in all")


def _flags(argv: Sequence[str] | None) -> tuple[dict[str, Any], dict[str, Any]]:
    """All flags with their defaults, and those given, in a grid file or now; the latter win."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    given = vars(parser().parse_args(arguments))
    record = Path(given.get("log_folder", FOLDER)) / RECORD
    file = Path(given["grid"]) if "grid" in given else record
    if "grid" in given or (not given.keys() & {"suites", "preset"} and file.is_file()):
        given = vars(parser().parse_args([*read_grid(file), *arguments]))
    args = {**DEFAULTS, **given}
    train.check_flags(args)
    if args["executor"] == "dask":
        if args["scheduler"] is None:
            raise UsageError("--executor dask needs --scheduler, e.g. tcp://127.0.0.1:8786")
        if args["jobs"] is not None:
            raise UsageError(
                "--jobs is for --executor local: a Dask worker carries out as many runs at once "
                "as it has threads (dask worker --nthreads N)"
            )
        # Workers have working folders of their own.
        for name in ("log_folder", "tensorboard_log"):
            args[name] = str(Path(args[name]).absolute()) if args[name] else ""
    elif args["scheduler"] is not None:
        raise UsageError("--scheduler goes with --executor dask")
    return args, given


def _benchmark(argv: Sequence[str] | None) -> int:
    args, given = _flags(argv)

    from sb3_guard.zoo.grid import expand, plan, run_grid, try_out

    of_a_run = {name: args[name] for name in train.DEFAULTS}
    runs = expand(_pairs(args), args["seeds"], of_a_run, args["scale"])
    plan(runs)
    if args["dry_run"]:
        _list(runs)
        return 0
    try_out(runs)
    folder = Path(args["log_folder"])
    _record(folder, given)
    how = {name: given[name] for name in ("jobs", "executor", "scheduler") if name in given}
    flags = "".join(f" --{name} {value}" for name, value in how.items())
    go_on = f"go on with: sb3-guard benchmark -f {folder}{flags}"
    with executor(args, folder) as where:
        return run_grid(runs, where, of_a_run, go_on)


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param argv: arguments; None: those of the process
    :return: exit status: 0, 1 if runs failed, 2 for wrong usage, 128 + the signal's number when
        interrupted
    """
    return run(lambda: _benchmark(argv))


if __name__ == "__main__":
    sys.exit(main())

"""Tables and figures of trained runs: ``python -m sb3_guard.plot logs``."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_guard.common.files import replacing
from sb3_guard.zoo.usage import Parser, UsageError, positive, run

if TYPE_CHECKING:
    from sb3_guard.zoo.figures import Data

EXAMPLES = """examples:
  sb3-guard plot logs                                   learning curves, tables on the terminal
  sb3-guard plot logs --figure q3 q4 pareto -o figures --format png pdf
  sb3-guard plot logs --figure all --table results.md results.csv --report report.html
  sb3-guard plot logs more_logs --env Goal_Point_8Hazards --cost-limit 5

figures:
"""


def parser() -> Parser:
    """The flags."""
    from sb3_guard.zoo.figures import FIGURES, FORMATS

    figures = "\n".join(
        f"  {name:<10} {(function.__doc__ or '').strip()}" for name, function in FIGURES.items()
    )
    result = Parser(
        prog="sb3-guard plot",
        description="Make tables, figures and a page of the runs in log folders.",
        epilog=EXAMPLES + figures,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument(
        "folders", nargs="*", default=["logs"], metavar="DIR", help="log folders (default: logs)"
    )
    result.add_argument(
        "--figure",
        nargs="+",
        choices=[*FIGURES, "all"],
        metavar="NAME",
        help="figures to draw, see below; all: all that there are runs for",
    )
    result.add_argument(
        "-o", "--output", default="figures", metavar="DIR", help="for figures (default: figures)"
    )
    result.add_argument(
        "--format", nargs="+", choices=FORMATS, default=["png"], help="of figures (default: png)"
    )
    result.add_argument(
        "--table",
        nargs="+",
        default=[],
        metavar="FILE",
        help="tables to write: .csv and .parquet a row per run, .md and .tex means and scores",
    )
    result.add_argument("--report", metavar="FILE.html", help="one page with everything")
    result.add_argument("--env", nargs="+", metavar="ID", help="only these suites")
    result.add_argument(
        "--cost-limit",
        nargs="+",
        type=float,
        metavar="D",
        help="only runs of this limit (several costs: of these limits), and unconstrained ones",
    )
    result.add_argument(
        "--steps",
        type=positive,
        metavar="N",
        help="where an algorithm has runs of several lengths on a suite, those of N steps",
    )
    return result


def _plot(argv: Sequence[str] | None) -> int:
    args = parser().parse_args(argv)
    from sb3_guard.zoo import results
    from sb3_guard.zoo.figures import FIGURES, Data
    from sb3_guard.zoo.run_folder import require_writable

    files = [Path(name) for name in args.table]
    nothing_asked = not (args.figure or files or args.report)
    for file in files:
        results.check_table(file)
        require_writable(file.parent, "--table")
    if args.report:
        if Path(args.report).suffix not in (".html", ".htm"):
            raise UsageError(f"--report {args.report!r} is not an .html file; name it so")
        require_writable(Path(args.report).parent, "--report")
    if args.figure or nothing_asked:
        require_writable(Path(args.output), "-o")
    found = results.read_results(args.folders)
    for path, why in found.left_out.items():
        print(f"left out: {path}: {why}", file=sys.stderr)
    if not len(found.runs):
        raise UsageError(f"there is no finished run below {', '.join(args.folders)}")
    kinds = args.figure or []
    if "all" in kinds:
        kinds = list(FIGURES)
    elif nothing_asked:
        kinds = ["curves"]

    chosen = results.choose(found.runs, args.env, args.cost_limit, args.steps)
    per_run = [file for file in files if file.suffix in (".csv", ".parquet")]
    for file in per_run:
        results.write_table(file, chosen)
        print(f"wrote {file}")
    if len(per_run) == len(files) and not kinds and not args.report:
        return 0
    runs = results.select(chosen)
    notes = results.notices(chosen, runs)
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    for file in files:
        if file not in per_run:
            results.write_table(file, runs, notes)
            print(f"wrote {file}")
    data = Data(runs)
    status = _draw(data, kinds, args, all_of_them="all" in (args.figure or []))
    if args.report:
        from sb3_guard.zoo.report import report

        title = f"Safe reinforcement learning: {', '.join(args.folders)}"
        _write(Path(args.report), report(data, title, found.left_out, notes))
    for why in data.unread.values():
        print(f"left out of the curves: {why}", file=sys.stderr)
    if nothing_asked:
        print()
        readable = runs[~runs["path"].isin(list(data.unread))]
        print(results.markdown(results.learning(readable)), end="\n\n")
        for title, table in results.tables(runs).items():
            print(f"{title}\n\n{results.markdown(table)}\n")
    return status


def _draw(data: "Data", kinds: Sequence[str], args: argparse.Namespace, all_of_them: bool) -> int:
    """Draw figures; 1 if one that was asked for by name could not be drawn."""
    from sb3_guard.zoo.figures import draw, save

    status = 0
    for kind in kinds:
        for drawing in draw(kind, data):
            if drawing.figure is None:
                print(f"{drawing.name} is not drawn; missing: {drawing.missing}", file=sys.stderr)
                status = status if all_of_them else 1
                continue
            for form in dict.fromkeys(args.format):
                path = Path(args.output) / f"{drawing.name}.{form}"
                save(drawing.figure, path)
                print(f"wrote {path}")
            if drawing.missing:
                print(f"{drawing.name}: missing: {drawing.missing}", file=sys.stderr)
    return status


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(text.encode())
    except OSError as error:
        raise UsageError(
            f"can't write to {str(path)!r}: {error.strerror}; choose another file"
        ) from error
    print(f"wrote {path}")


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param argv: arguments; None: those of the process
    :return: exit status: 0, 1 if a figure lacks all its runs, or 2 for wrong usage
    """
    return run(lambda: _plot(argv))


if __name__ == "__main__":
    sys.exit(main())

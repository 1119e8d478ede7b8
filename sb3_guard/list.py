"""What there is: ``sb3-guard list`` prints suites, robots, tasks and constraints."""

import argparse
import sys
from collections.abc import Sequence

from sb3_guard.envs import Scenario, env_ids
from sb3_guard.envs.registry import CONSTRAINTS, LADDER, ROBOTS, TASKS
from sb3_guard.spelling import did_you_mean
from sb3_guard.zoo.tables import table
from sb3_guard.zoo.usage import Parser, UsageError, import_packages, run

EXAMPLES = """examples:
  sb3-guard list
  sb3-guard list robots
  sb3-guard list --ladder Goal_Point Hazards
"""


def summary(part: type) -> str:
    """The first line of a part's documentation."""
    return (part.__doc__ or "").strip().partition("\n")[0]


def stated(part: type, name: str) -> str:
    """What a part says of itself; nothing where a user's own part does not."""
    value = getattr(part, name, "")
    return ", ".join(value) if isinstance(value, tuple) else str(value)


def yes(part: type, name: str) -> str:
    """A column of the taxonomy; parts that can be made solid change it then."""
    if not hasattr(part, name):
        return ""
    value = "yes" if getattr(part, name) else "no"
    if name != "interactive" and "solid" in part.__dataclass_fields__:  # type: ignore[attr-defined]
        return f"{value}; {'no' if value == 'yes' else 'yes'} if solid"
    return value


def suites() -> str:
    """The named suites, a row per task and robot."""
    ids = [env_id.removesuffix("-v0") for env_id in env_ids()]
    stems = dict.fromkeys(env_id.rsplit("_", 1)[0] for env_id in ids)
    rows = [[stem, *(env_id for env_id in ids if env_id.startswith(stem + "_"))] for stem in stems]
    return table(["suite", *(["id"] * (len(rows[0]) - 1))], rows)


def robots() -> str:
    """The robots with their actions, workspaces and time steps."""
    rows = []
    for name, cls in ROBOTS.items():
        actions = Scenario(robot=name).build().robot.action_size
        rows.append([name, str(actions), cls.workspace, f"{10 * cls.timestep:g}", summary(cls)])
    return table(["robot", "actions", "workspace", "control step, s", "what it is"], rows)


def tasks() -> str:
    """The tasks with their place in the paper's taxonomy."""
    rows = [
        [name, yes(cls, "interactive"), yes(cls, "contact"), stated(cls, "targets"),
         stated(cls, "spaces"), summary(cls)]
        for name, cls in TASKS.items()
    ]  # fmt: skip
    return table(["task", "interactive", "contact", "targets", "spaces", "what it asks"], rows)


def constraints() -> str:
    """The constraints with their place in the paper's taxonomy."""
    rows = [
        [name, yes(cls, "trespassable"), stated(cls, "movable"), stated(cls, "spaces"),
         summary(cls)]
        for name, cls in CONSTRAINTS.items()
    ]  # fmt: skip
    return table(["constraint", "trespassable", "moves", "spaces", "what it is"], rows)


KINDS = {"suites": suites, "robots": robots, "tasks": tasks, "constraints": constraints}


def _kind(text: str) -> str:
    if text not in KINDS:
        raise argparse.ArgumentTypeError(f"there is no list {text!r}; {did_you_mean(text, KINDS)}")
    return text


def parser() -> Parser:
    """The flags."""
    result = Parser(
        prog="sb3-guard list",
        description="Print suites, robots, tasks and constraints.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("kind", nargs="?", type=_kind, choices=list(KINDS), help="only these")
    result.add_argument(
        "--ladder",
        nargs="*",
        metavar="TASK_ROBOT CONSTRAINT",
        help="ids of growing difficulty: more and more of a constraint",
    )
    result.add_argument("--gym-packages", nargs="+", default=[], help="modules that add parts")
    return result


def _list(argv: Sequence[str] | None) -> int:
    args = parser().parse_args(argv)
    import_packages(args.gym_packages)
    if args.ladder is not None:
        if len(args.ladder) != 2:
            raise UsageError(
                f"--ladder takes a task with a robot, and a constraint, not {len(args.ladder)} "
                "values: for example --ladder Goal_Point Hazards"
            )
        ids = [f"{args.ladder[0]}_{num}{args.ladder[1]}-v0" for num in LADDER]
        try:
            for env_id in ids:
                Scenario.parse(env_id)
        except ValueError as error:
            raise UsageError(str(error)) from None
        print("\n".join(ids))
        return 0
    print("\n\n".join(KINDS[kind]() for kind in ([args.kind] if args.kind else KINDS)))
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the command.

    :param argv: arguments; None: those of the process
    :return: exit status: 0, or 2 for wrong usage
    """
    return run(lambda: _list(argv))


if __name__ == "__main__":
    sys.exit(main())

"""What there is: ``sb3-guard list`` prints environments, parts and pretrained agents."""

import re
import sys
from dataclasses import dataclass
from typing import ClassVar, Literal

from sb3_guard.envs import Scenario
from sb3_guard.envs.registry import CONSTRAINTS, ROBOTS, TASKS
from sb3_guard.envs.suites import SUITES, Suite
from sb3_guard.ids import with_version
from sb3_guard.zoo.cli.flags import Command, command, flag
from sb3_guard.zoo.cli.markdown import table
from sb3_guard.zoo.cli.usage import import_packages


def summary(part: type) -> str:
    """The first line of a part's documentation."""
    return (part.__doc__ or "").replace("``", "").strip().partition("\n")[0]


def _of_one(suite: Suite) -> str:
    """The ids of an environment, a row for each name up to its last part."""
    stems: dict[str, list[str]] = {}
    for env_id in suite.scenarios:
        short = env_id.removesuffix("-v0")
        name = short if with_version(short) == env_id else env_id
        stem = name.rpartition("_")[0] or re.sub(r"\d*(-v\d+)?$", "", name)
        stems.setdefault(stem, []).append(name)
    width = max(map(len, stems.values()))
    rows = [[stem, *ids, *[""] * (width - len(ids))] for stem, ids in stems.items()]
    return f"{suite.about}\n\n{table(['environments', *['id'] * width], rows)}"


def suites() -> str:
    """The named environments of every family."""
    return "\n\n".join(_of_one(suite) for suite in SUITES.values())


def robots() -> str:
    """The robots with their actions, workspaces and time steps."""
    rows = []
    for name, cls in ROBOTS.items():
        engine = Scenario(robot=name).build()
        actions, seconds = engine.robot.action_size, engine.control_step
        rows.append([name, str(actions), cls.workspace, f"{seconds:g}", summary(cls)])
    return table(["robot", "actions", "workspace", "control step, s", "what it is"], rows)


def tasks() -> str:
    """The tasks."""
    return table(["task", "what it asks"], [[name, summary(cls)] for name, cls in TASKS.items()])


def constraints() -> str:
    """The constraints."""
    rows = [[name, summary(cls)] for name, cls in CONSTRAINTS.items()]
    return table(["constraint", "what it is"], rows)


def agents() -> str:
    """The agents that the package ships, for ``enjoy --pretrained``."""
    from sb3_guard.zoo.agents.pretrained import listed

    return listed()


KINDS = {
    "environments": suites,
    "robots": robots,
    "tasks": tasks,
    "constraints": constraints,
    "agents": agents,
}


@dataclass
class Flags(Command):
    """
    Print environments, robots, tasks, constraints and pretrained agents.

    :param kind: print only this list
    :param gym_packages: modules to import first, which register parts
    """

    prog: ClassVar[str] = "sb3-guard list"
    examples: ClassVar[str] = """examples:
  sb3-guard list
  sb3-guard list robots
"""
    kind: Literal["environments", "robots", "tasks", "constraints", "agents"] | None = flag(
        positional=True, nargs="?"
    )
    gym_packages: list[str] = flag(default=[], metavar="MODULE")


def show_lists(flags: Flags) -> int:
    """Print what there is."""
    import_packages(flags.gym_packages)
    print("\n\n".join(KINDS[kind]() for kind in ([flags.kind] if flags.kind else KINDS)))
    return 0


main = command(Flags, show_lists)

if __name__ == "__main__":
    sys.exit(main())

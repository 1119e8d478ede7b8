"""GUARD's environments (Zhao et al. 2024): four tasks × nine robots × eight hazards or ghosts.

Names say what they mean: any task, robot, number and constraint make an environment.
"""

import re
from dataclasses import fields
from itertools import product

from sb3_guard.envs.registry import CONSTRAINTS, ROBOTS, TASKS
from sb3_guard.envs.suites.suite import Fields, Suite
from sb3_guard.fields import did_you_mean
from sb3_guard.ids import IMPORT_FIRST, UnknownPart

LADDER = (1, 2, 4, 8, 16)  # numbers of a constraint's objects, by growing difficulty
SUITE_TASKS = ("Goal", "Push", "Chase", "Defense")
SUITE_ROBOTS = (
    "Point", "Swimmer", "Ant", "Walker", "Humanoid", "Hopper", "Arm3", "Arm6", "Drone"
)  # fmt: skip
SUITE_CONSTRAINTS = ("Hazards", "Ghosts")

_ID = re.compile(
    r"(?P<task>[A-Za-z][A-Za-z0-9]*)_(?P<robot>[A-Za-z][A-Za-z0-9]*)"
    r"_(?P<num>\d+)(?P<constraint>[A-Za-z][A-Za-z0-9]*)(?P<noconti>_noconti)?(-v0)?"
)


def parse(name: str) -> Fields | None:
    """What a name such as ``Goal_Ant_3Ghosts`` says; None if it is of another form.

    :raises ValueError: it does not follow ``{Task}_{Robot}_{N}{Constraint}[_noconti]`` with names
        of parts that there are
    """
    match = _ID.fullmatch(name)
    if match is None:
        return None
    known = {"robot": list(ROBOTS), "task": list(TASKS), "constraint": list(CONSTRAINTS)}
    wrong = [kind for kind, names in known.items() if match[kind] not in names]
    if wrong:
        kind = wrong[0]
        raise UnknownPart(
            f"unknown {kind} {match[kind]!r} in {name!r}: "
            f"{did_you_mean(match[kind], known[kind])}{IMPORT_FIRST}"
        )
    num = {"num": int(match["num"])}
    if "num" not in CONSTRAINTS[match["constraint"]].__dataclass_fields__:  # type: ignore
        if match["num"] != "1":
            raise ValueError(
                f"{name!r}: {match['constraint']} has no parameter num, so there can only be "
                f"one: write 1{match['constraint']}, or give its class a field num"
            )
        num = {}
    task = TASKS[match["task"]]
    if match["noconti"] and "ends" not in {f.name for f in fields(task)}:  # type: ignore
        raise ValueError(f"{match['task']} has no goal to end at: drop _noconti from {name!r}")
    return {
        "robot": match["robot"],
        "task": match["task"],
        "constraints": {match["constraint"].lower(): num},
        "task_params": {"ends": True} if match["noconti"] else {},
    }


SUITE = Suite(
    about="GUARD: four tasks, nine robots, eight hazards or ghosts",
    scenarios={
        f"{task}_{robot}_8{constraint}-v0": {
            "robot": robot,
            "task": task,
            "constraints": {constraint.lower(): {"num": 8}},
        }
        for task, robot, constraint in product(SUITE_TASKS, SUITE_ROBOTS, SUITE_CONSTRAINTS)
    },
    parse=parse,
)

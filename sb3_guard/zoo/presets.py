"""The paper's grids, by the question that they answer: which suites, with which algorithms."""

from collections.abc import Sequence

from sb3_guard.envs.suites import env_ids
from sb3_guard.envs.suites.guard import LADDER, SUITE_ROBOTS
from sb3_guard.spelling import did_you_mean
from sb3_guard.zoo.paper import ALGOS as ALL
from sb3_guard.zoo.paper import MAIN8, RADAR4
from sb3_guard.zoo.usage import UsageError

PAPER45 = tuple(
    env_id for env_id in env_ids("guard") if "_8Hazards" in env_id or env_id.startswith("Goal_")
)
OVERVIEW = tuple(f"{suite}-v0" for suite in MAIN8)
RADAR = tuple(f"{suite}-v0" for suite in RADAR4)
HAZARDS = tuple(f"Goal_{robot}_8Hazards-v0" for robot in SUITE_ROBOTS)
GHOSTS = tuple(f"Goal_{robot}_8Ghosts-v0" for robot in SUITE_ROBOTS)
RUNGS = tuple(
    f"Goal_Point_{number}{constraint}-v0"
    for constraint in ("Hazards", "Ghosts")
    for number in LADDER
)

# Blocks of suites × algorithms. Scores are relative to TRPO's, so it is part of each.
PRESETS: dict[str, tuple[tuple[tuple[str, ...], tuple[str, ...]], ...]] = {
    "paper45": ((PAPER45, ALL),),
    "main8": ((OVERVIEW, ALL),),
    "q1": ((OVERVIEW, ALL),),
    "q2": ((HAZARDS + GHOSTS, ("trpo",)), ((HAZARDS[0], GHOSTS[0]), ALL)),
    "q3": ((RADAR, ALL),),
    "q4": ((HAZARDS, ALL),),
    "q5": ((HAZARDS, ("trpo", "trpo_lag", "trpo_fac")),),
    "q6": ((HAZARDS, ("trpo", "cpo", "pcpo")),),
    "q7": ((HAZARDS, ("trpo", "trpo_sl", "trpo_usl")),),
    "q8": ((PAPER45, ALL),),
    "ladder": ((RUNGS, ALL),),
}


def preset(name: str, algos: Sequence[str] | None = None) -> list[tuple[str, str]]:
    """
    The pairs of suite and algorithm of a preset.

    :param algos: take these on all of its suites; None: what its question needs
    :raises UsageError: there is no preset of that name
    """
    if name not in PRESETS:
        raise UsageError(f"unknown preset {name!r}; {did_you_mean(name, PRESETS)}")
    return list(
        dict.fromkeys(
            (suite, algo)
            for suites, needed in PRESETS[name]
            for suite in suites
            for algo in algos or needed
        )
    )

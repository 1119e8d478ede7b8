"""The paper's grids, by the question that they answer: which suites, with which algorithms."""

from collections.abc import Sequence

from sb3_guard.algorithms import ALGORITHMS
from sb3_guard.envs.registry import SUITE_ROBOTS, env_ids
from sb3_guard.spelling import did_you_mean
from sb3_guard.zoo.usage import UsageError

ALL = tuple(ALGORITHMS)
MAIN8 = (
    "Goal_Point_8Hazards-v0",
    "Goal_Walker_8Hazards-v0",
    "Goal_Arm3_8Hazards-v0",
    "Goal_Drone_8Hazards-v0",
    "Goal_Point_8Ghosts-v0",
    "Push_Point_8Hazards-v0",
    "Chase_Point_8Hazards-v0",
    "Defense_Point_8Hazards-v0",
)
PAPER45 = tuple(
    env_id for env_id in env_ids() if "_8Hazards" in env_id or env_id.startswith("Goal_")
)
RADAR4 = tuple(
    f"Goal_{robot}_8{constraint}-v0"
    for robot in ("Point", "Ant")
    for constraint in ("Hazards", "Ghosts")
)
HAZARDS = tuple(f"Goal_{robot}_8Hazards-v0" for robot in SUITE_ROBOTS)
GHOSTS = tuple(f"Goal_{robot}_8Ghosts-v0" for robot in SUITE_ROBOTS)
LADDER = tuple(
    f"Goal_Point_{number}{constraint}-v0"
    for constraint in ("Hazards", "Ghosts")
    for number in (1, 2, 4, 8, 16)
)

# Blocks of suites × algorithms. Scores are relative to TRPO's, so it is part of each.
PRESETS: dict[str, tuple[tuple[tuple[str, ...], tuple[str, ...]], ...]] = {
    "paper45": ((PAPER45, ALL),),
    "main8": ((MAIN8, ALL),),
    "q1": ((MAIN8, ALL),),
    "q2": ((HAZARDS + GHOSTS, ("trpo",)), ((HAZARDS[0], GHOSTS[0]), ALL)),
    "q3": ((RADAR4, ALL),),
    "q4": ((HAZARDS, ALL),),
    "q5": ((HAZARDS, ("trpo", "trpo_lag", "trpo_fac")),),
    "q6": ((HAZARDS, ("trpo", "cpo", "pcpo")),),
    "q7": ((HAZARDS, ("trpo", "trpo_sl", "trpo_usl")),),
    "q8": ((PAPER45, ALL),),
    "ladder": ((LADDER, ALL),),
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

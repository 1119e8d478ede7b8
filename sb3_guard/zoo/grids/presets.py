"""The questions of the GUARD paper (arXiv 2305.13681), with the environments and algorithms.

``benchmark --preset`` trains them, and :mod:`sb3_guard.zoo.results.figures` draws what came of it.
"""

from collections.abc import Sequence

from sb3_guard.envs.suites.guard import LADDER

ALGOS = (
    "trpo", "cpo", "pcpo", "trpo_lag", "trpo_fac", "trpo_ipo", "trpo_sl", "trpo_usl",
)  # fmt: skip
# The robots by degrees of freedom, the number of actions
ROBOTS = {
    "Point": 2, "Swimmer": 2, "Arm3": 3, "Drone": 4, "Hopper": 5, "Arm6": 6, "Humanoid": 6,
    "Ant": 8, "Walker": 10,
}  # fmt: skip
OPTIONS = {
    "Goal\nHazards": "Goal_{}_8Hazards",
    "Goal\nGhosts": "Goal_{}_8Ghosts",
    "Push": "Push_{}_8Hazards",
    "Chase": "Chase_{}_8Hazards",
    "Defense": "Defense_{}_8Hazards",
}
PAPER45 = [suite.format(robot) for suite in OPTIONS.values() for robot in ROBOTS]
HAZARDS, GHOSTS = PAPER45[: len(ROBOTS)], PAPER45[len(ROBOTS) : 2 * len(ROBOTS)]
MAIN8 = (
    "Goal_Point_8Hazards", "Goal_Walker_8Hazards", "Goal_Arm3_8Hazards", "Goal_Drone_8Hazards",
    "Goal_Point_8Ghosts", "Push_Point_8Hazards", "Chase_Point_8Hazards", "Defense_Point_8Hazards",
)  # fmt: skip
RADAR4 = ("Goal_Point_8Hazards", "Goal_Point_8Ghosts", "Goal_Ant_8Hazards", "Goal_Ant_8Ghosts")
RUNGS = [f"Goal_Point_{number}{kind}" for kind in ("Hazards", "Ghosts") for number in LADDER]

# Blocks of environments × algorithms. Scores are relative to TRPO's, so it is part of each.
PRESETS: dict[str, tuple[tuple[Sequence[str], Sequence[str]], ...]] = {
    "paper45": ((PAPER45, ALGOS),),
    "main8": ((MAIN8, ALGOS),),
    "q1": ((MAIN8, ALGOS),),
    "q2": ((HAZARDS + GHOSTS, ALGOS[:1]), ((HAZARDS[0], GHOSTS[0]), ALGOS[1:])),
    "q3": ((RADAR4, ALGOS),),
    "q4": ((HAZARDS, ALGOS),),
    "q5": ((HAZARDS, ("trpo", "trpo_lag", "trpo_fac")),),
    "q6": ((HAZARDS, ("trpo", "cpo", "pcpo")),),
    "q7": ((HAZARDS, ("trpo", "trpo_usl", "trpo_sl")),),
    "q8": ((PAPER45, ALGOS),),
    "ladder": ((RUNGS, ALGOS),),
}

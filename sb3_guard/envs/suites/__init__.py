"""Families of named environments: tables from ids to scenarios.

A family is a :class:`~sb3_guard.envs.suites.suite.Suite` in a module of its own. Once it is in
:data:`SUITES`, its ids are known to Gymnasium, ``make``, ``make_vec_env``, ``Scenario.parse`` and
the commands, with the keywords that change parameters.
"""

from sb3_guard.envs.suites import guard, safety_gymnasium, velocity
from sb3_guard.envs.suites.suite import EPISODE_STEPS, Fields, Suite
from sb3_guard.fields import did_you_mean, nearest
from sb3_guard.ids import UnknownId, with_version

__all__ = ["EPISODE_STEPS", "SUITES", "Suite", "env_ids", "episode_steps", "fields"]

SUITES: dict[str, Suite] = {
    "guard": guard.SUITE,
    "safety_gymnasium": safety_gymnasium.SUITE,
    "velocity": velocity.SUITE,
}


def env_ids(suite: str | None = None) -> list[str]:
    """The ids of the named environments.

    :param suite: of one family, such as ``"guard"``; None: of all
    :raises ValueError: there is no such family
    """
    if suite is not None and suite not in SUITES:
        raise ValueError(f"unknown suite {suite!r}: {did_you_mean(suite, SUITES)}")
    chosen = SUITES.values() if suite is None else [SUITES[suite]]
    return [env_id for one in chosen for env_id in one.scenarios]


def episode_steps(name: str) -> int:
    """Control steps after which an episode of this id is cut."""
    env_id = with_version(name, env_ids())
    return next((s.steps[env_id] for s in SUITES.values() if env_id in s.steps), EPISODE_STEPS)


def fields(name: str) -> Fields:
    """The fields of the scenario that an id stands for; its version may be left out.

    :raises UnknownId: no family knows it
    """
    env_id = with_version(name, env_ids())
    for suite in SUITES.values():
        found = suite.scenarios.get(env_id)
        if found is None and suite.parse is not None:
            found = suite.parse(name)
        if found is not None:
            return found
    meant = nearest(name, env_ids())
    hint = "" if meant is None else f"; did you mean {meant!r}?"
    raise UnknownId(
        f"{name!r} is not an id of the form Task_Robot_NConstraint-v0, such as "
        f"'Goal_Point_8Hazards-v0'{hint}"
    )

"""Ids of environments: which are ours, and one rule for a version that is left out."""

import re
from collections.abc import Iterable

import gymnasium
from gymnasium.envs.registration import find_highest_version

#: of our environments, as Gymnasium's registry has it
ENTRY_POINT = "sb3_guard.envs.gym_env:GuardEnv"

#: Ends messages about unknown names.
IMPORT_FIRST = (
    "; import the module of parts or environments of your own first (commands: "
    "--gym-packages MODULE)"
)


class UnknownId(ValueError):
    """An id that names no environment."""


class UnknownPart(ValueError):
    """The name of a robot, task or constraint that is not registered in this process."""


def with_version(name: str, others: Iterable[str] = ()) -> str:
    """An id in full: without a version, the latest that is registered with Gymnasium, else v0.

    :param others: ids that count in addition to the registered ones
    """
    if re.search(r"-v\d+$", name) or name in gymnasium.registry:
        return name
    namespace, _, short = name.rpartition("/")
    versions = [find_highest_version(namespace or None, short) or 0]
    for other in others:
        stem, _, version = other.rpartition("-v")
        if stem == name:
            versions.append(int(version))
    return f"{name}-v{max(versions)}"

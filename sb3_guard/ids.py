"""Ids of environments: one rule for a version that is left out."""

import re

import gymnasium
from gymnasium.envs.registration import find_highest_version


class UnknownId(ValueError):
    """An id that names no environment."""


def with_version(name: str) -> str:
    """An id in full: without a version, the latest that is registered with Gymnasium, else v0."""
    if re.search(r"-v\d+$", name) or name in gymnasium.registry:
        return name
    namespace, _, short = name.rpartition("/")
    return f"{name}-v{find_highest_version(namespace or None, short) or 0}"

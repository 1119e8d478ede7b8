"""What a family of named environments is."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

Fields = Mapping[str, Any]  # keyword arguments of a Scenario
EPISODE_STEPS = 1000  # control steps of an episode, where an id does not say otherwise


@dataclass(frozen=True)
class Suite:
    """A family of named environments.

    :param about: in one line, what it is
    :param scenarios: the fields of a :class:`~sb3_guard.envs.scenario.Scenario` by id, with version
    :param steps: control steps after which an episode is cut, of ids where it is not 1,000
    :param parse: the fields of a name that is not in the table but says what it means, such as
        another number of objects; None for names of other families. It may raise a ValueError that
        says what is wrong with a name of this family, or what to use in its place
    """

    about: str
    scenarios: Mapping[str, Fields]
    steps: Mapping[str, int] = field(default_factory=dict)
    parse: Callable[[str], Fields | None] | None = None

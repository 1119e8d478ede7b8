"""Print the lowest versions that pyproject.toml admits, as pip constraints.

``make test-lowest`` installs these in an environment of its own and runs the tests there.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

PROJECT = Path(__file__).parents[1] / "pyproject.toml"


def lowest(requirement: str) -> str:
    """
    A requirement, pinned to its lower bound.

    :param requirement: as in pyproject.toml, e.g. ``"numpy>=2.0"``
    :raises ValueError: it has no lower bound
    """
    parsed = Requirement(requirement)
    bounds = [bound.version for bound in parsed.specifier if bound.operator == ">="]
    if len(bounds) != 1:
        raise ValueError(f"{requirement!r} needs one lower bound, written >=")
    return f"{parsed.name}=={bounds[0]}"


def main() -> None:
    project = tomllib.loads(PROJECT.read_text())["project"]
    sys.stdout.writelines(f"{lowest(requirement)}\n" for requirement in project["dependencies"])


if __name__ == "__main__":
    main()

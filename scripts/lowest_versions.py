"""Print the lowest versions that pyproject.toml admits, as pip constraints.

``make test-lowest`` installs these in an environment of its own and runs the tests there.
"""

import tomllib
from pathlib import Path

from packaging.requirements import Requirement

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
for requirement in map(Requirement, project["dependencies"]):
    (bound,) = (bound for bound in requirement.specifier if bound.operator == ">=")
    print(f"{requirement.name}=={bound.version}")

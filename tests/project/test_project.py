"""What the project says of itself in several places is the same."""

import ast
import re
import tomllib
from pathlib import Path

import yaml

import sb3_guard

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_pythons_of_the_classifiers_are_those_that_are_tested():
    prefix = "Programming Language :: Python :: 3."
    stated = [name for name in PROJECT["classifiers"] if name.startswith(prefix)]
    jobs = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]
    tested = jobs["test"]["strategy"]["matrix"]["python"]
    assert [name.rpartition(" ")[2] for name in stated] == tested
    assert PROJECT["requires-python"] == f">={tested[0]}"


def test_pre_commit_has_the_ruff_of_make_check():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    revisions = [hook["rev"] for hook in hooks if hook["repo"].endswith("/ruff-pre-commit")]
    needs = PROJECT["optional-dependencies"]["dev"]
    assert [f"ruff=={rev[1:].rpartition('.')[0]}.*" for rev in revisions] == [
        name for name in needs if name.startswith("ruff")
    ]


def test_the_version_is_the_changelogs_latest():
    released = re.findall(r"(?m)^## \[(.*?)\]", (ROOT / "CHANGELOG.md").read_text())
    assert released[:2] == ["Unreleased", sb3_guard.__version__]
    assert f"version: {sb3_guard.__version__}" in (ROOT / "CITATION.cff").read_text()


def test_no_file_has_more_than_400_lines_and_no_function_more_than_60():
    long = []
    for path in (
        path for folder in ("sb3_guard", "scripts") for path in ROOT.glob(f"{folder}/**/*.py")
    ):
        text = path.read_text()
        long += [str(path)] * (len(text.splitlines()) > 400)
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                docstring = len((ast.get_docstring(node, clean=False) or "").splitlines())
                if node.end_lineno - node.lineno + 1 - docstring > 60:
                    long.append(f"{path}: {node.name}")
    assert not long

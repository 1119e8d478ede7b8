"""What the project says of itself in several places is the same."""

import re
import shlex
import tomllib
from pathlib import Path

import yaml

import sb3_guard
from sb3_guard import cli

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


def test_the_commands_that_other_systems_are_tested_with_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    jobs = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]
    lines = [step["run"] for step in jobs["systems"]["steps"] if "run" in step]
    commands = [shlex.split(line)[1:] for line in lines if line.startswith("sb3-guard ")]
    assert [command[0] for command in commands] == ["train", "enjoy", "export"]
    for command in commands:
        assert cli.main(command) == 0, command
    assert {path.name for path in tmp_path.iterdir()} == {"logs", "contract.json", "policy.onnx"}

"""The sums of the house are bounded, so that new lines take the place of old ones.

A commit that raises a number says what went instead; one that removes lines lowers it.
"""

import ast
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "sb3_guard"

LINES = {
    "sb3_guard": 27_370,
    "sb3_guard/envs": 9_013,
    "sb3_guard/algorithms": 5_714,
    "sb3_guard/common": 4_089,
    "sb3_guard/deployment": 879,
    "harness": 7_675,
    "tests": 27_004,
}
WORDS = 65_137  # of all tracked markdown but the changelog


def lines(files: Iterable[Path]) -> int:
    return sum(len(file.read_text().splitlines()) for file in files)


def files(folder: str) -> list[Path]:
    """Python files of a folder; with ``zoo`` the commands, with ``common`` the other modules."""
    commands = {path for path in PACKAGE.glob("*.py") if "\nmain = command(" in path.read_text()}
    if folder == "harness":
        return [*commands, *PACKAGE.glob("zoo/**/*.py")]
    beside = {*PACKAGE.glob("*.py")} - commands if folder == "sb3_guard/common" else ()
    return [*beside, *ROOT.glob(f"{folder}/**/*.py")]


@pytest.mark.parametrize(("folder", "most"), LINES.items(), ids=LINES)
def test_lines(folder, most):
    assert lines(files(folder)) <= most


def test_every_module_is_in_a_sum():
    parts = {path for folder in LINES for path in files(folder) if folder != "sb3_guard"}
    assert parts >= {*PACKAGE.glob("**/*.py")}


def test_words():
    folders = ("*.md", "docs/**/*.md", "lab/**/*.md", "sb3_guard/**/*.md")
    pages = [page for folder in folders for page in ROOT.glob(folder)]
    texts = (
        page.read_text()
        for page in pages
        if page.name != "CHANGELOG.md" and "_build" not in page.parts
    )
    assert sum(len(text.split()) for text in texts) <= WORDS


def test_no_function_has_more_than_60_lines():
    long = []
    for path in (*files("sb3_guard"), *files("scripts")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                docstring = len((ast.get_docstring(node, clean=False) or "").splitlines())
                if node.end_lineno - node.lineno + 1 - docstring > 60:
                    long.append(f"{path}: {node.name}")
    assert not long

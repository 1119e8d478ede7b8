"""Pages, help, docstrings, messages, notebook and comments use the words of docs/glossary.md."""

import ast
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# Words that have another meaning here than elsewhere, or that the field does not use.
AVOIDED = re.compile(
    r"\b(suites|beside|likewise|hyper-parameters?|prices?|priced|earns?|earned|pays?|paid|misspelt|"
    r"of ours)\b",
    re.IGNORECASE,
)
NOT_PROSE = r"```.*?```|<!--.*?-->|``.*?``|`[^`]*`|\]\([^)]*\)|:param \w+:"
PAGES = [
    ROOT / "README.md",
    *(
        page
        for page in sorted((ROOT / "docs").rglob("*.md"))
        if not {"_build", "notes"} & {*page.parts}
    ),
]
MODULES = [*sorted((ROOT / "sb3_guard").rglob("*.py")), *sorted((ROOT / "examples").glob("*.py"))]


def avoided(text: str) -> set[str]:
    return {word.lower() for word in AVOIDED.findall(re.sub(NOT_PROSE, " ", text, flags=re.DOTALL))}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_use_the_words_of_the_field(page):
    assert not avoided(page.read_text())


def test_docstrings_help_and_messages_use_the_words_of_the_field():
    found = {}
    for module in MODULES:
        constants = (
            node
            for node in ast.walk(ast.parse(module.read_text()))
            if isinstance(node, ast.Constant)
        )
        texts = [
            node.value for node in constants if isinstance(node.value, str) and " " in node.value
        ]
        if words := set().union(*map(avoided, texts)):
            found[module.relative_to(ROOT).as_posix()] = words
    assert not found


def test_the_notebook_uses_the_words_of_the_field():
    cells = json.loads((ROOT / "examples" / "quickstart.ipynb").read_text())["cells"]
    assert not avoided("\n".join("".join(cell["source"]) for cell in cells))


@pytest.mark.parametrize("file", sorted((ROOT / "hyperparams").glob("*.yml")), ids=lambda p: p.stem)
def test_comments_of_hyperparameters_use_the_words_of_the_field(file):
    assert not avoided("\n".join(re.findall(r"#.*", file.read_text())))


def test_a_word_to_avoid_is_found_in_prose_alone():
    assert avoided("Prices beside `suites` and\n```\nlikewise\n```") == {"prices", "beside"}

"""Count the words of the pages that people read: ``python scripts/count_words.py``.

Counted are the README and every page below ``docs/`` that is written by hand for users, with
their code, tables and numbers.
"""

import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
#: Most words of all pages for users, and of the page of results.
MOST, MOST_RESULTS = 35_000, 3_000
#: Written by scripts/make_docs.py; the tables of the leaderboard by its own script.
#: A folder ends with a slash.
GENERATED = (
    "api/", "command_line.md", "constraints/", "constraints.md", "examples.md", "gallery.md",
    "hyperparameter_tables.md", "leaderboard.md", "parameters.md", "robots/", "tasks/", "tasks.md",
)  # fmt: skip
#: For reviewers and developers.
REVIEWERS = ("architecture.md", "checks.md", "fidelity.md", "speed.md")
#: Experiments that led to the defaults, kept for the record.
NOTES = ("notes/",)
#: Only a line that includes a file of the repository.
INCLUDED = ("changelog.md", "contributing.md")


def words(page: Path) -> int:
    """Words and numbers of a page that a reader sees."""
    text = re.sub(r"<!--.*?-->", " ", page.read_text(), flags=re.DOTALL)
    return sum(bool(re.search(r"\w", word)) for word in text.split())


def for_users() -> Iterator[Path]:
    """The pages that count: the README first, then the others by name."""
    yield ROOT / "README.md"
    for page in sorted(DOCS.rglob("*.md")):
        name = page.relative_to(DOCS).as_posix()
        others = (*GENERATED, *REVIEWERS, *NOTES, *INCLUDED, "_build/")
        if not any(
            name == other or (other[-1] == "/" and name.startswith(other)) for other in others
        ):
            yield page


def main() -> None:
    counts = {page.relative_to(ROOT).as_posix(): words(page) for page in for_users()}
    for name, count in sorted(counts.items(), key=lambda item: -item[1]):
        print(f"{count:7,} {name}")
    print(f"{sum(counts.values()):7,} of at most {MOST:,}")


if __name__ == "__main__":
    main()

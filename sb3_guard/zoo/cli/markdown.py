"""Markdown tables, which also read well in a terminal."""

import re
from collections.abc import Iterable, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """
    A table in Markdown, its columns aligned.

    :param header: C titles
    :param rows: C texts each
    """
    lines = [[cell.replace("|", "\\|") for cell in line] for line in (header, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    text = [f"| {' | '.join(map(str.ljust, line, widths))} |" for line in lines]
    rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    return "\n".join([text[0], rule, *text[1:]])


def escaped(text: str) -> str:
    """Text for a Markdown page that shows as it is: no markup, HTML or links."""
    return re.sub(r"([\\`*<&]|(?<!\w)_|_(?!\w)|(?<=\])(?=\())", r"\\\1", text)

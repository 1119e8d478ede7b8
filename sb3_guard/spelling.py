"""What a misspelled name may have meant; every error message about a name ends with it."""

import difflib
import fnmatch
from collections.abc import Iterable


def nearest(name: str, known: Iterable[str]) -> str | None:
    """The allowed name that ``name`` most likely meant, whatever its case; None: nothing is near.

    :param known: allowed names; among equally near ones the first is meant
    """
    wrong = str(name).lower()

    def likeness(allowed: str) -> float:
        return difflib.SequenceMatcher(None, allowed.lower(), wrong).ratio()

    close = max(known, key=likeness, default="")
    return close if likeness(close) >= 0.6 else None


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Say what ``name`` may have meant and what is allowed, for an error message.

    :param known: allowed names; among equally near ones the first is meant
    """
    known = list(known)
    close = nearest(name, known)
    hint = "" if close is None else f"did you mean {close!r}? "
    return f"{hint}allowed: {', '.join(known) or 'none'}"


def matching(label: str, pattern: str, known: Iterable[str]) -> list[str]:
    """The names that a pattern matches, such as ``*_knee`` (``*``: any text, ``?``: a character).

    :param label: what an error message calls the place of the pattern
    :param known: allowed names
    :raises ValueError: there is none
    """
    known, pattern = list(known), str(pattern)
    names = fnmatch.filter(known, pattern) or [name for name in known if name == pattern]
    if not names:
        raise ValueError(f"{label} matches no name {pattern!r}: {did_you_mean(pattern, known)}")
    return names

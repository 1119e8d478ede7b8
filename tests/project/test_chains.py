"""How many classes, lines and arguments a reader of an algorithm meets."""

import inspect
from pathlib import Path
from typing import Any

import pytest

from sb3_guard.algorithms import CPO, PPOLag, SACLag


def chain(cls: Any) -> list[type]:
    return [base for base in cls.__mro__ if base.__module__.startswith("sb3_guard.")]


@pytest.mark.parametrize(("cls", "most"), [(CPO, 4), (PPOLag, 5), (SACLag, 5)])
def test_an_algorithm_is_few_classes(cls: Any, most: int) -> None:
    assert len(chain(cls)) <= most


def test_cpo_is_small() -> None:
    files = {Path(inspect.getfile(base)) for base in chain(CPO)}
    assert sum(len(file.read_text().splitlines()) for file in files) <= 1000
    names = [name for name in inspect.signature(CPO).parameters if not name.startswith("_")]
    assert len(names) <= 29  # with the aim

"""The agents of the page in a browser, and what it says of them."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("make_browser", ROOT / "scripts/make_browser.py")
assert SPEC is not None and SPEC.loader is not None
MAKER = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(MAKER)


def test_there_is_an_agent_for_each_limit_and_nothing_else() -> None:
    entries = json.loads((MAKER.SOURCE / "agents.json").read_text())
    limits = {e["env"]: tuple(agent["limit"] for agent in e["agents"]) for e in entries}
    assert limits == MAKER.LIMITS
    files = [agent["file"] for entry in entries for agent in entry["agents"]]
    packed = (path for path in (MAKER.SOURCE / "agents").iterdir())
    assert {f"agents/{path.name}" for path in packed} == {*files}
    assert max((MAKER.SOURCE / file).stat().st_size for file in files) < 50e3


@pytest.mark.parametrize(
    ("limit", "verdict"), [(None, ""), (3.9, "exceeded"), (5, "undecided"), (6.1, "kept")]
)
def test_the_verdict_is_that_of_the_interval(limit: float | None, verdict: str) -> None:
    episodes = {"returns": [1.0, 2.0] * 50, "costs": [2.0, 8.0] * 50}
    measured = MAKER.measured(episodes, limit)
    assert (measured["return"], measured["cost"], measured["episodes"]) == (1.5, 5.0, 100)
    half = 1.96 * 3 / np.sqrt(100)  # of the interval, by the normal distribution
    assert [measured["low"], measured["high"]] == pytest.approx([5 - half, 5 + half], abs=0.1)
    assert measured["verdict"] == verdict


def test_the_model_is_what_show_writes_but_for_what_is_not_read_yet() -> None:
    engine = MAKER.GuardEnv(**MAKER.env_spec("SafetyPointGoal1-v0").kwargs).engine
    text = engine.spec.to_xml()
    assert text.count(' input="vel"') == 1
    assert MAKER.mjcf(engine).split() == [word for word in text.split() if word != 'input="vel"']

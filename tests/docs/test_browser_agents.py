"""The agents of the page in a browser, and what it says of them."""

import importlib.util
import json
from pathlib import Path

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("make_browser", ROOT / "scripts/make_browser.py")
assert SPEC is not None and SPEC.loader is not None
MAKER = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(MAKER)


def test_there_is_an_agent_for_each_limit_and_nothing_else() -> None:
    entries = json.loads((MAKER.SOURCE / "agents.json").read_text())
    limits = {e["env"]: tuple(agent["limit"] for agent in e["agents"]) for e in entries}
    assert limits == {env: tuple(agents) for env, agents in MAKER.AGENTS.items()}
    files = [agent["file"] for entry in entries for agent in entry["agents"]]
    packed = (path for path in (MAKER.SOURCE / "agents").iterdir())
    assert {f"agents/{path.name}" for path in packed} == {*files}
    assert max((MAKER.SOURCE / file).stat().st_size for file in files) < 150e3


def test_the_page_opens_on_a_certified_agent() -> None:
    """Of each environment the page shows the last agent that is certified with these actions."""
    for entry in json.loads((MAKER.SOURCE / "agents.json").read_text()):
        assert "certified" in [agent["greedy"]["verdict"] for agent in entry["agents"]]


def test_the_numbers_are_those_of_the_certificate() -> None:
    costs = {"cost": {"mean": 4.129, "lower": 3.58, "upper": 4.5594, "limit": 5.0}}
    played = {"verdict": "certified", "costs": costs, "episodes": 400, "mean_return": 24.469}
    measured = {"episodes": 400, "return": 24.47, "cost": 4.13, "low": 3.58, "high": 4.56}
    assert MAKER.measured(played, 5.0) == {**measured, "verdict": "certified"}
    assert MAKER.measured(played, None) == {**measured, "verdict": ""}


def test_the_model_is_what_show_writes_but_for_what_is_not_read_yet() -> None:
    engine = MAKER.GuardEnv(**MAKER.env_spec("SafetyPointGoal1-v0").kwargs).engine
    text = engine.spec.to_xml()
    assert text.count(' input="vel"') == 1
    assert MAKER.mjcf(engine).split() == [word for word in text.split() if word != 'input="vel"']

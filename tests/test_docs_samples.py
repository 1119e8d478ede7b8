"""What docs/customizing.md shows: its samples run, and its tables are what the code says."""

import dataclasses
import re
from pathlib import Path

import gymnasium
import pytest
from worlds import own_parts

from sb3_guard.envs.engine import Layout
from sb3_guard.envs.extras import Extras
from sb3_guard.envs.sensors import Lidar

PAGE = (Path(__file__).parent.parent / "docs" / "customizing.md").read_text()


def test_samples_run(tmp_path, monkeypatch):
    """Each alone, in the order of the page: files of earlier ones are there, names are not."""
    monkeypatch.chdir(tmp_path)
    (scenario,) = re.findall(r"```yaml\n(.*?)```", PAGE, flags=re.DOTALL)
    Path("my_scenario.yml").write_text(scenario)
    samples = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    assert len(samples) == 9
    known = dict(gymnasium.registry)
    try:
        with own_parts():
            for sample in samples:
                namespace = {"__name__": "customizing"}
                exec(compile(sample, "customizing.md", "exec"), namespace)
                if isinstance(env := namespace["env"], gymnasium.Env):
                    env.reset(seed=0)
                    env.step(env.action_space.sample())
    finally:
        gymnasium.registry.clear()
        gymnasium.registry.update(known)


@pytest.mark.parametrize(
    ("name", "cls"), [("lidar", Lidar), ("observe", Extras), ("layout", Layout)]
)
def test_tables_are_what_the_code_says(name, cls):
    table = PAGE.partition(f"`{name}={{...}}`")[2].partition("| parameter")[2].partition("\n\n")[0]
    rows = re.findall(r"^\| `(\w+)` \| `(.*?)` \|", table, flags=re.MULTILINE)
    assert rows == [(f.name, str(f.default)) for f in dataclasses.fields(cls)]

"""CONTRIBUTING's recipes, followed to the letter on a copy of the package."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text()
RECIPES = dict(re.findall(r"^## Add an? (\w+)\n(.*?)(?=^## |\Z)", TEXT, flags=re.DOTALL | re.M))


def blocks(recipe: str) -> list[tuple[str, str, str]]:
    """File, language and text of each block: the file is the last one named before it, as code."""
    found, before = [], ""
    for piece in re.split(r"^(```\w+\n.*?^```$)", recipe, flags=re.DOTALL | re.M):
        if piece.startswith("```"):
            language, _, text = piece[3:-3].partition("\n")
            names = re.findall(r"`([\w/]+\.(?:py|xml))`", before)
            found += [(names[-1], language, text)] if names else []
        before = piece
    return found


def follow(recipe: str, folder: Path) -> list[Path]:
    """Do what a recipe says below a folder; the files that it makes."""
    made = []
    for name, language, text in blocks(recipe):
        path = folder / name
        if language == "diff":
            lines, at = path.read_text().splitlines(), 0
            for line in text.splitlines():
                if line.startswith("+"):
                    lines.insert(at, line[1:])
                else:
                    at = lines.index(line[1:], at)
                at += 1
            path.write_text("\n".join(lines) + "\n")
        elif path.exists():
            path.write_text(path.read_text() + text)
        else:
            path.write_text(text)
            made.append(path)
    return made


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("copy")
    litter = shutil.ignore_patterns("__pycache__", "pretrained")
    shutil.copytree(ROOT / "sb3_guard", folder / "sb3_guard", ignore=litter)
    shutil.copytree(ROOT / "hyperparams", folder / "hyperparams")
    for recipe in RECIPES.values():
        (file,) = follow(recipe, folder)
        assert file.is_file()
    return folder


@pytest.mark.parametrize("part", ["robot", "task", "constraint", "algorithm"])
def test_a_recipe_is_one_file_and_its_entry_in_fifteen_lines(part):
    file, entry = blocks(RECIPES[part])
    count = 0
    for _, language, text in (file, entry):
        mark = "+" if language == "diff" else ""
        count += sum(line.startswith(mark) for line in text.splitlines() if line.strip())
    assert count <= 15


SCRIPT = """
import json, sys
import sb3_guard
from sb3_guard import train

env = sb3_guard.make("Leave_Puck_8Mines", mines={"size": 1.0, "keepout": 1.0, "num": 1})
steps = []
for seed in range(10):
    env.reset(seed=seed)
    steps += [env.step([1.0, 0.0])[1:] for _ in range(200)]
print(json.dumps({
    "file": sb3_guard.__file__,
    "observed": list(env.unwrapped.observation_layout),
    "gained": sum(step[0] for step in steps),
    "costs": sorted({step[3]["cost_mines"] for step in steps}),
}))
sys.exit(train.main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_what_the_recipes_add_works_together(copy):
    (command,) = re.findall(r"```bash\nsb3-guard train (.*?)\n```", TEXT)
    short = "n_envs:2 n_steps:50 n_critic_updates:2 price:2.0 -n 200 --eval-freq -1"
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *shlex.split(command), *short.split()],
        cwd=copy, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[0])
    assert Path(found["file"]).is_relative_to(copy)
    assert found["observed"] == ["base_angvel", "base_linvel", "last_action", "mines_lidar"]
    assert found["gained"] > 5.0
    assert found["costs"] == [0.0, 1.0]
    assert (copy / "logs" / "trpo_price" / "Leave_Puck_8Mines-v0_1" / "result.json").is_file()


def test_the_recipes_are_in_the_houses_style(copy):
    names = [blocks(recipe)[0][0] for recipe in RECIPES.values()]
    files = [str(copy / name) for name in names if name.endswith(".py")]
    assert len(files) == 3
    for check in (["check"], ["format", "--check"]):
        ruff = [sys.executable, "-m", "ruff", *check, "--config", str(ROOT / "pyproject.toml")]
        done = subprocess.run([*ruff, *files], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr

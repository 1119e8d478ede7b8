"""The examples run, as they are written but for the length of the training, and are short."""

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import gymnasium
import nbformat
import numpy as np
import onnxruntime
import pytest
from nbclient import NotebookClient

import sb3_guard.envs
from sb3_guard import cli
from sb3_guard.algorithms import ALGORITHMS
from sb3_guard.envs.registry import CONSTRAINTS, ROBOTS, TASKS
from sb3_guard.envs.rendering import RenderingError, gl_backend

EXAMPLES = Path(__file__).parents[2] / "examples"
# example: what it prints, in the order of the lines, and the files that it leaves
SAYS = {
    "custom_algorithm": (["cost of an episode: ["], []),
    "custom_constraint": (["steps outside: ["], []),
    "custom_robot": (["26 observations, 2 actions", "return "], ["puck.xml"]),
    "deploy": ([", limit 5.0 per episode"], ["contract.json", "costs.csv", "policy.onnx"]),
    "several_constraints": (["10 episodes: return"], []),
    "train_cpo": (["ep_cost_mean", ", limit 5; "], ["cpo_point.zip"]),
    "tune_with_optuna": (["0 ", "1 ", "limit"], []),
    "your_own_env": (["costs of episodes: [", "off-policy: [", "steps off the middle: ["], []),
}
LONG = "cpo_in_one_file"  # tests/docs/test_cpo_in_one_file.py
LENGTHS = {
    r"1_000_000|[12356]00_000": "200",
    r"n_steps=(1000|500)": "n_steps=20",
    r"(make_model\([^()]*?),?\s*\)": r"\1, n_steps=20)",
    r"batch_size=1000": "batch_size=200",
    r"buffer_size=100_000": "buffer_size=200",
    r"n_trials=20": "n_trials=2",
    r"range\(500\)": "range(3)",
    r'__name__ == "__main__"': "True",
}


def shorten(code: str) -> str:
    for long, short in LENGTHS.items():
        code = re.sub(long, short, code)
    return code


def require_rendering():
    try:
        gl_backend()
    except RenderingError as error:
        pytest.skip(str(error))


@pytest.fixture
def quick(monkeypatch, tmp_path):
    """Episodes of ten steps, a folder of one's own, and no trace of what is registered."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["example.py"])
    monkeypatch.setattr(sb3_guard.envs.suites, "EPISODE_STEPS", 10)
    for name in ("Goal_Point_8Hazards-v0", "Goal_Ant_8Hazards-v0"):
        monkeypatch.setattr(gymnasium.registry[name], "max_episode_steps", 10)
    tables = (ALGORITHMS, ROBOTS, TASKS, CONSTRAINTS, gymnasium.registry)
    before = [dict(table) for table in tables]
    yield tmp_path
    for table, old in zip(tables, before, strict=True):
        table.clear()
        table.update(old)


def test_every_example_is_tried_and_fits_a_page():
    assert len(SAYS) <= 8 and {path.stem for path in EXAMPLES.glob("*.py")} == {*SAYS, LONG}
    for path in EXAMPLES.glob("*.py"):
        text = path.read_text()
        most = {LONG: 180, "deploy": 60}.get(path.stem, 40)
        assert len(text.splitlines()) <= most, path.name
        assert re.match(r'"""How .*[?]', text), path.name


@pytest.mark.parametrize("name", SAYS)
def test_example(name, quick, monkeypatch, capsys):
    if name == "deploy":
        assert (
            cli.main(["export", "--pretrained", "--env", "Goal_Point_8Ghosts", "--n-episodes", "1"])
            == 0
        )
    path = EXAMPLES / f"{name}.py"
    # a module of its own: dataclasses look for it
    module = type(sys)("__example__")
    monkeypatch.setitem(sys.modules, "__example__", module)
    exec(compile(shorten(path.read_text()), path, "exec"), vars(module))
    lines, (says, leaves) = capsys.readouterr().out.splitlines(), SAYS[name]
    for text in says:
        while text not in lines.pop(0):
            assert lines, f"{name} does not say {text!r}"
    assert sorted(one.name for one in quick.iterdir()) == leaves


@pytest.mark.slow
def test_robots_of_other_packages(quick, capsys):
    try:
        runpy.run_path(str(EXAMPLES.parent / "scripts" / "robots.py"))
    except subprocess.CalledProcessError:
        pytest.skip("no package index")
    assert capsys.readouterr().out == "registered WalkingGo1-v0 and ReachingYam-v0\n"


DEPLOY = (EXAMPLES / "deploy.py").read_text()
CONTRACT = {
    "control_step": 10.0,
    "wrappers": [],
    "costs": [
        {"name": "cost_speed", "limit": 2.0, "per": "episode"},
        {"name": "cost_hazards", "limit": 0.5, "per": "step"},
    ],
    "frame_stack": {"frames": 3},
    "trained": {"env": "Mine-v0", "env_kwargs": {"speed": {"limit": 0.01}}},
}
MINE = """import sb3_guard
sb3_guard.register("Mine-v0", "Goal_Point_8Hazards")
"""


class Recorded:
    """A session that notes what it is given."""

    def __init__(self, path):
        self.seen = []

    def run(self, names, values):
        self.seen.append(values)
        return [np.ones((1, 2), np.float32)]


def test_the_loop_around_a_policy_stacks_frames_and_knows_the_costs(quick, monkeypatch, capsys):
    (quick / "my_robots.py").write_text(MINE)
    monkeypatch.setattr(sys, "argv", ["deploy.py", "my_robots"])
    env = gymnasium.make("Goal_Point_8Hazards-v0", speed={"limit": 0.01})
    observation, _ = env.reset(seed=0)
    size = len(observation)
    shapes = {"observation": 3 * size, "last_cost": 1}
    inputs = [{"name": name, "shape": ["batch", n]} for name, n in shapes.items()]
    outputs = [{"name": "action", "low": [-1.0, -1.0], "high": [1.0, 0.5], "stop": [0.0, 0.0]}]
    (quick / "contract.json").write_text(
        json.dumps({**CONTRACT, "inputs": inputs, "outputs": outputs})
    )
    monkeypatch.setattr(onnxruntime, "InferenceSession", Recorded)
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    code = DEPLOY.replace("range(500)", "range(12)").replace("rng.random() < 0.05", "False")
    exec(compile(code, "deploy.py", "exec"), names := {})
    frames, cost = np.tile(observation, 3), 0.0
    for step, values in enumerate(names["policy"].seen):
        frames = np.append(frames[size:], observation)
        np.testing.assert_array_equal(values["observation"], frames[None])
        np.testing.assert_array_equal(values["last_cost"], np.float32([[cost]]))
        observation, _, _, truncated, info = env.step(np.array([1.0, 0.5]))
        cost = info["cost"]
        assert truncated == (step == 9)
        if truncated:
            (observation, _), cost = env.reset(), 0.0
            frames = np.tile(observation, 3)
    assert step == 11 and (costs := np.array(names["costs"]))[:, 0].any()
    assert capsys.readouterr().out.splitlines() == [
        f"cost_speed {costs[:, 0].sum():.2f}, limit 2.0 per episode",
        f"cost_hazards {costs[:, 1].max():.2f}, limit 0.5 per step",
        "12 steps of 2 episodes, stopped 0 times",
    ]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"inputs": [{"name": "budget", "shape": ["batch", 2]}]}, "does not compute budget, which"),
        ({"wrappers": ["MaxCost"]}, "does not compute MaxCost, which contract.json names"),
    ],
)
def test_it_says_what_it_does_not_compute(change, words, quick, monkeypatch):
    inputs = [{"name": "observation", "shape": ["batch", 3]}]
    env = {"trained": {"env": "Goal_Point_8Hazards-v0"}}
    contract = {**CONTRACT, "inputs": inputs, "outputs": [{}], **env, **change}
    (quick / "contract.json").write_text(json.dumps(contract))
    monkeypatch.setattr(onnxruntime, "InferenceSession", Recorded)
    with pytest.raises(SystemExit, match=words):
        exec(compile(DEPLOY, "deploy.py", "exec"), {})


@pytest.mark.parametrize(
    ("argv", "words"),
    [([], "No such file or directory: 'contract.json'"), (["lost"], "No module named 'lost'")],
)
def test_it_says_what_is_absent(argv, words, quick, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["deploy.py", *argv])
    with pytest.raises(SystemExit, match=f"{words}: start it beside policy.onnx; python deploy"):
        exec(compile(DEPLOY, "deploy.py", "exec"), {})


NOTEBOOK = EXAMPLES / "quickstart.ipynb"
SHORT_EPISODES = """
import gymnasium, torch
import sb3_guard
torch.set_num_threads(1)
gymnasium.registry["Goal_Point_8Hazards-v0"].max_episode_steps = 10
"""


@pytest.mark.slow
def test_the_notebook_runs(tmp_path):
    require_rendering()
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    for cell in notebook.cells:
        cell.source = shorten(cell.source).replace("frames=150", "frames=3")
    notebook.cells.insert(0, nbformat.v4.new_code_cell(SHORT_EPISODES))
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": tmp_path}}).execute()
    made = {path.name for path in tmp_path.iterdir()}
    assert made == {"training", "agent", "hazards.mp4"}
    kinds = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert not [output for output in kinds if output.get("name") == "stderr"]
    assert sum("image/png" in output.get("data", {}) for output in kinds) == 4


def test_the_notebook_shows_what_it_is_about_and_stays_small():
    assert NOTEBOOK.stat().st_size < 700_000
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == [*range(1, len(code) + 1)]
    shown = json.dumps([cell.outputs for cell in code])
    assert shown.count("image/png") == 4 and shown.count("<video") == 1
    assert "certified: mean cost" in shown
    assert "/tmp" not in shown and "stderr" not in shown

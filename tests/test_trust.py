"""Data never runs: hostile files and values try to write a file, and none appears."""

import sys
from pathlib import Path

import pytest
import yaml
from cost_envs import CostPoint
from test_commands import TOY, trained

from sb3_guard import CPO, benchmark, enjoy, train
from sb3_guard.zoo import rl_zoo3
from sb3_guard.zoo.hyperparams import build
from sb3_guard.zoo.usage import UsageError
from sb3_guard.zoo.values import parse_value

# What `eval("dict(...)")` without builtins still ran.
ESCAPE = (
    "dict(a=[c for c in ().__class__.__base__.__subclasses__() if c.__name__ == 'Popen'][0]"
    "('touch {}', shell=True))"
)


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A file that appears when anything of a hostile file runs; the current folder has a module."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    path = tmp_path / "trap"
    (tmp_path / "hostile.py").write_text(
        f"open({str(path)!r}, 'w')\nhyperparams = {{'default': {{}}}}\n"
    )
    yield path
    sys.modules.pop("hostile", None)


def test_values_are_read_not_evaluated(trap):
    text = ESCAPE.format(trap)
    assert parse_value(text) == text
    assert not trap.exists()


@pytest.mark.parametrize(
    "entry",
    [
        {"hyperparams": [f"policy_kwargs:{ESCAPE}"]},
        {"env_kwargs": {"a": ESCAPE}},
        {"gym_packages": ["hostile"]},
        {"conf_file": "hostile.py"},
        {"conf_file": "hostile"},
        {"suites": ["hostile:X-v0"]},
        {"hyperparams": {"env_wrapper": "hostile.Wrapper"}},
        {"hyperparams": {"policy": "hostile.Policy"}},
    ],
)
def test_a_grid_file_runs_nothing(tmp_path, trap, entry):
    text = yaml.safe_dump({"suites": ["Goal_Point_8Hazards"], "algos": ["cpo"], **entry})
    (tmp_path / "grid.yml").write_text(text.replace("{}", str(trap)))
    benchmark.main(["--grid", str(tmp_path / "grid.yml"), "--dry-run", "-f", str(tmp_path / "g")])
    assert not trap.exists()


@pytest.fixture
def run(tmp_path):
    return trained(tmp_path / "logs", "--eval-freq", "-1")


def enter(run, file, **entries):
    """Write entries into a file of a run."""
    path = run / "CostPoint-v0" / file
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **entries}))


def test_a_runs_files_run_nothing(tmp_path, trap, run, capsys):
    play = ["--algo", "cpo", *TOY, "-f", str(tmp_path / "logs"), "--no-render", "--n-episodes", "1"]
    go_on = ["-i", str(run), "-n", "240", "--verbose", "0"]
    popen = {"subprocess.Popen": {"args": f"touch {trap}", "shell": True}}
    enter(run, "config.yml", callback=[popen])
    assert enjoy.main(play) == 0  # nobody calls a callback there
    assert train.main(go_on) == 2
    assert "callback: subprocess.Popen" in capsys.readouterr().err
    assert train.main([*go_on, "--trust"]) == 2  # trusted, but not what was trained
    assert "contradicts none of the training so far" in capsys.readouterr().err
    enter(run, "config.yml", callback=None, env_wrapper="hostile.Wrapper")
    assert (enjoy.main(play), train.main(go_on)) == (2, 2)
    enter(run, "config.yml", env_wrapper=None)
    enter(run, "args.yml", gym_packages=["hostile"])
    without = [word for word in play if word not in TOY[:2]]
    assert (enjoy.main(without), train.main(go_on)) == (2, 2)
    assert capsys.readouterr().err.count("--trust") == 4
    assert not trap.exists()
    enjoy.main([*without, "--trust"])
    assert trap.exists()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("policy", "subprocess.Popen"),
        ("callback", [{"subprocess.Popen": {"args": "true"}}]),
        ("replay_buffer_class", "subprocess.Popen"),
        ("env_wrapper", {"subprocess.Popen": {"shell": True}}),
        ("vec_env_wrapper", ["gymnasium.Wrapper"]),
        ("env_wrapper", [["gymnasium.Wrapper"]]),
        ("policy_kwargs", "dict(features_extractor_class=th.hub.subprocess.Popen)"),
        ("policy_kwargs", "dict(features_extractor_class=th.os.PathLike)"),
    ],
)
def test_only_classes_of_their_kind(name, value):
    with pytest.raises(UsageError, match=name):
        build({"n_envs": 1, "n_timesteps": 1, name: value}).callbacks()


@pytest.mark.parametrize(
    "values",
    [
        {"policy_kwargs": "dict(a=exit())"},
        {"normalize": "exit()"},
        {"monitor_kwargs": "exit()"},
        {"callback": "subprocess.Popen"},
    ],
)
def test_rl_zoo_evaluates_nothing_of_ours(values):
    with pytest.raises(UsageError, match=next(iter(values))):
        rl_zoo3.typed(values)


def test_rl_zoos_command_reads_values_without_eval(trap):
    command = f"train --algo cpo --env CostPoint-v0 {' '.join(TOY[:2])} -n 1 -f {trap.parent}"
    escape = f"open({str(trap)!r},'w')"
    with pytest.raises((UsageError, TypeError)):
        rl_zoo3.main([*command.split(), "-params", f"n_envs:{escape}"])
    assert not trap.exists()


class Hostile:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_weights_can_be_loaded_without_the_rest(trap, tmp_path):
    env = CostPoint(10)
    model = CPO("MlpPolicy", env, n_steps=20, seed=0)
    model.gift = Hostile(trap)
    model.save(tmp_path / "gift.zip")
    other = CPO("MlpPolicy", env, n_steps=20, seed=1)
    other.set_parameters(tmp_path / "gift.zip")
    assert not trap.exists()
    for name, learnt in model.policy.state_dict().items():
        assert learnt.equal(other.policy.state_dict()[name])
    CPO.load(tmp_path / "gift.zip")
    assert trap.exists()  # so it was hostile

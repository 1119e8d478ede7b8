"""Data never runs: hostile files and values try to write a file, and none appears."""

import json
import shlex
import shutil
import sys

import gymnasium
import pytest
import yaml
from typed import LENGTH, SMALL, TOY, refused, trained

from sb3_guard import benchmark, certify_agent, enjoy, train
from sb3_guard.fields import parse_value
from sb3_guard.zoo.cli.names import BASES, as_data, classes
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.run.hyperparams import model_arguments

# What `eval("dict(...)")` without builtins still ran.
ESCAPE = (
    "dict(a=[c for c in ().__class__.__base__.__subclasses__() if c.__name__ == 'Popen'][0]"
    "('touch {}', shell=True))"
)
SHORTEST = {"n_timesteps": 1, "seeds": [0]}
COST = "sb3_guard.common.adapters.CostFromFunction"


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A file that appears when anything of a hostile file runs; the current folder has a module."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "trap"
    (tmp_path / "hostile.py").write_text(
        f"open({str(path)!r}, 'w')\nhyperparams = {{'default': {{}}}}\n"
    )
    yield path
    for name in ("hostile", "unittest.__main__"):
        sys.modules.pop(name, None)


def test_values_are_read_not_evaluated(trap):
    text = ESCAPE.format(trap)
    assert parse_value(text) == text
    assert not trap.exists()


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"hyperparams": [f"policy_kwargs:{ESCAPE}"]}, "can't be evaluated"),
        ({"env_kwargs": {"a": ESCAPE}}, "unknown"),
        ({"gym_packages": ["hostile"]}, "then add --gym-packages hostile"),
        ({"gym_packages": ["unittest.__main__"]}, "then add --gym-packages unittest.__main__"),
        ({"conf_file": "hostile.py"}, "then add --conf-file hostile.py"),
        ({"conf_file": "hostile"}, "then add --conf-file hostile"),
        ({"conf_file": "my.yml"}, "then add --conf-file my.yml"),
        ({"tensorboard_log": "events"}, "then add --tensorboard-log events"),
        ({"envs": ["hostile:X-v0"]}, "write --gym-packages hostile --env X-v0"),
        ({"hyperparams": {"env_wrapper": "hostile.Wrapper"}}, "add --gym-packages hostile"),
        ({"hyperparams": {"policy": "hostile.Policy"}}, "add --gym-packages hostile"),
        ({"hyperparams": {"env_wrapper": {COST: {"cost": "hostile:f"}}}}, "add --gym-packages h"),
        ({"hyperparams": {"env_wrapper": {COST: {"cost": "hostile.f"}}}}, "add --gym-packages h"),
    ],
)
def test_a_grid_file_runs_nothing(tmp_path, trap, entry, message, capsys):
    text = yaml.safe_dump({"envs": ["Goal_Point_8Hazards"], "algos": ["cpo"], **SHORTEST, **entry})
    (tmp_path / "grid.yml").write_text(text.replace("{}", str(trap)))
    refused(benchmark.main, ["--grid", "grid.yml", "-f", "grid"], capsys, message)
    assert not trap.exists() and "unittest.__main__" not in sys.modules


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    trained(folder, "--eval-freq", "-1")
    return folder


@pytest.fixture
def run(logs, tmp_path):
    return shutil.copytree(logs, tmp_path / "logs") / "cpo" / "CostPoint-v0_1"


def enter(run, file, **entries):
    """Write entries into a file of a run."""
    path = run / "CostPoint-v0" / file
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **entries}))


def test_a_runs_files_run_nothing(tmp_path, trap, run, capsys):
    play = ["--algo", "cpo", *TOY, "-f", str(tmp_path / "logs"), "--no-render", "--n-episodes", "1"]
    go_on = ["-i", str(run), *TOY[:2], "-n", "240", "--verbose", "0"]
    popen = {"subprocess.Popen": {"args": f"touch {trap}", "shell": True}}
    enter(run, "config.yml", callback=[popen])
    assert enjoy.main(play) == 0  # nobody calls a callback there
    refused(train.main, go_on, capsys, "contradicts unset, with which")
    enter(run, "config.yml", callback=None, env_wrapper="hostile.Wrapper")
    refused(enjoy.main, play, capsys, "add --gym-packages hostile")
    refused(train.main, go_on, capsys, "contradicts unset, with which")
    enter(run, "config.yml", env_wrapper=None)
    enter(run, "args.yml", gym_packages=["hostile"])
    without = [word for word in play if word not in TOY[:2]]
    said = "look at hostile, then add --gym-packages hostile"
    refused(enjoy.main, without, capsys, f"{run} needs gym_packages", said)
    refused(train.main, [*go_on[:2], "-n", "240"], capsys, "then add --gym-packages hostile")
    assert not trap.exists()
    enjoy.main([*without, "--gym-packages", "hostile"])
    assert trap.exists()


RECORDING = [
    ("env_wrapper", "stable_baselines3.common.monitor.Monitor", "filename"),
    ("env_wrapper", "gymnasium.wrappers.RecordVideo", "video_folder"),
    ("vec_env_wrapper", "stable_baselines3.common.vec_env.VecMonitor", "filename"),
    ("vec_env_wrapper", "sb3_guard.common.monitor.CostMonitor", "filename"),
    ("vec_env_wrapper", "stable_baselines3.common.vec_env.VecVideoRecorder", "video_folder"),
]


@pytest.mark.parametrize(("kind", "wrapper", "argument"), RECORDING)
def test_playing_writes_nothing_that_a_runs_files_name(
    tmp_path, run, kind, wrapper, argument, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    mine = tmp_path / "mine.monitor.csv"
    mine.write_text("mine")
    arguments = {argument: "mine" if argument == "filename" else "videos"}
    if wrapper.endswith("VecVideoRecorder"):
        arguments["record_video_trigger"] = None
    enter(run, "config.yml", **{kind: [{wrapper: arguments}]})
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    play, short = ["-f", str(run), *TOY[:2], "--n-episodes", "1"], ["--n-episodes", "100"]
    assert enjoy.main([*play, "--no-render"]) == 0
    assert certify_agent.main(["-f", str(run), *TOY[:2], "--cost-limit", "999", *short]) == 0
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_a_training_writes_what_its_user_names_and_its_evaluations_leave_that(tmp_path):
    file = tmp_path / "mine.monitor.csv"
    monitor = {"stable_baselines3.common.monitor.Monitor": {"filename": str(file)}}
    trained(tmp_path, "-params", "n_envs:1", f"env_wrapper:{monitor}", "--eval-freq", "60")
    assert len(file.read_text().splitlines()) == 2 + 120 // 20  # a header, and each episode


def test_a_run_is_continued_with_the_folders_that_the_user_names_again(tmp_path, run, capsys):
    go_on = ["-i", str(run), *TOY[:2], "-n", "240", "--verbose", "0"]
    for name, value, words in (
        ("tensorboard_log", str(tmp_path / "trap"), "--tensorboard-log"),
        ("track", True, "--track"),
    ):
        enter(run, "args.yml", **{name: value})
        refused(train.main, go_on, capsys, f"{run} needs {name}", f"then add {words}")
        enter(run, "args.yml", **{name: type(value)()})
    assert not list(tmp_path.rglob("trap*"))


@pytest.mark.parametrize("conf", ["both", "both.py"])
def test_a_module_of_parts_and_hyperparameters_registers_once(conf, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "both.py").write_text(
        "import gymnasium\n"
        "gymnasium.register('Both-v0', 'cost_envs:CostPoint')\n"
        "made = open('made', 'a').write('once ')\n"
        "hyperparams = {'default': {'n_timesteps': 60, 'cost_limit': 2}}\n"
    )
    short = [*SMALL, "-conf", conf, "--eval-freq", "-1", "--verbose", "0"]
    try:
        assert not train.main([*short, "--gym-packages", "both", "--env", "Both-v0", *LENGTH])
        assert (tmp_path / "made").read_text() == "once "
    finally:
        sys.modules.pop("both", None)
        gymnasium.registry.pop("Both-v0", None)


@pytest.mark.parametrize("vec_env", ["dummy", pytest.param("subproc", marks=pytest.mark.slow)])
def test_a_file_may_name_a_function_of_a_module_that_the_command_line_names(tmp_path, vec_env):
    (tmp_path / "conf.yml").write_text(
        yaml.safe_dump({"default": {"env_wrapper": {COST: {"cost": "registered_envs:far"}}}})
    )
    run = trained(tmp_path, "-conf", str(tmp_path / "conf.yml"), "--vec-env", vec_env)
    assert json.loads((run / "result.json").read_text())["cost"] > 0


def test_printed_commands_name_the_modules(tmp_path, capsys):
    assert train.main([*TOY, *SMALL, "-n", "120", "-f", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    (line,) = [line for line in lines if "see the agent" in line]
    command = shlex.split(line.partition("see the agent")[2])
    assert command[:2] == ["sb3-guard", "enjoy"]
    assert command[-2:] == ["--gym-packages", "registered_envs"]
    assert enjoy.main([*command[2:], "--no-render", "--n-episodes", "1"]) == 0
    (run,) = (tmp_path / "cpo").iterdir()
    refused(train.main, ["-i", str(run), "-n", "180"], capsys, "add --gym-packages registered_envs")
    assert train.main(["-i", str(run), "-n", "180", *command[-2:]]) == 0


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
        classes(name, value) if name in BASES else model_arguments({name: as_data(name, value)})

"""Grids: refused in full or carried out in full, whatever dies meanwhile."""

import json
import logging
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from test_bad_input import refused
from test_commands import TOY
from test_resume import assert_same_run, environment, lines, runs_of, wait_for

from sb3_guard import benchmark, cli, enjoy, train
from sb3_guard.zoo import grid, run_folder, worker
from sb3_guard.zoo.experiment import complete
from sb3_guard.zoo.live import Board, Progress, duration, read_progress
from sb3_guard.zoo.presets import PRESETS, preset
from sb3_guard.zoo.run_folder import RunFolder, in_use, lock, owner
from sb3_guard.zoo.worker import Outcome, Task

PACKAGE = TOY[:2]
SMALL = [
    *PACKAGE,
    *"-params n_envs:2 n_steps:30 n_critic_updates:3 --eval-freq -1".split(),
    *"--env-kwargs episode_length:25 --device cpu --num-threads 1".split(),
]
GRID = ["--suites", "CostPoint-v0", *SMALL, "-n", "120"]


def in_process(task: Task) -> Outcome:
    """What a worker's process does, without the process."""
    if not task.permit.exists():
        return Outcome("stopped")
    try:
        status = complete(task.args, task.values, task.number, task.command, task.permit, task.name)
    except run_folder.RunInUse:
        return Outcome("in use")
    except Exception as error:
        disk = run_folder.is_disk_error(error)
        return Outcome("no disk" if disk else "failed", f"Traceback\n{error}")
    return Outcome("stopped" if status else "done")


class Here(Executor):
    """An executor that does the work at once, where it is."""

    def __init__(self, *_: object) -> None:
        pass

    def submit(self, fn, /, *args, **kwargs):
        future: Future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@pytest.fixture
def here(monkeypatch):
    """Carry out grids in this process; the tasks, in their order, are in the list."""
    tasks: list[Task] = []

    def work(task: Task) -> Outcome:
        tasks.append(task)
        return in_process(task)

    monkeypatch.setattr(grid, "LocalExecutor", Here)
    monkeypatch.setattr(grid, "work", work)
    monkeypatch.setattr(grid, "PATIENCE", 0.0)
    monkeypatch.setattr(grid, "POLL", 0.01)
    return tasks


def results(folder: Path) -> dict[str, dict]:
    return {
        str(path.parent.relative_to(folder)): json.loads(path.read_text())
        for path in sorted(folder.glob("*/*/result.json"))
    }


def without_clock(result: dict) -> dict:
    return {name: value for name, value in result.items() if name != "seconds"}


# what a grid is


def test_presets_are_the_papers():
    sizes = {name: len(preset(name)) for name in PRESETS}
    robots = 9
    assert sizes == {
        "paper45": 45 * 8, "main8": 8 * 8, "q1": 8 * 8, "q2": 2 * robots + 2 * 7, "q3": 4 * 8,
        "q4": robots * 8, "q5": robots * 3, "q6": robots * 3, "q7": robots * 3, "q8": 45 * 8,
        "ladder": 10 * 8,
    }  # fmt: skip
    paper = {suite for suite, _ in preset("paper45")}
    assert {suite for suite, _ in preset("main8")} < paper
    assert sum(suite.endswith("Ghosts-v0") for suite in paper) == robots
    for name in PRESETS:  # scores are relative to TRPO's
        assert {suite for suite, _ in preset(name)} == {s for s, a in preset(name) if a == "trpo"}


@pytest.mark.parametrize("name", ["q2", "ladder"])
def test_every_run_of_a_preset_is_valid(name, tmp_path):
    args = {**train.DEFAULTS, "log_folder": str(tmp_path)}
    runs = grid.expand(preset(name), [0, 1], args)
    assert len({run.path for run in runs}) == len(runs) == 2 * len(preset(name))
    assert [run.number for run in runs] == [1] * (len(runs) // 2) + [2] * (len(runs) // 2)
    for run in runs:  # the paper's lengths
        long = "_Ant_" in run.args["env"] or "_Walker_" in run.args["env"]
        assert run.steps == (30_000_000 if long else 6_000_000)


def test_scale_shortens_every_run_alike(tmp_path, capsys):
    arguments = ["--suites", "Goal_Point_8Hazards", "Goal_Ant_8Ghosts", "--algos", "cpo", "trpo_sl"]
    arguments += ["--seeds", "3", "--scale", "0.01", "-f", str(tmp_path / "a"), "--dry-run"]
    assert benchmark.main(arguments) == 0
    out = capsys.readouterr().out.splitlines()
    assert [line.split()[2] for line in out[:4]] == ["60,000"] * 2 + ["300,000"] * 2
    assert out[0].split()[:2] == ["new", str(tmp_path / "a" / "cpo" / "Goal_Point_8Hazards-v0_4")]
    assert out[4] == "4 runs (0 done, 0 resume, 4 new), 720,000 steps in all"
    assert list(tmp_path.iterdir()) == []
    (run,) = grid.expand([("Goal_Point_8Hazards", "trpo_sl")], [0], train.DEFAULTS, scale=0.5)
    assert run.values["warmup"] == pytest.approx(1 / 3)  # a ratio of whatever the length is


def test_a_hyperparameter_goes_to_those_that_have_it():
    args = {**train.DEFAULTS, "hyperparams": {"cost_limit": 5.0}}
    cpo, ppo = grid.expand([("Goal_Point_8Hazards", a) for a in ("cpo", "ppo")], [0], args)
    assert (cpo.values["cost_limit"], cpo.ignored) == (5.0, [])
    assert ("cost_limit" in ppo.values, ppo.ignored) == (False, ["cost_limit"])


def test_a_grid_file_is_the_flags(tmp_path, monkeypatch, here, capsys):
    file = tmp_path / "my.yml"
    file.write_text(
        "suites: [CostPoint-v0]\nalgos: [cpo, trpo]\nseeds: [1]\nn_timesteps: 1e3\nscale: 0.06\n"
        "eval_freq: -1\ngym_packages: [registered_envs]\nenv_kwargs: {episode_length: 25}\n"
        "hyperparams: {n_envs: 2, n_steps: 30, n_critic_updates: 3, policy: MlpPolicy}\n"
    )
    folder = tmp_path / "grid"
    # What is given now wins; hyper-parameters are merged.
    arguments = ["--grid", str(file), "-f", str(folder), "--algos", "trpo", "-params", "n_envs:1"]
    assert benchmark.main(arguments) == 0
    (run,) = folder.glob("*/*_*")
    assert run == folder / "trpo" / "CostPoint-v0_2"
    values = RunFolder(run).hyperparams()
    assert (values["n_timesteps"], values["n_envs"], values["n_steps"]) == (60, 1, 30)
    # The folder's record is such a file: it is enough to go on.
    assert yaml.safe_load((folder / "grid.yml").read_text())["algos"] == ["trpo"]
    capsys.readouterr()
    assert benchmark.main(["-f", str(folder), "--dry-run"]) == 0
    assert capsys.readouterr().out.startswith(f"done    {run}  60 steps")


@pytest.mark.parametrize(
    ("change", "kept"),
    [
        ([], False),
        (["--seeds", "0", "1"], False),  # a grid may grow
        (["--suites", "CostPoint-v0", "Filmed-v0", "--algos", "trpo"], False),
        (["--suites", "Filmed-v0"], True),
        (["--algos", "cpo"], True),
        (["--checkpoint-every", "0"], True),
    ],
)
def test_an_earlier_grid_of_the_folder_is_not_forgotten(change, kept, tmp_path, here, capsys):
    arguments = [*GRID[:2], "--algos", "trpo", "--seeds", "0", *SMALL, "-n", "60"]
    arguments += ["-f", str(tmp_path)]
    assert benchmark.main(arguments) == 0
    before = (tmp_path / "grid.yml").read_text()
    capsys.readouterr()
    assert benchmark.main([*arguments, *change]) == 0
    assert (tmp_path / "grid-1.yml").exists() == kept
    out = capsys.readouterr().out
    if kept:
        assert (tmp_path / "grid-1.yml").read_text() == before
        line = f"sb3-guard benchmark -f {tmp_path} --grid {tmp_path / 'grid-1.yml'}"
        assert line in out
        assert benchmark.main([*line.split()[2:], "--dry-run"]) == 0
        assert "1 runs (1 done" in capsys.readouterr().out
        for flags in (line.split()[2:], [*arguments, *change], line.split()[2:]):  # to and fro
            assert benchmark.main(flags) == 0
        assert len(list(tmp_path.glob("grid-*.yml"))) == 2


REFUSED = [
    (["--suites", "Goal_Point_8Hazards", "Goal_Pint_8Hazards"], ["'Pint'", "'Point'"]),
    (["--algos", "cpo", "pcpq"], ["unknown algorithm 'pcpq'", "did you mean 'pcpo'?"]),
    (["--preset", "main9"], ["--preset", "leave out"]),
    (["--seeds", "-1"], ["--seeds: -1", "from 0"]),
    (["--seeds", "one"], ["--seeds", "'one'"]),
    (["--scale", "0"], ["--scale", "above 0"]),
    (["--scale", "half"], ["--scale", "'half'"]),
    (["-n", "0"], ["-n", "at least 1"]),
    (["-params", "cost_limt:5"], ["none of the algorithms", "'cost_limt'", "'cost_limit'"]),
    (["-params", "gamma:1.5"], ["cpo on Goal_Point_8Hazards-v0", "gamma", "1.5"]),
    (["--env-kwargs", "hazards:{'num':200}"], ["Goal_Point_8Hazards-v0", "LayoutError"]),
    (["--device", "abacus"], ["abacus"]),
    (["--jobs", "0"], ["--jobs", "at least 1"]),
    (["--executor", "dask"], ["needs --scheduler"]),
    (["--scheduler", "tcp://localhost:1"], ["goes with --executor dask"]),
    (["--executor", "dask", "--scheduler", "x", "--jobs", "2"], ["--nthreads"]),
    (["--executor", "slurm"], ["--executor", "'slurm'"]),
    (["--grid", "absent.yml"], ["there is no grid file absent.yml"]),
    (["--suite", "x"], ["unknown flag --suite", "--suites"]),
    (["-f", "/dev/null/x"], ["/dev/null/x", "choose another with -f"]),
]


@pytest.mark.parametrize(("arguments", "parts"), REFUSED, ids=lambda one: " ".join(one)[:40])
def test_refused_before_anything_starts(arguments, parts, capsys, tmp_path, monkeypatch, here):
    monkeypatch.chdir(tmp_path)
    start = ["--suites", "Goal_Point_8Hazards", "--algos", "cpo", "trpo", "-n", "100"]
    refused(benchmark.main, [*start, *arguments], capsys, *parts)
    assert (here, list(tmp_path.iterdir())) == ([], [])


GRID_FILES = [
    ("suites: [a", "is not valid YAML"),
    ("just text", "must map flags to values"),
    ("seeds: 1\nsuites: [Goal_Point_8Hazards]\nseeds: 2", "line 3 has the key 'seeds' again"),
    ("suits: [CostPoint-v0]", "unknown entry 'suits'; did you mean 'suites'?"),
    ("suites: [Goal_Point_8Hazards]\nscale: 0", "g.yml: argument --scale"),
    ("suites: []", "suites: [] is not allowed; it must be one value or a"),
    ("suites: {Goal_Point_8Hazards: 1}", "it must be one value or a list of them"),
    (
        "suites: [Goal_Point_8Hazards]\nscale: [1, 2]",
        "scale: [1, 2] is not allowed; it must be",
    ),
    ("suites: [Goal_Point_8Hazards]\ntrack: maybe", "'maybe' is not allowed; it must be true or"),
    ("suites: [Goal_Point_8Hazards]\nn_timesteps: true", "it must be one value"),
    ("suites: [Goal_Point_8Hazards]\nhyperparams: [a]", "it must be a mapping"),
    ("suites: [Goal_Point_8Hazards]\nseeds: [zero]", "g.yml: argument --seeds: invalid int value"),
    ("seeds: [0]", "which grid?"),
]


@pytest.mark.parametrize(("content", "part"), GRID_FILES)
def test_bad_grid_file(content, part, capsys, tmp_path):
    (tmp_path / "g.yml").write_text(content)
    folder = tmp_path / "logs"
    refused(benchmark.main, ["--grid", str(tmp_path / "g.yml"), "-f", str(folder)], capsys, part)
    assert not folder.exists()


# what becomes of it


def test_runs_are_runs_of_train(tmp_path, here, capsys):
    folder = tmp_path / "grid"
    assert benchmark.main([*GRID, "--algos", "cpo", "--seeds", "3", "-f", str(folder)]) == 0
    one = ["--algo", "cpo", "--env", "CostPoint-v0", *SMALL, "-n", "120", "--seed", "3"]
    assert train.main([*one, "-f", str(tmp_path / "train"), "--verbose", "0"]) == 0
    # The number is the seed's, so that a seed is found again.
    (folder / "cpo" / "CostPoint-v0_4").rename(folder / "cpo" / "CostPoint-v0_1")
    mine, other = runs_of(folder), runs_of(tmp_path / "train")
    for name in ("config.yml", "args.yml"):
        a, b = (yaml.safe_load((run / "CostPoint-v0" / name).read_text()) for run in (mine, other))
        for flag in ("log_folder", "progress", "verbose"):
            a.pop(flag, None), b.pop(flag, None)
        assert a == b
    assert (mine / "0.monitor.csv").read_text().count("\n") > 3
    a, b = (next(iter(results(f).values())) for f in (folder, tmp_path / "train"))
    assert without_clock(a) == without_clock(b)
    assert enjoy.main([*TOY, "-f", str(folder), "--no-render", "-n", "25"]) == 0


def test_done_is_skipped_and_half_written_made_whole(tmp_path, here, capsys):
    arguments = [*GRID, "--algos", "cpo", "trpo", "--seeds", "0", "-f", str(tmp_path)]
    assert benchmark.main(arguments) == 0
    whole = results(tmp_path)
    assert len(here) == 2
    capsys.readouterr()

    assert benchmark.main(arguments) == 0
    assert len(here) == 2
    assert "2 runs in" in capsys.readouterr().out

    cpo, trpo = tmp_path / "cpo" / "CostPoint-v0_1", tmp_path / "trpo" / "CostPoint-v0_1"
    # A corrupt result: the checkpoint of its end is still there.
    (cpo / "result.json").write_text('{"n_timest')
    # Killed while the folder was being made: nothing of the run, or half of its configuration.
    for path in (*trpo.glob("*.*"), trpo / "CostPoint-v0" / "args.yml"):
        path.unlink()
    assert benchmark.main(arguments) == 0
    assert len(here) == 4
    assert "1 go on from their checkpoints, 1 are new" in capsys.readouterr().out
    after = results(tmp_path)
    assert {k: without_clock(v) for k, v in whole.items()} == {
        k: without_clock(v) for k, v in after.items()
    }


def test_another_run_in_the_folder_is_not_touched(tmp_path, here, capsys):
    arguments = [*GRID, "--algos", "cpo", "--seeds", "0", "-f", str(tmp_path)]
    assert benchmark.main(arguments) == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for change, part in (
        (["-params", "cost_limit:5"], "cost_limit: 0.0 there, 5.0 here"),
        (["-n", "240"], "n_timesteps: 120 there, 240 here"),
        (["--eval-freq", "60"], "eval_freq: -1 there, 60 here"),
    ):
        refused(benchmark.main, [*arguments, *change], capsys, "holds another run", part, "-f")
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    # Another grid that contains it, with flags that only say how to watch.
    more = [*arguments, "--seeds", "0", "1", "--checkpoint-every", "0"]
    assert benchmark.main(more) == 0
    assert len(here) == 2


def test_a_warm_start_is_another_run(tmp_path, here, capsys):
    one = ["--algo", "cpo", "--env", *GRID[1:], "--verbose", "0"]
    assert train.main([*one, "--seed", "5", "-f", str(tmp_path / "first")]) == 0
    model = str(runs_of(tmp_path / "first") / "CostPoint-v0.zip")
    assert train.main([*one, "--seed", "0", "-i", model, "-f", str(tmp_path / "grid")]) == 0
    refused(
        train.main, [*one, "--seeds", "0", "-f", str(tmp_path / "grid")], capsys,
        "holds another run", f"trained_agent: {model} there, none here",
    )  # fmt: skip


@pytest.mark.parametrize("failures", [1, 3])
def test_failures_are_retried_twice(failures, tmp_path, here, monkeypatch, capsys):
    left = {"n": failures}

    def work(task: Task) -> Outcome:
        here.append(task)
        if task.args["algo"] == "cpo" and left["n"]:
            left["n"] -= 1
            return Outcome("failed", "Traceback …\nValueError: no luck")
        return in_process(task)

    monkeypatch.setattr(grid, "work", work)
    arguments = [*GRID, "--algos", "cpo", "trpo", "--seeds", "0", "-f", str(tmp_path)]
    assert benchmark.main(arguments) == (0 if failures == 1 else 1)
    assert [t.attempt for t in here if t.args["algo"] == "cpo"] == [1, 2, 3][: failures + 1]
    done = {"trpo/CostPoint-v0_1"} | ({"cpo/CostPoint-v0_1"} if failures == 1 else set())
    assert results(tmp_path).keys() == done
    out, err = capsys.readouterr()
    assert "failed, is tried again: cpo on CostPoint-v0, seed 0: ValueError: no luck" in out
    if failures == 3:
        assert "failed: cpo on CostPoint-v0, seed 0: ValueError: no luck" in err
        assert f"Go on with: sb3-guard benchmark -f {tmp_path}" in out
        # Once more: the failed one is tried again, the other is not.
        assert benchmark.main(["-f", str(tmp_path)]) == 0
        assert [t.args["algo"] for t in here][-1] == "cpo" and len(here) == 5


def test_a_run_that_another_process_has_is_waited_for(tmp_path, here, monkeypatch, capsys):
    run = tmp_path / "cpo" / "CostPoint-v0_1"
    run.mkdir(parents=True)
    held = lock(run)
    held.__enter__()
    whole = grid.in_use

    def busy(path: Path) -> bool:
        assert path == run and whole(path)
        held.__exit__(None, None, None)
        return whole(path)

    monkeypatch.setattr(grid, "in_use", busy)
    arguments = [*GRID, "--algos", "cpo", "trpo", "--seeds", "0", "-f", str(tmp_path)]
    assert benchmark.main(arguments) == 0
    assert [task.args["algo"] for task in here] == ["cpo", "trpo", "cpo"]
    assert len(results(tmp_path)) == 2
    assert {task.attempt for task in here} == {1}  # to wait is not to fail


def test_a_full_disk_stops_the_grid(tmp_path, here, capsys):
    arguments = [*GRID, "--algos", "trpo", "cpo", "pcpo", "--seeds", "0", "-f", str(tmp_path)]
    assert benchmark.main([*arguments, "--algos", "trpo"]) == 0
    before = results(tmp_path)
    run = tmp_path / "cpo" / "CostPoint-v0_1"
    run.mkdir(parents=True)
    (run / "0.monitor.csv").symlink_to("/dev/full")
    assert benchmark.main(arguments) == 1
    err = capsys.readouterr().err
    assert f"can't write to {run}: No space left on device" in err
    assert "what was written before is intact" in err and "Traceback" not in err
    assert "UsageError" not in err
    assert before.items() <= results(tmp_path).items()
    assert [task.args["algo"] for task in here] == ["trpo", "cpo", "pcpo"]  # no retries
    (run / "0.monitor.csv").unlink()  # room is made
    assert benchmark.main(["-f", str(tmp_path)]) == 0
    assert len(results(tmp_path)) == 3


def test_a_result_that_is_not_where_it_should_be(tmp_path, here, monkeypatch, capsys):
    def elsewhere(task: Task) -> Outcome:
        moved = {**task.args, "log_folder": str(tmp_path / "elsewhere")}
        (tmp_path / "grid" / "cpo" / "CostPoint-v0_1" / "CostPoint-v0").mkdir(
            parents=True, exist_ok=True
        )
        (tmp_path / "grid" / "cpo" / "CostPoint-v0_1" / "CostPoint-v0" / "args.yml").touch()
        return in_process(replace(task, args=moved))

    monkeypatch.setattr(grid, "work", elsewhere)
    arguments = [*GRID, "--algos", "cpo", "--seeds", "0", "-f", str(tmp_path / "grid")]
    assert benchmark.main(arguments) == 1
    assert "the folder must be on a disk that all workers share" in capsys.readouterr().err


def test_a_result_that_a_shared_disk_shows_late(tmp_path, here, monkeypatch):
    """And the whole run folder with it."""
    whole, asked = grid.is_run, []

    def late(path: Path) -> bool:
        asked.append(path)
        return len(asked) > 3 and whole(path)

    monkeypatch.setattr(grid, "PATIENCE", 30.0)
    monkeypatch.setattr(grid, "is_run", late)
    monkeypatch.setattr(grid, "RunFolder", lambda path: asked[3] and RunFolder(path))
    assert benchmark.main([*GRID, "--algos", "cpo", "--seeds", "0", "-f", str(tmp_path)]) == 0
    assert len(here) == 1 and len(asked) > 3


# locks


def test_a_lock_says_on_whose_behalf(tmp_path):
    with lock(tmp_path, "a grid"):
        assert owner(tmp_path)["grid"] == "a grid" and in_use(tmp_path)
    assert owner(tmp_path) == {} and not in_use(tmp_path)


def test_a_silent_owner_elsewhere_is_succeeded(tmp_path, monkeypatch):
    path = tmp_path / ".lock"
    path.write_text(json.dumps({"host": "elsewhere", "pid": 1}))
    assert in_use(tmp_path)
    old = time.time() - run_folder.SILENCE - 5
    os.utime(path, (old, old))
    with lock(tmp_path):
        # Who is here gives signs of life.
        assert time.time() - path.stat().st_mtime < 5
    monkeypatch.setattr(run_folder, "BEAT", 0.05)
    with lock(tmp_path):
        os.utime(path, (old, old))
        end = time.monotonic() + 10
        while time.time() - path.stat().st_mtime > 5:
            assert time.monotonic() < end
            time.sleep(0.01)


def test_a_sleeper_whose_run_was_taken_over_ends(tmp_path):
    script = (
        "import pathlib, time\n"
        "from sb3_guard.zoo import run_folder\n"
        "run_folder.BEAT = 0.05\n"
        f"folder = pathlib.Path({str(tmp_path)!r})\n"
        "with run_folder.lock(folder):\n"
        '    (folder / ".lock").write_text(\'{"host": "elsewhere", "pid": 7}\')\n'
        "    time.sleep(30)\n"
        "    print('alive')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert "was taken over by process 7 on elsewhere" in done.stderr


# what is shown


def test_progress_is_read_from_the_folder(tmp_path):
    path = tmp_path / "progress.csv"
    assert read_progress(tmp_path) == Progress() or True
    names = "rollout/ep_rew_mean,time/total_timesteps,rollout/ep_cost_mean"
    path.write_text(f"{names}\n1.5,60,2.5\n,,9.5\n1.75,120,3.")  # being written
    assert read_progress(tmp_path) == Progress(60, 1.5, 9.5)
    path.write_text(names + "\n" + "".join(f"{i},{i},{i}\n" for i in range(20_000)))
    assert read_progress(tmp_path) == Progress(19_999, 19_999.0, 19_999.0)
    path.write_text("")
    assert read_progress(tmp_path).steps == 0
    assert read_progress(tmp_path / "absent").steps == 0


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(5, "5 s"), (300, "5 min"), (11_100, "3 h 05 min"), (400_000, "4.6 days"),
     (float("inf"), "?")],
)  # fmt: skip
def test_durations_in_words(seconds, text):
    assert duration(seconds) == text


def test_table_of_what_runs(tmp_path):
    from rich.console import Console

    args = {**train.DEFAULTS, "log_folder": str(tmp_path)}
    runs = grid.expand([("Goal_Point_8Hazards", a) for a in ("cpo", "trpo")], [0, 1], args)
    for run, state in zip(runs, ("running", "failed", "done", "waiting"), strict=True):
        run.state = state
    board = Board("logs/x")
    board.update(runs)
    board._first[runs[0]] = (time.monotonic() - 100, 0)
    board.progress[runs[0]] = Progress(1_500_000, 12.345, 67.891)
    console = Console(width=130, record=True, file=open(os.devnull, "w"))
    console.print(board.table())
    text = console.export_text()
    for part in (
        "logs/x: 1 of 4 done", "1 running", "1 failed", "1 waiting", "1,500,000", "12.35", "67.89",
        "Goal_Point_8Hazards-v0", "5 min",  # 4.5e6 steps at 15,000 a second
    ):  # fmt: skip
        assert part in text, text
    assert sum("Goal_Point" in line for line in text.splitlines()) == 2


# train --seeds


def test_seeds_of_train(tmp_path, here, capsys):
    one = ["--algo", "cpo", "--env", "CostPoint-v0", *SMALL, "-n", "60", "-f", str(tmp_path)]
    assert train.main([*one, "--seeds", "0", "4", "--verbose", "0"]) == 0
    assert capsys.readouterr() == ("", "")
    assert list(results(tmp_path)) == ["cpo/CostPoint-v0_1", "cpo/CostPoint-v0_5"]
    assert train.main([*one, "--seeds", "0", "4", "5"]) == 0
    assert len(here) == 3 and "2 are done" in capsys.readouterr().out
    assert not (tmp_path / "grid.yml").exists()


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--seeds", "0", "--seed", "1"], "not allowed with"),
        (["--seeds", "0", "-i", "x"], "-i is for a single run"),
        (["--seeds", "0", "--uuid"], "--uuid is for a single run"),
        (["--jobs", "2"], "--jobs goes with several seeds"),
    ],
)
def test_seeds_of_train_refused(arguments, part, capsys):
    refused(train.main, arguments, capsys, part)


# real processes


def task(tmp_path: Path, **changes) -> Task:
    args = {**train.DEFAULTS, **vars(train.parser().parse_args([*SMALL, "-n", "60"]))}
    args |= {"log_folder": str(tmp_path), **changes}
    (run,) = grid.expand([("CostPoint-v0", "cpo")], [0], args)
    permit = tmp_path / "permit"
    permit.touch()
    return Task({**run.args, **changes}, run.values, 1, "command", permit, 1)


def test_a_failure_leaves_its_traceback(tmp_path):
    one = task(tmp_path)
    one.values["env_kwargs"] = {"episode_length": "long"}
    outcome = worker.work(one)
    assert outcome.state == "failed"
    text = (tmp_path / "cpo" / "CostPoint-v0_1" / "error.txt").read_text()
    for part in ("attempt 1", "Traceback (most recent call last)", "experiment.py", "UsageError"):
        assert part in text
    assert text.rstrip().endswith(outcome.text.splitlines()[-1])
    one.permit.unlink()
    assert worker.work(one) == Outcome("stopped")


def start(arguments: list[str], **kwargs) -> subprocess.Popen:
    command = [sys.executable, "-m", "sb3_guard.benchmark", *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment(), **pipes, **kwargs)


def children(process: subprocess.Popen) -> list[int]:
    """The processes that its threads have started."""
    tasks = Path(f"/proc/{process.pid}/task").glob("*/children")
    found = [int(pid) for path in tasks for pid in path.read_text().split()]
    assert found
    return found


def alone(folder: Path, algo: str) -> Path:
    """The folder of a grid with the runs of one algorithm only."""
    moved = folder.with_name(f"{folder.name}-{algo}")
    moved.mkdir()
    (folder / algo).rename(moved / algo)
    return moved


def episodes(folder: Path) -> int:
    return sum(lines(path) for path in folder.rglob("0.monitor.csv"))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
def test_whatever_dies_the_grid_is_the_same(tmp_path):
    """Grid killed, worker killed, grid asked to stop: bit for bit the grid of one go."""
    arguments = ["--suites", "CostPoint-v0", *SMALL, "--algos", "cpo", "trpo", "--seeds", "0"]
    arguments += ["-n", "6000", "--checkpoint-every", "0", "--jobs", "2"]
    folder = tmp_path / "cut"
    with start([*arguments, "-f", str(folder)]) as process:
        wait_for(lambda: episodes(folder) > 60, process)
        workers = children(process)
        process.kill()
    end = time.monotonic() + 10
    while any(Path(f"/proc/{pid}").exists() for pid in workers):  # they end with it
        assert time.monotonic() < end
        time.sleep(0.05)
    before = episodes(folder)
    with start(["-f", str(folder), "--jobs", "2"]) as process:
        wait_for(lambda: episodes(folder) > before + 40, process)
        os.kill(children(process)[0], signal.SIGKILL)
        before = episodes(folder)
        wait_for(lambda: episodes(folder) > before + 60, process)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "was ended by SIGKILL" in out
    assert f"Go on with: sb3-guard benchmark -f {folder} --jobs 2" in out
    assert "Stopping after the rollouts under way" in err and "Traceback" not in err + out
    assert results(folder) == {}
    with start(["-f", str(folder), "--jobs", "2"]) as process:
        out, err = process.communicate(timeout=300)
    assert process.returncode == 0, out + err
    assert "2 go on from their checkpoints" in out
    with start([*arguments, "-f", str(tmp_path / "whole")]) as process:
        process.communicate(timeout=300)
    for path in folder.glob("*/*/error.txt"):
        path.unlink()
    for algo in ("cpo", "trpo"):
        assert_same_run(alone(tmp_path / "whole", algo), alone(folder, algo))


@pytest.mark.slow
def test_two_grids_on_one_folder(tmp_path):
    """Nothing is done twice, and both end when everything is done."""
    arguments = ["--suites", "CostPoint-v0", *SMALL, "--algos", "cpo", "trpo", "--seeds", "0"]
    arguments += ["-n", "6000", "--jobs", "1", "-f", str(tmp_path)]
    with start(arguments) as one, start(arguments) as other:
        said = [process.communicate(timeout=300) for process in (one, other)]
        assert (one.returncode, other.returncode) == (0, 0), said
    assert len(results(tmp_path)) == 2
    text = "".join(out for out, _ in said)
    assert text.count("started: cpo") == text.count("started: trpo") == 1


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_twice_asked_to_stop(number, tmp_path):
    """The second time, it ends at once, and takes its workers along."""
    arguments = [*GRID, "-n", "60000", "-params", "n_steps:30000", "--algos", "cpo", "--seeds", "0"]
    with start([*arguments, "-f", str(tmp_path)]) as process:
        wait_for(lambda: episodes(tmp_path) > 2, process)
        workers = children(process)
        process.send_signal(number)
        time.sleep(1.0)
        process.send_signal(number)
        out, err = process.communicate(timeout=20)
    assert process.returncode == 130 and "Traceback" not in out + err
    assert not any(Path(f"/proc/{pid}").exists() for pid in workers)


# Dask


def test_without_dask(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    arguments = [*GRID, "--algos", "cpo", "-f", str(tmp_path), "--executor", "dask"]
    arguments += ["--scheduler", "tcp://127.0.0.1:1"]
    refused(benchmark.main, arguments, capsys, "needs Dask's scheduler", "pip install distributed")


def test_the_scheduler_dies(tmp_path, monkeypatch, capsys, here):
    class Dying(Here):
        """Dask cancels what is under way when its scheduler is gone."""

        def submit(self, fn, /, *args, **kwargs):
            future: Future = Future()
            if args[0].args["algo"] == "trpo":
                future.cancel()
                future.set_running_or_notify_cancel()
                return future
            return super().submit(fn, *args, **kwargs)

    monkeypatch.setattr(grid, "LocalExecutor", Dying)
    arguments = [*GRID, "--algos", "cpo", "trpo", "--seeds", "0", "-f", str(tmp_path)]
    refused(
        benchmark.main, arguments, capsys,
        "the workers are gone, or the scheduler is",
        f"go on with: sb3-guard benchmark -f {tmp_path}",
    )  # fmt: skip
    assert not list(tmp_path.glob(".grid-*"))  # so that what still runs somewhere ends


def test_no_scheduler_there(tmp_path, monkeypatch, capsys):
    distributed = pytest.importorskip("distributed")
    whole = distributed.Client.__init__
    monkeypatch.setattr(
        distributed.Client, "__init__", lambda self, a, timeout, **k: whole(self, a, timeout=1, **k)
    )
    arguments = [*GRID, "--algos", "cpo", "-f", str(tmp_path), "--executor", "dask"]
    for address in ("tcp://127.0.0.1:1", "nonsense"):
        refused(
            benchmark.main, [*arguments, "--scheduler", address], capsys,
            f"no Dask scheduler answers at {address}", "start one with: dask scheduler",
        )  # fmt: skip
    # Its own tracebacks would bury what is said here.
    assert not logging.getLogger("distributed.client").isEnabledFor(logging.ERROR)


@pytest.mark.slow
def test_dask_with_a_worker_killed(tmp_path):
    """A real scheduler and two workers, one killed: nothing is lost, nothing done twice."""
    pytest.importorskip("distributed")
    address = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment()}
    place = ["--scheduler-file", str(address)]
    processes = []

    def begin(*arguments: str) -> subprocess.Popen:
        processes.append(subprocess.Popen([*dask, *arguments, *place], cwd=tmp_path, **quiet))
        return processes[-1]

    try:
        scheduler = begin(
            "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"
        )
        wait_for(address.exists, scheduler)
        worker_flags = ["--nthreads", "1", "--no-nanny", "--no-dashboard"]
        workers = [begin("distributed.cli.dask_worker", *worker_flags) for _ in range(2)]
        folder = tmp_path / "grid"
        arguments = ["--suites", "CostPoint-v0", *SMALL, "--algos", "cpo", "trpo", "--seeds", "0"]
        arguments += ["-n", "6000", "--checkpoint-every", "0", "-f", str(folder)]
        where = json.loads(address.read_text())["address"]
        with start([*arguments, "--executor", "dask", "--scheduler", where]) as process:

            def both_run() -> bool:
                logs = list(folder.glob("*/*/0.monitor.csv"))
                return len(logs) == 2 and all(lines(path) > 30 for path in logs)

            wait_for(both_run, process, 120)
            workers[0].kill()
            out, err = process.communicate(timeout=300)
        assert process.returncode == 0, out + err
    finally:
        for one in processes:
            one.kill()
            one.wait()
    assert len(results(folder)) == 2
    # One go on this machine comes to the same, to the last bit.
    with start([*arguments[:-1], str(tmp_path / "whole")]) as process:
        process.communicate(timeout=300)
    for algo in ("cpo", "trpo"):
        assert_same_run(alone(tmp_path / "whole", algo), alone(folder, algo))


def test_the_command_has_its_names(capsys):
    assert cli.main(["benchmark", "--seeds"]) == 2
    with pytest.raises(SystemExit):
        cli.main(["benchmark", "--help"])
    assert "python -m sb3_guard.benchmark --preset main8" in capsys.readouterr().out

"""Grids: refused in full or carried out in full, whatever dies meanwhile."""

import gc
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from killed import assert_same_run, environment, lines, runs_of
from processes import wait_for
from typed import TOY, refused

from sb3_guard import benchmark, enjoy, train
from sb3_guard.zoo.grids import grid
from sb3_guard.zoo.grids.presets import PRESETS
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder, lock
from sb3_guard.zoo.run.run import Run

SUPPORT = Path(__file__).parents[1] / "support"
PACKAGE = TOY[:2]
SMALL = [
    *PACKAGE,
    *"-params n_envs:2 n_steps:30 n_critic_updates:3 cost_limit:2 --eval-freq -1".split(),
    *"--env-kwargs episode_length:25 --device cpu --num-threads 1".split(),
]
GRID = ["--envs", "CostPoint-v0", *SMALL, "-n", "120"]


class Here(Executor):
    """Does the work at once, in this process."""

    def __init__(self) -> None:
        #: the runs carried out, in their order
        self.runs: list[grid.GridRun] = []
        self.before: Callable[[grid.GridRun], object] = lambda run: None

    def submit(self, function, run, /, *args) -> Future:
        self.runs.append(run)
        future: Future = Future()
        try:
            self.before(run)
            future.set_result(function(run, *args))
        except Exception as error:
            future.set_exception(error)
        return future


@pytest.fixture
def here(monkeypatch):
    """Carry out grids in this process."""
    executor = Here()
    monkeypatch.setattr(gc, "collect", lambda: 0)  # it takes most of the time of runs so short
    monkeypatch.setattr(grid, "processes", lambda number: nullcontext(executor))
    return executor


def results(folder: Path) -> dict[str, dict]:
    return {
        str(path.parent.relative_to(folder)): json.loads(path.read_text())
        for path in sorted(folder.glob("*/*/result.json"))
    }


def without_clock(result: dict) -> dict:
    return {name: value for name, value in result.items() if name != "seconds"}


# what a grid is


def preset(name: str) -> list[tuple[str, str]]:
    return benchmark.Flags(preset=name).pairs()


def test_presets_are_the_papers():
    assert len(preset("paper45")) == len(preset("q8")) == 45 * 8
    assert len(preset("q2")) == 2 * 9 + 2 * 7 and len(preset("ladder")) == 10 * 8
    for name in PRESETS:  # scores are relative to TRPO's
        assert {suite for suite, _ in preset(name)} == {s for s, a in preset(name) if a == "trpo"}


def test_every_run_of_a_preset_is_valid(tmp_path):
    flags = RunFlags(log_folder=str(tmp_path), conf_file="paper")
    runs = grid.expand(preset("q2"), [0, 1], flags)
    assert len({run.path for run in runs}) == len(runs) == 2 * len(preset("q2"))
    assert [run.flags.seed + 1 for run in runs] == [1] * (len(runs) // 2) + [2] * (len(runs) // 2)
    for run in runs:  # the paper's lengths
        long = "_Ant_" in run.flags.env or "_Walker_" in run.flags.env
        assert run.steps == (30_000_000 if long else 6_000_000)


def test_scale_shortens_every_run_alike(tmp_path, capsys):
    arguments = ["--envs", "Goal_Point_8Hazards", "Goal_Ant_8Ghosts", "--algos", "cpo", "trpo_sl"]
    arguments += ["--seeds", "3", "--scale", "0.01", "-f", str(tmp_path / "a"), "--dry-run"]
    arguments += ["-conf", "paper"]
    assert benchmark.main(arguments) == 0
    out = capsys.readouterr().out.splitlines()
    assert [line.split()[2] for line in out[:4]] == ["60,000"] * 2 + ["300,000"] * 2
    assert out[0].split()[:2] == ["new", str(tmp_path / "a" / "cpo" / "Goal_Point_8Hazards-v0_4")]
    assert out[4] == "0 of 4 done, 4 new; 720,000 steps in all"
    assert list(tmp_path.iterdir()) == []


def test_a_hyperparameter_goes_to_those_that_have_it():
    args = RunFlags(hyperparams={"cost_limit": 5.0})
    with pytest.warns(UserWarning, match="ppo has no cost_limit: left out there"):
        cpo, ppo = grid.expand([("Goal_Point_8Hazards", a) for a in ("cpo", "ppo")], [0], args)
    assert cpo.hyperparams["cost_limit"] == 5.0 and "cost_limit" not in ppo.hyperparams


def test_a_grid_file_is_the_flags(tmp_path, monkeypatch, here, capsys):
    file = tmp_path / "my.yml"
    file.write_text(
        "envs: [CostPoint-v0]\nalgos: [cpo, trpo]\nseeds: [1]\nn_timesteps: 1e3\nscale: 0.06\n"
        "eval_freq: -1\ngym_packages: [registered_envs]\nenv_kwargs: {episode_length: 25}\n"
        "hyperparams: {n_envs: 2, n_steps: 30, n_critic_updates: 3, policy: MlpPolicy}\n"
    )
    folder = tmp_path / "grid"
    # What is given now wins; hyperparameters are merged.
    arguments = [*PACKAGE, "--grid", str(file), "-f", str(folder)]
    arguments += ["--algos", "trpo", "-params", "n_envs:1"]
    assert benchmark.main(arguments) == 0
    (run,) = folder.glob("*/*_*")
    assert run == folder / "trpo" / "CostPoint-v0_2"
    values = RunFolder(run).hyperparams()
    assert (values["n_timesteps"], values["n_envs"], values["n_steps"]) == (60, 1, 30)
    capsys.readouterr()
    assert benchmark.main([*arguments, "--dry-run"]) == 0
    assert capsys.readouterr().out.startswith(f"done    {run}  60 steps\n")


REFUSED = [
    (["--preset", "main8"], ["--preset", "--envs"]),
    (["-params", "cost_limt:5"], ["none of the algorithms", "'cost_limt'", "'cost_limit'"]),
    (["--grid", "absent.yml"], ["can't read grid file absent.yml", "No such file"]),
    (["-f", "/dev/null/x"], ["Not a directory", "/dev/null/x"]),
]


@pytest.mark.parametrize(("arguments", "parts"), REFUSED, ids=lambda one: " ".join(one)[:40])
def test_refused_before_anything_starts(arguments, parts, capsys, tmp_path, monkeypatch, here):
    monkeypatch.chdir(tmp_path)
    start = ["--envs", "Goal_Point_8Hazards", "--algos", "cpo", "trpo", "-n", "100"]
    refused(benchmark.main, [*start, *arguments], capsys, *parts)
    assert (here.runs, list(tmp_path.iterdir())) == ([], [])


GRID_FILES = [
    ("enves: [CostPoint-v0]", "unknown entry 'enves'; did you mean 'envs'?"),
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
    assert len(here.runs) == 2
    capsys.readouterr()

    assert benchmark.main(arguments) == 0
    assert len(here.runs) == 2
    assert "2 of 2 done" in capsys.readouterr().out

    cpo, trpo = tmp_path / "cpo" / "CostPoint-v0_1", tmp_path / "trpo" / "CostPoint-v0_1"
    # A corrupt result: the checkpoint of its end is still there.
    (cpo / "result.json").write_text('{"n_timest')
    # Killed while the folder was being made: nothing of the run, or half of its configuration.
    for path in (*trpo.glob("*.*"), trpo / "CostPoint-v0" / "args.yml"):
        path.unlink()
    assert benchmark.main(arguments) == 0
    assert len(here.runs) == 4
    assert "0 of 2 done, 1 resume, 1 new" in capsys.readouterr().out
    after = results(tmp_path)
    assert {k: without_clock(v) for k, v in whole.items()} == {
        k: without_clock(v) for k, v in after.items()
    }


def test_another_run_in_the_folder_is_not_touched(tmp_path, here, capsys):
    arguments = [*GRID, "--algos", "cpo", "--seeds", "0", "-f", str(tmp_path)]
    assert benchmark.main(arguments) == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for change, part in (
        (["-params", "cost_limit:5"], "cost_limit: 2.0 there, 5.0 here"),
        (["-n", "240"], "n_timesteps: 120 there, 240 here"),
        (["--eval-freq", "60"], "eval_freq: -1 there, 60 here"),
    ):
        refused(benchmark.main, [*arguments, *change], capsys, "holds another run", part, "-f")
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    # Another grid that contains it, with flags that only say how to watch.
    more = [*arguments, "--seeds", "0", "1", "--checkpoint-every", "0"]
    assert benchmark.main(more) == 0
    assert len(here.runs) == 2


def test_a_failure_leaves_the_others_alone(tmp_path, here, monkeypatch, capsys):
    complete, left = Run.complete, [1]

    def failing(run, *rest):
        if run.flags.algo == "cpo" and left:
            left.pop()
            raise ValueError("no luck")
        return complete(run, *rest)

    monkeypatch.setattr(Run, "complete", failing)
    arguments = [*GRID, "--algos", "cpo", "trpo", "--seeds", "0", "-f", str(tmp_path)]
    (tmp_path / "cpo" / "CostPoint-v0_1").mkdir(parents=True)
    assert benchmark.main(arguments) == 1
    assert [run.flags.algo for run in here.runs] == ["cpo", "trpo"]
    assert results(tmp_path).keys() == {"trpo/CostPoint-v0_1"}
    out, err = capsys.readouterr()
    assert "1 of 2 done, 1 failed" in out
    assert "failed: cpo on CostPoint-v0, seed 0: no luck" in err
    text = (tmp_path / "cpo" / "CostPoint-v0_1" / "error.txt").read_text()
    assert text.count("Traceback") == 1 and "ValueError: no luck" in text
    # Once more: the failed one is tried again, the other is not.
    assert benchmark.main(arguments) == 0
    assert here.runs[-1].flags.algo == "cpo" and len(here.runs) == 3
    assert not [*tmp_path.rglob("error.txt")]
    assert f"See the results with: sb3-guard plot {tmp_path}" in capsys.readouterr().out


def test_a_value_that_is_refused_fails_its_runs(tmp_path, here, capsys):
    arguments = [*GRID, "--algos", "cpo", "trpo", "--seeds", "0", "-f", str(tmp_path)]
    assert benchmark.main([*arguments, "-params", "margin_lr:-1"]) == 1
    out, err = capsys.readouterr()
    assert "1 of 2 done, 1 failed" in out and "margin_lr" in err and "Traceback" not in err


def test_a_dead_worker_ends_the_grid_with_a_line(tmp_path, here, capsys):
    def die(run):
        raise BrokenProcessPool("terminated abruptly.")

    here.before = die
    refused(
        benchmark.main, [*GRID, "--algos", "cpo", "--seeds", "0", "-f", str(tmp_path)], capsys,
        "a worker or scheduler is gone", "abruptly", "the same command continues",
    )  # fmt: skip


def test_a_run_of_our_environments_reaches_a_worker(tmp_path):
    grid_run = grid.GridRun.check(RunFlags.of({"env": "Goal_Point_8Hazards", "algo": "cpo"}))
    assert grid_run.source.batch is not None and grid_run.arguments
    there = pickle.loads(pickle.dumps(grid_run))
    assert there.flags == grid_run.flags and there.hyperparams == grid_run.hyperparams


def test_a_run_that_another_process_has_is_awaited(tmp_path, here, monkeypatch, capsys):
    """Two grids in one folder share the work, and both come to their end."""
    monkeypatch.setattr(grid, "ASK_AGAIN", 0.0)
    run = tmp_path / "cpo" / "CostPoint-v0_1"
    run.mkdir(parents=True)
    asked, other = [], ExitStack()
    other.enter_context(lock(run))

    def free_at_last(of):
        asked.append(of.flags.algo)
        if len(asked) == 4:
            other.close()

    here.before = free_at_last
    arguments = [*GRID, "--algos", "cpo", "trpo", "--seeds", "0", "-f", str(tmp_path)]
    assert benchmark.main(arguments) == 0
    out, err = capsys.readouterr()
    assert err.count("in use: cpo on") == 1 and "2 of 2 done" in out
    assert asked == ["cpo", "trpo", "cpo", "cpo"]


def test_asked_to_stop(tmp_path, here, capsys):
    """What runs ends with a checkpoint, what waits does not begin, and all is done later."""
    arguments = [*GRID, "--algos", "cpo", "trpo", "--seeds", "0", "-f", str(tmp_path)]

    def interrupt(run):
        if run.flags.algo == "cpo":
            os.kill(os.getpid(), signal.SIGTERM)

    here.before = interrupt
    assert benchmark.main(arguments) == 143
    assert len(here.runs) == 2
    assert "The same command continues." in capsys.readouterr().out
    assert results(tmp_path) == {} and not (tmp_path / "stop").exists()
    here.before = lambda run: None
    assert benchmark.main(arguments) == 0 and len(results(tmp_path)) == 2


def test_a_run_looks_for_the_file_after_each_rollout(tmp_path, here):
    stop, asked = tmp_path / "stop", []

    class Appearing(type(stop)):
        def exists(self, **kwargs):
            asked.append(True)
            return len(asked) > 3

    flags = RunFlags(log_folder=str(tmp_path), gym_packages=["registered_envs"], eval_freq=-1)
    flags.hyperparams = {"n_envs": 2, "n_steps": 30, "cost_limit": 2.0}
    (run,) = grid.expand([("CostPoint-v0", "cpo")], [0], replace(flags, n_timesteps=600))
    assert grid.carry_out(run, "", Appearing(stop)) == ("stopped", "")
    assert len(asked) == 4 and (run.path / "checkpoint.zip").exists()
    (run,) = grid.expand([("CostPoint-v0", "cpo")], [0], replace(flags, n_timesteps=600))
    assert run.state == "resume"
    assert grid.carry_out(run, "", tmp_path / "elsewhere" / "stop")[0] == "failed"
    stop.touch()
    assert grid.carry_out(run, "", stop) == ("waiting", "")


# real processes


CHAOS = Path(__file__).parents[2] / "scripts" / "chaos.py"


def campaign(tmp_path, what: str, kills: int, *flags: str) -> str:
    run = subprocess.run(
        [sys.executable, CHAOS, what, "--kills", str(kills), "--folder", tmp_path, "--", *flags],
        env=environment(), capture_output=True, text=True, timeout=580, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="kills processes")
@pytest.mark.parametrize(("what", "kills"), [("grid", 20), ("train", 20)])
def test_chaos(what, kills, tmp_path):
    flags = ["--envs", "CostPoint-v0"] if what == "grid" else ["--env", "CostPoint-v0"]
    assert "nothing is lost" in campaign(tmp_path, what, kills, *flags, *SMALL, "-n", "6000")


def start(arguments: list[str], **kwargs) -> subprocess.Popen:
    command = [sys.executable, "-m", "sb3_guard.benchmark", *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment(), **pipes, **kwargs)


def episodes(folder: Path) -> int:
    return sum(lines(path) for path in folder.rglob("0.monitor.csv"))


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_interrupted_once_and_twice(number, tmp_path):
    """Once: with a checkpoint. Ctrl-C twice: immediately, and the workers end, too.

    SIGTERM may come twice, and to the workers, as from ``timeout`` and batch systems.
    """
    arguments = [*GRID, "-n", "600000", "--algos", "cpo", "--seeds", "0", "-f", str(tmp_path)]
    with start(arguments, start_new_session=True) as process:
        wait_for(lambda: episodes(tmp_path) > 20, 180, process)
        os.killpg(process.pid, number)
        if number == signal.SIGTERM:
            time.sleep(0.01)
            os.killpg(process.pid, number)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 128 + number and "Traceback" not in out + err
    assert "The same command continues." in out
    before = episodes(tmp_path)
    with start(arguments) as process:
        wait_for(lambda: episodes(tmp_path) > before + 10, 180, process)
        process.send_signal(number)
        time.sleep(0.1)
        process.send_signal(number)
        out, err = process.communicate(timeout=30)
    # -number: the second signal came while the process was ending.
    assert process.returncode in (130, 128 + number, -number) and "Traceback" not in out + err


# a cluster


def test_no_scheduler_there(tmp_path, monkeypatch, capsys):
    distributed = pytest.importorskip("distributed")
    whole = distributed.Client.__init__
    monkeypatch.setattr(
        distributed.Client, "__init__", lambda self, a, timeout, **k: whole(self, a, timeout=1, **k)
    )
    arguments = [*GRID, "--algos", "cpo", "-f", str(tmp_path)]
    refused(
        benchmark.main, [*arguments, "--scheduler", "tcp://127.0.0.1:1"], capsys,
        "no Dask scheduler answers at tcp://127.0.0.1:1", "start one with: dask scheduler",
    )  # fmt: skip


@pytest.mark.slow
def test_a_cluster_with_a_worker_killed(tmp_path):
    """A scheduler and two workers started as commands, one killed: nothing is lost."""
    address = tmp_path / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment()}
    place = ["--scheduler-file", str(address), "--no-dashboard"]
    processes = []

    def begin(*arguments: str) -> subprocess.Popen:
        command = [sys.executable, "-m", *arguments, *place]
        processes.append(subprocess.Popen(command, cwd=tmp_path, **quiet))
        return processes[-1]

    try:
        scheduler = begin("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0")
        wait_for(address.exists, 120, scheduler)
        flags = ["--nthreads", "1", "--no-nanny"]
        workers = [begin("distributed.cli.dask_worker", *flags) for _ in range(2)]
        folder = tmp_path / "grid"
        arguments = ["--envs", "CostPoint-v0", *SMALL, "--algos", "cpo", "trpo", "--seeds", "0"]
        arguments += ["-n", "6000", "--checkpoint-every", "0", "-f", str(folder)]
        where = json.loads(address.read_text())["address"]
        with start([*arguments, "--scheduler", where]) as process:

            def both_run() -> bool:
                logs = list(folder.glob("*/*/0.monitor.csv"))
                return len(logs) == 2 and all(lines(path) > 30 for path in logs)

            wait_for(both_run, 600, process)
            workers[0].kill()
            workers[0].wait()  # a zombie would still hold its lock
            out, err = process.communicate(timeout=400)
        assert process.returncode == 0, out + err
    finally:
        for one in processes:
            one.kill()
            one.wait()
    # One go on this machine comes to the same, to the last bit.
    with start([*arguments[:-1], str(tmp_path / "whole")]) as process:
        process.communicate(timeout=400)
    for algo in ("cpo", "trpo"):
        for one in ("whole", "grid"):
            (tmp_path / f"{one}-{algo}").mkdir()
            (tmp_path / one / algo).rename(tmp_path / f"{one}-{algo}" / algo)
        assert_same_run(tmp_path / f"whole-{algo}", tmp_path / f"grid-{algo}")

"""A run that was killed and resumed is, bit for bit, the run that was not."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from cost_envs import CostPoint
from gymnasium.vector import AsyncVectorEnv
from killed import (
    SHORT,
    SMALL,
    TOY,
    Killed,
    assert_equal,
    assert_same_run,
    crash,
    environment,
    lines,
    outcome,
    runs_of,
    tensors,
)
from processes import wait_for
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_guard import make_vec_env, train
from sb3_guard.common import vec_env
from sb3_guard.zoo.cli.usage import UsageError, import_packages
from sb3_guard.zoo.run import checkpoint
from sb3_guard.zoo.run import run as run_module
from sb3_guard.zoo.run.checkpoint import read_checkpoint
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder
from sb3_guard.zoo.run.progress import Epochs


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The toy run of so many steps that nothing interrupts: ``steps -> log folder``, made once."""

    @cache
    def folder(steps: int) -> Path:
        path = tmp_path_factory.mktemp("whole")
        assert train.main([*TOY, *SHORT, *SMALL, "-n", str(steps), "-f", str(path)]) == 0
        return path

    return folder


@pytest.fixture
def forked(monkeypatch):
    """Worker processes that start quickly."""
    monkeypatch.setattr(vec_env, "SubprocVecEnv", partial(SubprocVecEnv, start_method="fork"))


# What a checkpoint must hold, all at once
EVERYTHING = [
    *"-params frame_stack:3 normalize:True use_sde:True learning_rate:lin_0.01".split(),
    "env_wrapper:gymnasium.wrappers.NormalizeObservation",
    "cost_keys:['cost', 'heat']",
    "cost_limit:['lin_3_1', 2.0]",
    *["--env-kwargs", "cost_keys:('cost', 'heat')"],
]


@pytest.mark.parametrize(
    "more",
    [EVERYTHING, pytest.param(["--algo", "trpo", "--log-interval", "2"], marks=pytest.mark.slow)],
)
def test_killed_and_resumed(more, tmp_path, monkeypatch):
    arguments = [*TOY, *SHORT, *SMALL, "-n", "300", *more]
    assert train.main([*arguments, "-f", str(tmp_path / "whole")]) == 0
    # Once within the second rollout, and once more after being resumed.
    crash(monkeypatch, [*arguments, "-f", str(tmp_path / "cut")], 100)
    crash(monkeypatch, ["-i", str(runs_of(tmp_path / "cut")), *TOY[:2]], 206)
    assert train.main(["-i", str(runs_of(tmp_path / "cut") / "checkpoint.zip"), *TOY[:2]]) == 0
    assert_same_run(tmp_path / "whole", tmp_path / "cut")


def test_killed_and_resumed_off_policy(tmp_path, monkeypatch):
    """While random actions fill the buffer, and after."""
    off = ["--algo", "sac_lag", "--save-freq", "-1", "--checkpoint-every", "0", "--eval-freq", "-1"]
    small = [
        "n_envs:1",
        "learning_starts:80",
        "batch_size:8",
        "buffer_size:500",
        "policy_kwargs:{'net_arch':[8]}",
    ]
    more = ["--seed", "3", "--verbose", "0", "-n", "110", "-params", *small, "cost_limit:0.1"]
    arguments = [*TOY, *SHORT, *off, *more]
    assert train.main([*arguments, "-f", str(tmp_path / "whole")]) == 0
    cut = tmp_path / "cut"
    crash(monkeypatch, [*arguments, "-f", str(cut)], 50)
    crash(monkeypatch, ["-i", str(runs_of(cut)), *TOY[:2]], 95)
    assert train.main(["-i", str(runs_of(cut)), *TOY[:2]]) == 0
    assert_same_run(tmp_path / "whole", cut)


@pytest.mark.parametrize(
    "steps", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (60, 62, 120, 298)), 300]
)
def test_killed_at_any_moment(steps, undisturbed, tmp_path, monkeypatch):
    """Before the first checkpoint, at a rollout's end, after the last step."""
    crash(monkeypatch, [*TOY, *SHORT, *SMALL, "-n", "300", "-f", str(tmp_path)], steps)
    assert train.main(["-i", str(runs_of(tmp_path)), *TOY[:2]]) == 0
    assert_same_run(undisturbed(300), tmp_path)


@pytest.mark.parametrize("vec_env", ["subproc", "gymnasium"])
def test_however_environments_are_stepped(vec_env, forked, tmp_path, monkeypatch):
    arguments = [*TOY, *SHORT, *SMALL, "-n", "180", "--vec-env", vec_env, "--eval-freq", "-1"]
    assert train.main([*arguments, "-f", str(tmp_path / "whole")]) == 0
    crash(monkeypatch, [*arguments, "-f", str(tmp_path / "cut")], 130)
    assert train.main(["-i", str(runs_of(tmp_path / "cut")), *TOY[:2]]) == 0
    assert_same_run(tmp_path / "whole", tmp_path / "cut")


def test_our_own_environments(tmp_path, monkeypatch):
    arguments = ["--env", "Goal_Point_3Hazards", *SMALL, "-n", "180", "--env-kwargs",
                 "goal:{'size': 0.6}", "max_episode_steps:40", "--eval-freq", "140",
                 "--eval-episodes", "1", "--n-eval-envs", "1"]  # fmt: skip
    assert train.main([*arguments, "-f", str(tmp_path / "whole")]) == 0
    crash(monkeypatch, [*arguments, "-f", str(tmp_path / "cut")], 150)
    assert train.main(["-i", str(runs_of(tmp_path / "cut"))]) == 0
    one, other = runs_of(tmp_path / "whole"), runs_of(tmp_path / "cut")
    for name in ("checkpoint.zip", "Goal_Point_3Hazards-v0.zip", "best_model.zip"):
        if (one / name).exists():
            assert_equal(tensors(one / name), tensors(other / name))
    assert outcome(one) == outcome(other)


def test_finished_run_goes_on_as_a_longer_one(undisturbed, tmp_path, capsys):
    assert train.main([*TOY, *SHORT, *SMALL, "-n", "120", "-f", str(tmp_path)]) == 0
    run = runs_of(tmp_path)
    capsys.readouterr()
    assert train.main(["-i", str(run), *TOY[:2]]) == 0
    assert "is finished: 120 steps" in capsys.readouterr().out
    before = outcome(run)
    (run / "result.json").write_text('{"n_timest')
    assert train.main(["-i", str(run), *TOY[:2]]) == 0  # writes it again
    assert outcome(run) == before
    assert train.main(["-i", str(run), *TOY[:2], "-n", "300"]) == 0
    assert_same_run(undisturbed(300), tmp_path)


@pytest.mark.parametrize(
    ("owner", "name", "result_is_left"),
    [(run_module, "RunLogger", True), (run_module, "write_config", False)],
)
def test_a_result_is_always_that_of_its_configuration(
    owner, name, result_is_left, tmp_path, monkeypatch
):
    """Whenever a run that is to be continued for longer dies."""
    assert train.main([*TOY, *SHORT, *SMALL, "-n", "60", "-f", str(tmp_path)]) == 0
    run = RunFolder(runs_of(tmp_path))
    logs = [path.read_bytes() for path in sorted(run.path.glob("*.csv"))]

    def die(*_: object, **__: object) -> None:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, die)
        with pytest.raises(Killed):
            train.main(["-i", str(run.path), *TOY[:2], "-n", "120"])
    assert run.hyperparams()["n_timesteps"] == run.args()["n_timesteps"] == 60
    assert run.result.exists() == result_is_left
    assert [path.read_bytes() for path in sorted(run.path.glob("*.csv"))] == logs
    assert train.main(["-i", str(run.path), *TOY[:2], "-n", "120"]) == 0
    assert run.hyperparams()["n_timesteps"] == run.args()["n_timesteps"] == 120
    assert run.checked_result()["n_timesteps"] == 120


def test_time_goes_on(tmp_path, monkeypatch):
    arguments = [*TOY, *SHORT, *SMALL, "-n", "180", "-f", str(tmp_path)]
    crash(monkeypatch, arguments, 100)
    before = read_checkpoint(runs_of(tmp_path) / "checkpoint.zip")
    assert train.main(["-i", str(runs_of(tmp_path)), *TOY[:2]]) == 0
    after = read_checkpoint(runs_of(tmp_path) / "checkpoint.zip")
    assert after["elapsed"] > before["elapsed"]
    assert after["start"] == 0  # speed is that of the whole run
    log = pd.read_csv(runs_of(tmp_path) / "progress.csv")
    log = log[log["time/iterations"].notna()]
    assert log["time/iterations"].tolist() == [1, 2, 3]
    assert log["time/time_elapsed"].is_monotonic_increasing


def test_environments_that_can_not_be_saved_begin_anew(tmp_path, monkeypatch, capsys):
    arguments = [*TOY, *SHORT, *SMALL, "-n", "180", "-f", str(tmp_path), "--env", "Unpicklable-v0"]
    crash(monkeypatch, arguments, 130)
    assert "This environment can't save its state" in capsys.readouterr().out
    assert train.main(["-i", str(runs_of(tmp_path)), *TOY[:2]]) == 0
    result = json.loads((runs_of(tmp_path) / "result.json").read_text())
    assert result["n_timesteps"] == 180
    episodes = pd.read_csv(runs_of(tmp_path) / "0.monitor.csv", skiprows=1)
    assert (episodes["l"] == 25).all()


def test_a_run_stopped_within_a_rollout_keeps_the_checkpoint_before(tmp_path):
    stop = ["-params", "callback:{'registered_envs.StopAt': {'steps': 100}}"]
    assert train.main([*TOY, *SMALL, *stop, "-n", "300", "-f", str(tmp_path)]) == 0
    run = runs_of(tmp_path)
    assert json.loads((run / "result.json").read_text())["n_timesteps"] == 100
    assert read_checkpoint(run / "checkpoint.zip")["num_timesteps"] == 60


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "sb3_guard.train", *arguments]


@pytest.mark.slow
def test_kill_minus_nine(tmp_path):
    """The same with a real process and a real kill, at whatever moment it comes."""
    arguments = [*TOY, *SHORT, *SMALL, "--eval-freq", "300", "-n", "600"]
    start = command(*arguments, "-f", str(tmp_path / "cut"))
    with subprocess.Popen(start, env=environment(), stderr=subprocess.PIPE) as process:
        wait_for(lambda: any(lines(one) > 3 for one in tmp_path.rglob("0.*.csv")), 300, process)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    assert train.main(["-i", str(runs_of(tmp_path / "cut")), *TOY[:2]]) == 0
    assert train.main([*arguments, "-f", str(tmp_path / "whole")]) == 0
    assert_same_run(tmp_path / "whole", tmp_path / "cut")


def test_asked_to_stop(undisturbed, tmp_path, monkeypatch, capsys):
    """A polite stop finishes the rollout, leaves a checkpoint and a model, and is resumed."""
    whole = Epochs._on_step

    def step(self):
        if self.num_timesteps == 100:
            os.kill(os.getpid(), signal.SIGINT)
        return whole(self)

    arguments = [*TOY, *SHORT, *SMALL, "-n", "300", "--verbose", "1", "--checkpoint-every", "1000"]
    with monkeypatch.context() as patch:
        patch.setattr(Epochs, "_on_step", step)
        assert train.main([*arguments, "-f", str(tmp_path)]) == 128 + signal.SIGINT
    out, err = capsys.readouterr()
    assert "Stopping after this rollout" in err and "Traceback" not in err
    run = runs_of(tmp_path)
    assert f"continue with      sb3-guard train -i {run}" in out
    assert (run / "CostPoint-v0.zip").exists() and not (run / "result.json").exists()
    assert read_checkpoint(run / "checkpoint.zip")["num_timesteps"] == 120
    assert train.main(["-i", str(run), *TOY[:2], "--verbose", "0"]) == 0
    assert_same_run(undisturbed(300), tmp_path)


@pytest.mark.parametrize("vec_env", ["subproc", "gymnasium"])
@pytest.mark.parametrize("asked", [False, True])
def test_processes_of_environments_die(asked, vec_env, forked, tmp_path, monkeypatch, capsys):
    """For want of memory, or by a SIGTERM to the whole process group, as batch systems send it."""
    whole = Epochs._on_step
    import_packages(["registered_envs"])
    monkeypatch.setattr(gym.spec("CostPoint-v0"), "vector_entry_point", in_processes)

    def step(self):
        if self.num_timesteps == 100:
            for one in multiprocessing.active_children():
                one.kill()
            if asked:
                os.kill(os.getpid(), signal.SIGTERM)
        return whole(self)

    monkeypatch.setattr(Epochs, "_on_step", step)
    arguments = [*TOY, *SHORT, *SMALL, "--eval-freq", "-1", "-n", "120", "--vec-env", vec_env]
    status = 128 + signal.SIGTERM if asked else 2
    assert train.main([*arguments, "-f", str(tmp_path)]) == status
    run = runs_of(tmp_path)
    err = capsys.readouterr().err
    assert "Traceback" not in err
    assert asked == (f"--vec-env {vec_env} has died" not in err)
    assert asked or f"continue with: sb3-guard train -i {run} --gym-packages" in err
    assert read_checkpoint(run / "checkpoint.zip")["num_timesteps"] == 60


def test_a_run_closes_processes_whose_answers_are_lost(forked):
    """Of a step in which another process has died, or which a second Ctrl-C has cut."""
    import_packages(["registered_envs"])
    run = run_module.Run(RunFlags(env="CostPoint-v0", vec_env="subproc"), {"cost_limit": 1.0})
    run.evaluation = None
    run.env = run.make_envs(2, 0)
    run.env.reset()
    run.env.step_async(np.zeros((2, 2), np.float32))
    run.env.unwrapped.remotes[0].recv()
    run.close()
    for process in run.env.unwrapped.processes:
        process.join(10)
        assert not process.is_alive()


def in_processes(num_envs: int = 1, **kwargs: Any) -> AsyncVectorEnv:
    return AsyncVectorEnv([partial(CostPoint, **kwargs)] * num_envs, context="fork")


def test_a_state_of_another_environment_is_refused_in_a_line():
    envs = [make_vec_env(name, 2) for name in ("Goal_Point_8Hazards", "Goal_Point_4Hazards")]
    with pytest.raises(UsageError, match=r"checkpoint belongs to another environment: the state"):
        checkpoint.restore(envs[0], checkpoint.capture(envs[1]))

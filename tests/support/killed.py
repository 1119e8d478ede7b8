"""Runs that are killed and resumed, and what must be equal in the end."""

import io
import json
import os
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch as th

from sb3_guard import train
from sb3_guard.zoo.run.progress import Epochs

SUPPORT = Path(__file__).parent


# Checkpoints at every rollout; models kept and evaluations at steps that are no rollout's end.
SMALL = (
    "-params n_envs:2 n_steps:30 n_critic_updates:3 cost_limit:2 --seed 3 --save-freq 70 "
    "--checkpoint-every 0 --eval-freq 50 --eval-episodes 3 --n-eval-envs 2 --verbose 0 --device cpu"
).split()


TOY = "--gym-packages registered_envs --env CostPoint-v0".split()


SHORT = ["--env-kwargs", "episode_length:25"]  # no divisor of a rollout


class Killed(BaseException):
    """Stands for a kill: nothing catches it, nothing is written any more."""


def kill_at(monkeypatch, steps: int) -> None:
    """Let the next run die when it has taken so many steps."""
    with monkeypatch.context() as patch:
        whole = Epochs._on_step

        def step(self):
            if self.model.num_timesteps >= steps:
                raise Killed
            return whole(self)

        patch.setattr(Epochs, "_on_step", step)
        yield


def runs_of(folder: Path) -> Path:
    (run,) = folder.glob("*/*_1")
    return run


def tensors(archive: Path) -> dict[str, object]:
    """All state dicts in a model file."""
    with zipfile.ZipFile(archive) as file:
        return {
            name: th.load(io.BytesIO(file.read(name)), weights_only=True)
            for name in file.namelist()
            if name.endswith(".pth")
        }


def assert_equal(one, other) -> None:
    if isinstance(one, th.Tensor):
        assert th.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal(one[key], other[key])
    elif isinstance(one, (list, tuple)):
        for a, b in zip(one, other, strict=True):
            assert_equal(a, b)
    else:
        assert one == other


def outcome(run: Path) -> dict[str, object]:
    """What a run came to, its duration aside."""
    result = json.loads((run / "result.json").read_text())
    result.pop("seconds")
    return result


def assert_same_run(one: Path, other: Path) -> None:
    """Models, monitor, log, evaluations and result are equal; clocks may differ."""
    one, other = runs_of(one), runs_of(other)
    names = {path.name for path in one.iterdir()}
    assert names == {path.name for path in other.iterdir()}
    for name in names:
        if name.endswith(".zip"):
            assert_equal(tensors(one / name), tensors(other / name))
    clocks = ["t", "time/fps", "time/time_elapsed"]
    for name, skip in (("0.monitor.csv", 1), ("progress.csv", 0)):
        a, b = (pd.read_csv(run / name, skiprows=skip) for run in (one, other))
        a, b = (table.drop(columns=clocks, errors="ignore") for table in (a, b))
        assert len(a) > 0
        pd.testing.assert_frame_equal(a[sorted(a)], b[sorted(b)], check_exact=True)
    if "evaluations.npz" in names:
        a, b = (np.load(run / "evaluations.npz") for run in (one, other))
        for name in a.files:
            np.testing.assert_array_equal(a[name], b[name])
    assert outcome(one) == outcome(other)


def crash(monkeypatch, arguments: list[str], steps: int) -> None:
    for _ in kill_at(monkeypatch, steps):
        with pytest.raises(Killed):
            train.main(arguments)


def environment() -> dict[str, str]:
    path = os.pathsep.join([str(SUPPORT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}


def lines(path: Path) -> int:
    return path.read_text().count("\n") if path.exists() else 0

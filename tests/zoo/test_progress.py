"""What a run's result says: the final epoch, and what it was made with."""

import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from cost_envs import CostPoint
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

import sb3_guard
from sb3_guard import CPO, SCPO, TRPO, CostMonitor, train
from sb3_guard.zoo.results.runs import read_results
from sb3_guard.zoo.run import progress
from sb3_guard.zoo.run.progress import Epochs, commit

RUN = (
    "--gym-packages registered_envs --env CostPoint-v0 --env-kwargs episode_length:20 --device cpu "
    "-params n_envs:2 n_steps:30 n_critic_updates:3 cost_limit:4.0 --eval-freq -1 --verbose 0"
).split()


def envs() -> CostMonitor:
    return CostMonitor(DummyVecEnv([lambda: CostPoint(episode_length=10)]))


def test_a_trained_run_says_what_it_was_made_with(tmp_path):
    assert train.main([*RUN, "--algo", "cpo", "-n", "120", "-f", str(tmp_path)]) == 0
    (row,) = read_results([tmp_path]).runs.to_dict("records")
    assert row["mujoco"] == metadata.version("mujoco")
    assert row["torch"] == metadata.version("torch")
    assert row["sb3_guard"] == sb3_guard.__version__ and row["python"] == sys.version.split()[0]
    assert 0 < row["seconds"] < 100 and row["cost_limit"] == 4 and row["steps"] == 120
    assert row["platform"] and row["epoch"] == 60 and row["label"] == "CPO"


@pytest.mark.parametrize(("algorithm", "limit"), [(TRPO, None), (CPO, 3.0)])
def test_only_constrained_algorithms_have_a_limit(algorithm, limit):
    model = algorithm("MlpPolicy", envs(), n_steps=20, cost_limit=3.0, n_critic_updates=1)
    epochs = Epochs()
    model.learn(20, callback=epochs)
    assert epochs.result()["cost_limit"] == limit
    assert epochs.result()["episodes"] == 2


def test_the_worst_step_is_judged_by_the_limit_on_it():
    env = CostMonitor(DummyVecEnv([lambda: CostPoint(10, hazard=(-1, 0))]))
    model = SCPO("MlpPolicy", env, n_steps=40, cost_limit=0.0, n_critic_updates=1)
    epochs = Epochs()
    model.learn(40, callback=epochs)
    result = epochs.result()
    (cost,) = result["costs"].values()
    # What the algorithm itself has found the highest costs of these episodes to be, on average
    assert cost["mean"] == pytest.approx(model.costs.episode_cost.item())
    assert cost["limit"] == 0 and result["limit_on"] == "max"
    assert 0 < cost["mean"] < result["cost"]


def test_off_policy_epochs_are_of_the_papers_length(monkeypatch):
    monkeypatch.setattr(progress, "EPOCH", 45)
    model = SAC("MlpPolicy", envs(), learning_starts=1000, buffer_size=200)
    epochs = Epochs()
    model.learn(100, callback=epochs)
    # A rollout is one step long; episodes ended at 60, 70, 80, 90 and 100 of 100.
    assert epochs.result()["episodes"] == 5
    model.learn(7, callback=epochs, reset_num_timesteps=False)
    assert epochs.result()["episodes"] == 4


def package(folder: Path) -> Path:
    (folder / "sb3_guard").mkdir(parents=True)
    file = folder / "sb3_guard" / "__init__.py"
    file.write_text("")
    return file


@pytest.mark.skipif(shutil.which("git") is None, reason="no git")
def test_commit_of_changed_and_of_installed_code(tmp_path, monkeypatch):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", "-C", tmp_path, *identity, *arguments], check=True,
                       capture_output=True)  # fmt: skip

    git("init")
    own = package(tmp_path)
    git("add", ".")
    git("commit", "-m", "x")
    monkeypatch.setattr(sb3_guard, "__file__", str(own))
    assert len(commit()) == 40
    own.write_text("changed = True")
    assert commit().endswith("-dirty")
    # Installed below somebody's checkout, but no part of it
    installed = package(tmp_path / ".venv")
    monkeypatch.setattr(sb3_guard, "__file__", str(installed))
    assert commit() is None
    installed.with_name("COMMIT").write_text("abc\n")
    assert commit() == "abc"

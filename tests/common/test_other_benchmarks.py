"""Other benchmarks: what the page about them says, tried with the packages where they are there."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from cost_envs import CostPoint
from gymnasium import spaces

from sb3_guard import PPOLag, evaluate_policy

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "other_benchmarks.md"


def table():
    """The rows of the page's table: what stands in each column."""
    rows = re.findall(r"^\| (.*) \|$", PAGE.read_text(), flags=re.MULTILINE)
    return {cells[0]: cells[1:] for cells in (row.split(" | ") for row in rows)}


# In a process of its own: the package redirects stderr in a way that pytest's capturing breaks.
BULLET = """
import json, sys
import bullet_safety_gym, gymnasium
from sb3_guard import train

specs = [spec for spec in gymnasium.registry.values()
         if str(spec.entry_point).startswith("bullet_safety_gym.")]
for spec in specs:
    assert train.main([*sys.argv[1:], "--env", spec.id]) == 0, spec.id
    env = gymnasium.make(spec.id)
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(50):
        *_, info = env.step(env.action_space.sample())
        parts = sum(value for name, value in info.items() if name.startswith("cost_"))
        assert info["cost"] == (parts if "Push" in spec.id else min(1, parts))
        assert not {"cost_outside_bounds", "cost_velocity_violation"} & {*info} or info["cost"]
print(json.dumps([spec.id for spec in specs]))
"""


@pytest.mark.slow
def test_every_id_of_bullet_safety_gym_trains(tmp_path):
    if importlib.util.find_spec("bullet_safety_gym") is None:
        pytest.skip("needs pybullet and bullet-safety-gym")
    short = "--gym-packages bullet_safety_gym -n 128 --eval-freq -1 --verbose 0 --device cpu"
    small = "-params cost_limit:5 n_envs:1 n_steps:64 batch_size:32 n_epochs:1"
    flags = ["--algo", "ppo_lag", "-f", str(tmp_path), *short.split(), *small.split()]
    done = subprocess.run(
        [sys.executable, "-c", BULLET, *flags],
        capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    ids = json.loads(done.stdout.splitlines()[-1])
    (cells,) = (cells for name, cells in table().items() if name.startswith("Bullet"))
    assert f"{len(ids)} ids" in cells[0] and len(ids) == 18
    for env_id in ids:
        result = json.loads((tmp_path / "ppo_lag" / f"{env_id}_1" / "result.json").read_text())
        assert result["n_timesteps"] == 128 and result["cost_rate"] >= 0.0


@pytest.mark.slow
def test_the_original_safety_gymnasium_trains():
    """By ``CostFromStep``, in the Python environment that the script has set up before."""
    python = ROOT / ".venv-mujoco-2.3.3" / "bin" / "python"
    if not python.exists():
        pytest.skip("needs python3.11 scripts/safety_gymnasium/check.py")
    script = ROOT / "scripts" / "safety_gymnasium" / "check.py"
    done = subprocess.run(
        [str(python), str(script), "--train-only", "-n", "2000"],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (
        "mujoco 2.3.3" in done.stdout and "SafetyPointGoal1-v0, subproc: 2000 steps" in done.stdout
    )


class Stabilize(gym.Env):
    """A stand-in for Safe-Control-Gym's interface: g(x, u) <= 0 in ``info["constraint_values"]``.

    As its documentation says, ``reset`` reports the constraints on the state alone, ``step`` all,
    and ``info["constraint_violation"]`` is 1 if any value is above 0.
    """

    def __init__(self):
        self.world = CostPoint(episode_length=20)
        self.observation_space, self.action_space = (
            self.world.observation_space,
            spaces.Box(-1.0, 1.0, (2,), np.float32),
        )

    def reset(self, *, seed=None, options=None):
        obs, _ = self.world.reset(seed=seed)
        return obs, {"constraint_values": np.array([obs[0] - 0.1])}

    def step(self, action):
        obs, reward, terminated, truncated, _ = self.world.step(action)
        values = np.array([obs[0] - 0.1, *(np.abs(action) - 0.5)])
        info = {"constraint_values": values, "constraint_violation": int(values.max() > 0.0)}
        return obs, reward, terminated, truncated, info


def test_constraint_values_become_costs():
    (block,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    names = {"env": Stabilize()}
    exec(compile(block, PAGE.name, "exec"), names)
    env, violation = names["env"], names["violation"]
    env.reset(seed=0)
    seen = []
    for _ in range(20):
        *_, info = env.step(env.action_space.sample())
        excess = max(0.0, *info["constraint_values"])
        assert info["cost"] == pytest.approx(excess)
        assert (info["cost"] > 0.0) == bool(info["constraint_violation"])
        seen.append(info["cost"])
    assert 0.0 in seen and max(seen) > 0.0
    assert violation(None, None, None, {}) == 0.0  # no constraints were asked for
    model = PPOLag("MlpPolicy", env, n_steps=64, batch_size=32, cost_limit=1.0, device="cpu")
    model.learn(128)
    assert evaluate_policy(model, env, 2).costs.min() >= 0.0

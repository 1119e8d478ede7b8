"""The built package works outside the checkout: nothing it needs stays behind."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_a_wheel_installed_elsewhere_trains_and_plays(tmp_path):
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    build = ["wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path)]
    subprocess.run([*pip, *build, str(ROOT)], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
        agents = [name for name in archive.namelist() if name.startswith("sb3_guard/pretrained/")]
    assert sum(name.endswith("-v0.zip") for name in agents) == 4
    env = {**os.environ, "PYTHONPATH": str(site), "OMP_NUM_THREADS": "1"}

    def run(*arguments):
        return subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, env=env, check=True, capture_output=True,
            text=True,
        ).stdout  # fmt: skip

    where = run("-c", "import sb3_guard; print(sb3_guard.__file__)")
    assert Path(where.strip()).is_relative_to(site)
    short = "n_envs:2 n_steps:50 n_critic_updates:2".split()
    which = ["--algo", "cpo", "--env", "Goal_Ant_8Hazards", "-f", "logs"]
    run("-m", "sb3_guard.train", *which, "-n", "200", "--eval-freq", "-1", "-params", *short)
    assert "return" in run("-m", "sb3_guard.enjoy", *which, "--n-episodes", "1", "--no-render")

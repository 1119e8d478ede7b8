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
    shipped = len([*(ROOT / "sb3_guard" / "pretrained").rglob("*-v0.zip")])
    assert sum(name.endswith("-v0.zip") for name in agents) == shipped > 0
    env = {**os.environ, "PYTHONPATH": str(site), "OMP_NUM_THREADS": "1"}

    which = "--algo cpo --env Goal_Ant_8Hazards -f logs".split()
    training = "-n 100 --eval-freq -1 -params n_envs:2 n_steps:50 n_critic_updates:2".split()
    code = f"""
import sb3_guard
from sb3_guard import enjoy, train
print(sb3_guard.__file__)
assert train.main({[*which, *training]}) == 0
assert enjoy.main({[*which, "--n-episodes", "1", "--no-render"]}) == 0
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    where, played = done.stdout.split("\nPlaying ")
    assert Path(where.split("\n")[0]).is_relative_to(site)
    assert "return" in played

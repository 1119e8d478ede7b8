"""The built package works outside the checkout: nothing it needs stays behind."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    build = ["wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
    subprocess.run([*pip, *build, str(ROOT)], check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        yield archive


def test_the_long_description_has_absolute_links(wheel):
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    metadata = message_from_bytes(wheel.read(name))
    assert metadata["Description-Content-Type"] == "text/markdown"
    target = r"\]\(([^)\s]+)\)"
    links = re.findall(target, metadata.get_payload())
    source = re.findall(target, (ROOT / "README.md").read_text())
    relative = [link for link in source if not re.match("[a-z]+:|#", link)]
    assert relative
    for link, old in zip(links, source, strict=True):
        kind = "raw" if old.endswith((".png", ".gif")) else "blob"
        whole = rf"https://.*/{kind}/v{re.escape(metadata['Version'])}/{re.escape(old)}"
        assert re.fullmatch(whole, link) if old in relative else link == old


def test_packages_know_their_commit(wheel, tmp_path):
    """Also a wheel of an unpacked source distribution, as ``python -m build`` makes it."""
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout")
    git = ["git", "-C", str(ROOT), "rev-parse", "HEAD"]
    head = subprocess.run(git, check=True, capture_output=True, text=True).stdout.strip()
    build = [sys.executable, "-m", "hatchling", "build", "-d", str(tmp_path), "-t"]
    subprocess.run([*build, "sdist"], cwd=ROOT, check=True, capture_output=True)
    (sdist,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    source = tmp_path / sdist.name.removesuffix(".tar.gz")
    subprocess.run([*build, "wheel"], cwd=source, check=True, capture_output=True)
    (path,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(path) as again:
        for built in (wheel, again):
            text = built.read("sb3_guard/COMMIT").decode().strip()
            assert text.removesuffix("-dirty") == head
    (source / "sb3_guard" / "COMMIT").unlink()  # outside git, nothing else tells
    subprocess.run([*build, "wheel"], cwd=source, check=True, capture_output=True)


@pytest.mark.slow
def test_a_wheel_installed_elsewhere_trains_and_plays(wheel, tmp_path):
    site = tmp_path / "site"
    wheel.extractall(site)
    agents = [name for name in wheel.namelist() if name.startswith("sb3_guard/pretrained/")]
    shipped = len([*(ROOT / "sb3_guard" / "pretrained").rglob("*.pth")])
    assert sum(name.endswith(".pth") for name in agents) == shipped > 0
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

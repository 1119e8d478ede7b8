"""Run folders: numbered, whole, and owned by one process."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from full_disk import files_end_at
from huggingface_sb3 import EnvironmentName
from rl_zoo3.utils import get_latest_run_id, get_saved_hyperparams

from sb3_guard.common.files import replacing
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.cli.usage import run as usage_run
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder, RunInUse, folder_name, latest_run, lock
from sb3_guard.zoo.run.logger import RunLogger, cut


def create(tmp_path, env_id="Goal_Point_8Hazards-v0", **kwargs) -> RunFolder:
    flags = RunFlags(log_folder=str(tmp_path), algo="cpo", env=env_id, **kwargs)
    return RunFolder.create(flags, {"n_steps": 5, "normalize": True}, "train me")


def test_numbers_go_up_and_belong_to_one_environment(tmp_path):
    names = [create(tmp_path).path.name for _ in range(3)]
    assert names == [f"Goal_Point_8Hazards-v0_{k}" for k in (1, 2, 3)]
    assert create(tmp_path, "Goal-v0").path.name == "Goal-v0_1"
    assert create(tmp_path, uuid=True).path.name.startswith("Goal_Point_8Hazards-v0_4_")
    assert latest_run(tmp_path / "cpo", "Goal_Point_8Hazards-v0") == 3


def test_a_number_taken_meanwhile_is_passed_over(tmp_path, monkeypatch):
    create(tmp_path)
    monkeypatch.setattr("sb3_guard.zoo.run.folder.latest_run", lambda *_: 0)
    assert create(tmp_path).path.name.endswith("_2")


@pytest.mark.parametrize("env_id", ["A-v0", "package:A-v0", "space/A-v0"])
def test_names_are_rl_zoos(env_id):
    assert folder_name(env_id) == EnvironmentName(env_id)


def test_rl_zoo_reads_it(tmp_path):
    run = create(tmp_path)
    assert get_latest_run_id(str(tmp_path / "cpo"), run.name) == 1
    values, _ = get_saved_hyperparams(str(run.params), test_mode=True)
    assert values["n_steps"] == 5 and values["normalize"] is True
    assert yaml.safe_load((run.params / "args.yml").read_text())["algo"] == "cpo"
    assert (run.params / "command.txt").read_text() == "train me"


def test_found_again_by_folder_and_by_checkpoint(tmp_path):
    run = create(tmp_path)
    run.checkpoint.touch()
    for path in (run.path, run.checkpoint):
        again = RunFolder(path)
        assert (again.path, again.name) == (run.path, run.name)
    assert again.args()["env"] == "Goal_Point_8Hazards-v0"
    assert again.hyperparams() == {"n_steps": 5, "normalize": True}


def test_not_a_run(tmp_path):
    with pytest.raises(UsageError, match="is not a run folder"):
        RunFolder(tmp_path)
    with pytest.raises(UsageError, match="there is no run folder"):
        RunFolder(tmp_path / "absent")


@pytest.mark.parametrize("content", ["a: [", "just text"])
def test_damaged_config(tmp_path, content):
    run = create(tmp_path)
    (run.params / "config.yml").write_text(content)
    with pytest.raises(UsageError, match=r"config\.yml"):
        run.hyperparams()


def test_one_owner_at_a_time(tmp_path):
    run = create(tmp_path)
    with lock(run.path):
        with pytest.raises(UsageError, match=f"in use by process {os.getpid()} on"), lock(run.path):
            pass
    with lock(run.path):
        pass


def die_holding(folder):
    """A process that is killed while it has the lock."""
    script = (
        "import os, pathlib, signal\n"
        "from sb3_guard.zoo.run.folder import lock\n"
        f"with lock(pathlib.Path({str(folder)!r})):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == -9
    assert (folder / ".lock").exists()


def test_a_dead_owner_is_succeeded(tmp_path):
    run = create(tmp_path)
    file = run.path / ".lock"
    die_holding(run.path)
    with lock(run.path):
        assert file.read_text().split()[0] == str(os.getpid())
    assert not file.exists()
    file.touch()  # one that was killed before it wrote who it is
    with lock(run.path):
        assert file.read_text().split()[0] == str(os.getpid())


def test_an_owner_elsewhere_may_be_alive(tmp_path):
    run = create(tmp_path)
    (run.path / ".lock").write_text("12\nelsewhere\n")
    with pytest.raises(RunInUse, match="process 12 on elsewhere; if that is gone, remove"):
        with lock(run.path):
            pass


def test_a_full_disk_is_told_where_the_lock_of_a_dead_owner_can_not_be_replaced(tmp_path):
    run = create(tmp_path)
    die_holding(run.path)
    before = {path: path.stat().st_size for path in run.path.iterdir()}
    with files_end_at(0), pytest.raises(UsageError, match="File too large"):
        with lock(run.path):
            pass
    assert {path: path.stat().st_size for path in run.path.iterdir()} == before
    with lock(run.path):
        pass


def test_files_appear_whole_or_not_at_all(tmp_path):
    path = tmp_path / "file"
    with replacing(path) as file:
        file.write(b"old")
        assert not path.exists()
    with pytest.raises(RuntimeError), replacing(path) as file:
        file.write(b"half of the n")
        raise RuntimeError
    assert path.read_bytes() == b"old"
    with open(path, "rb") as reader:
        with replacing(path) as file:
            file.write(b"new")
        # Who had opened the old file still has all of it.
        assert (reader.read(), path.read_bytes()) == (b"old", b"new")
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


def test_a_folder_or_device_is_not_replaced(tmp_path):
    for path in (tmp_path, Path("/dev/null")):
        with pytest.raises(OSError, match="is a folder or device"), replacing(path):
            pass


def rows(path) -> list[str]:
    return (path / "progress.csv").read_text().splitlines()


def test_progress_goes_on_where_it_was(tmp_path):
    logger = RunLogger(tmp_path)
    for k in range(3):
        logger.record("a", k)
        logger.dump(k)
    logger.record("pending", 7)
    state = logger.state(iterations=3)
    logger.record("b", 9)
    logger.dump(4)  # dropped
    logger.close()

    again = RunLogger(tmp_path, state=state)
    again.record("a", 10)
    again.record("time/iterations", 1)
    again.dump(5)
    again.close()
    header, *lines = rows(tmp_path)
    table = [dict(zip(header.split(","), line.split(","), strict=True)) for line in lines]
    assert [row["a"] for row in table] == ["0", "1", "2", "10"]
    assert (table[-1]["pending"], table[-1]["time/iterations"]) == ("7", "4")


def test_what_came_after_the_checkpoint_is_cut(tmp_path):
    """Columns that came later are added again by the continued run."""
    logger, states = RunLogger(tmp_path), []
    for k in range(6):
        states.append(logger.state(iterations=k))
        logger.record("a" if k < 3 else "b", k)
        logger.dump(k)
    logger.close()
    whole = (tmp_path / "progress.csv").read_bytes()
    again = RunLogger(tmp_path, state=states[3])
    for k in range(3, 6):
        again.record("b", k)
        again.dump(k)
    again.close()
    assert (tmp_path / "progress.csv").read_bytes() == whole
    assert cut(tmp_path / "progress.csv", 2)
    assert (tmp_path / "progress.csv").read_text() == "a,b\n0,\n"
    assert not cut(tmp_path / "absent.csv", 2)


def test_a_full_disk_is_a_line(capsys):
    def full():
        raise OSError(28, "No space left on device")

    assert usage_run(full) == 2
    error = capsys.readouterr().err
    assert "No space left" in error and len(error.splitlines()) == 1


def test_nobody_reads_the_output():
    command = [
        sys.executable,
        "-c",
        "from sb3_guard.cli import main; raise SystemExit(main(['list', 'tasks']))",
    ]
    listing = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    listing.stdout.close()
    assert listing.wait() == 141 and listing.stderr.read() == b""

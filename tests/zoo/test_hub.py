"""Agents for the hub: what is uploaded, what becomes of a download, and no network."""

import json
import shlex
import sys
from pathlib import Path

import gymnasium
import pytest
import yaml
from typed import PLAY, trained

from sb3_guard import enjoy, hub, train
from sb3_guard.zoo.agents.flags import EnjoyFlags, HubFlags

WHICH = ["--env", "Filmed-v0", "--gym-packages", "registered_envs", "--n-episodes", "5"]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    trained(
        folder, "--eval-freq", "-1", "-params", "normalize:True", "cost_limit:2", env="Filmed-v0"
    )
    return folder


def staged(logs, folder, *flags):
    return pushed(logs, "--to", str(folder), *flags)


def pushed(logs, *flags):
    return hub.main(["push", *WHICH, "-f", str(logs), "-orga", "me", *flags])


def test_what_is_uploaded(logs, tmp_path):
    assert staged(logs, tmp_path) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "Filmed-v0", "Filmed-v0.zip", "0.monitor.csv", "results.json", "README.md", "replay.mp4",
    }  # fmt: skip
    results = json.loads((tmp_path / "results.json").read_text())
    _, metadata, page = (tmp_path / "README.md").read_text().split("---\n", 2)
    metrics = yaml.safe_load(metadata)["model-index"][0]["results"][0]["metrics"]
    values = {one["type"]: float(one["value"].split()[0]) for one in metrics}
    assert values["mean_cost"] == pytest.approx(results["cost"]["mean"], abs=0.006)
    assert values["mean_reward"] == pytest.approx(results["return"]["mean"], abs=0.006)
    assert "limit 2: " in page and "-orga me -name cpo-Filmed-v0" in page


def test_the_commands_of_the_card_are_commands(logs, tmp_path):
    assert staged(logs, tmp_path, "--no-video") == 0
    page = (tmp_path / "README.md").read_text()
    lines = [line for line in page.splitlines() if line.startswith("sb3-guard ")]
    load, play, again = (shlex.split(line) for line in lines)
    assert load[:3] == ["sb3-guard", "hub", "load"] and HubFlags.parse(load[2:])
    assert play[:2] == ["sb3-guard", "enjoy"] and EnjoyFlags.parse(play[2:])
    assert again[:2] == ["sb3-guard", "train"] and train.Flags.parse(again[2:])


def test_no_path_of_this_machine_is_uploaded(logs, tmp_path, monkeypatch):
    args = logs / "cpo" / "Filmed-v0_1" / "Filmed-v0" / "args.yml"
    before = args.read_text()
    args.write_text(yaml.safe_dump(yaml.safe_load(before) | {"trained_agent": f"{logs}/old.zip"}))
    try:
        assert staged(logs, tmp_path, "--no-video") == 0
        assert str(logs) in args.read_text()
    finally:
        args.write_text(before)
    params = tmp_path / "Filmed-v0"
    assert " --trained-agent old.zip" in (params / "command.txt").read_text()
    for file in (tmp_path / "README.md", *params.glob("*.[yt]*")):
        assert str(logs.parent) not in file.read_text(), file
    flags = yaml.safe_load((params / "args.yml").read_text())
    assert (flags["algo"], flags["log_folder"]) == ("cpo", logs.name)


def test_there_and_back(logs, tmp_path, monkeypatch, capsys):
    assert staged(logs, tmp_path / "hub", "--no-video") == 0
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda repo: str(tmp_path / "hub"))
    load = ["load", *WHICH[:4], "-orga", "me", "-f", str(tmp_path / "logs")]
    (tmp_path / "logs" / "cpo" / "Filmed-v0_1").mkdir(parents=True)
    monkeypatch.setattr("sb3_guard.zoo.run.folder.latest_run", lambda *_: 0)  # taken meanwhile
    assert hub.main(load) == 0
    monkeypatch.undo()
    out = capsys.readouterr().out
    assert "load only from people you trust" in out and "Filmed-v0_2" in out
    outputs = []
    for folder in (logs, tmp_path / "logs"):
        capsys.readouterr()
        play = [*PLAY, "-f", str(folder), "--n-episodes", "2", "--verbose", "0"]
        assert enjoy.main(play) == 0
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1]


def test_an_environment_that_only_the_runs_package_knows(tmp_path, monkeypatch, capsys):
    """The command line names the package that the run does, to push and to load."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "stranger.py").write_text(
        "import gymnasium\n"
        "gymnasium.register('Stranger-v0', entry_point='registered_envs:Filmed')\n"
    )
    trained(tmp_path / "logs", "--gym-packages", "stranger", "--eval-freq", "-1", env="Stranger-v0")

    def hub_in_a_new_process(direction, *flags):
        sys.modules.pop("stranger", None)
        gymnasium.registry.pop("Stranger-v0", None)
        return hub.main([direction, "--env", "Stranger-v0", "-orga", "me", *flags])

    push = ["push", "--n-episodes", "2", "--to", "card", "--no-video"]
    assert hub_in_a_new_process(*push) == 2
    assert "then add --gym-packages stranger" in capsys.readouterr().err
    assert hub_in_a_new_process(*push, "--gym-packages", "stranger") == 0
    page = (tmp_path / "card" / "README.md").read_text()
    assert page.count("-f logs --gym-packages stranger\n") == 2
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda repo: str(tmp_path / "card"))
    load = ["load", "-name", "it", "-f", "downloaded", "--gym-packages", "stranger"]
    assert hub_in_a_new_process(*load) == 0
    assert hub_in_a_new_process("load", "-f", "other") == 2
    assert "unknown environment 'Stranger-v0'" in capsys.readouterr().err
    assert (tmp_path / "downloaded" / "cpo" / "Stranger-v0_1").is_dir()


def test_without_a_network(logs, tmp_path, monkeypatch, capsys):
    def fail(*args, **kwargs):
        raise ConnectionError("no route to host")

    monkeypatch.setattr("huggingface_hub.HfApi.create_repo", fail)
    monkeypatch.setattr("huggingface_hub.snapshot_download", fail)
    assert pushed(logs, "--no-video") == 2
    out, err = capsys.readouterr()
    folder = out.split("Ready to upload: ")[1].strip()
    assert f"the upload of {folder} to me/cpo-Filmed-v0" in err
    assert Path(folder, "README.md").is_file()  # the work is not lost
    assert hub.main(["load", "-orga", "me", "-f", str(tmp_path / "logs")]) == 2
    assert "the hub can't be reached" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


def test_a_repository_of_another_agent(logs, tmp_path, monkeypatch, capsys):
    (tmp_path / "none").mkdir()
    load = ["load", "-orga", "me", "-f", str(tmp_path / "logs")]
    for repository, message in (
        (tmp_path / "none", "none is not a run folder"),
        (logs / "cpo" / "Filmed-v0_1", "has an agent of cpo on Filmed-v0; name its own"),
    ):
        monkeypatch.setattr("huggingface_hub.snapshot_download", lambda repo, at=repository: at)
        assert hub.main(load) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


def test_a_broken_command_in_a_result_does_no_harm(logs, tmp_path):
    file = logs / "cpo" / "Filmed-v0_1" / "result.json"
    before = file.read_text()
    file.write_text(json.dumps(json.loads(before) | {"command": "train 'open"}))
    try:
        assert staged(logs, tmp_path, "--no-video") == 0
    finally:
        file.write_text(before)


def test_a_folder_that_can_not_be_written(logs, capsys, monkeypatch):
    assert staged(logs, "/dev/null/x", "--no-video") == 2
    assert "can't write to /dev/null/x: " in capsys.readouterr().err

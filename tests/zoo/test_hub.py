"""Agents for the hub: what is uploaded, and that it is played as it was."""

import json
import re
import shlex

import pytest
import yaml
from typed import PLAY, trained

from sb3_guard import enjoy, hub, train
from sb3_guard.zoo.agents.flags import EnjoyFlags

WHICH = ["--env", "Filmed-v0", "--gym-packages", "registered_envs", "--n-episodes", "5"]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    trained(
        folder, "--eval-freq", "-1", "-params", "normalize:True", "cost_limit:2", env="Filmed-v0"
    )
    return folder


def staged(logs, folder, *flags):
    return hub.main([*WHICH, "-f", str(logs), "-o", str(folder), *flags])


def test_what_is_uploaded(logs, tmp_path):
    assert staged(logs, tmp_path) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "Filmed-v0", "Filmed-v0.zip", "0.monitor.csv", "README.md", "replay.mp4",
    }  # fmt: skip
    _, metadata, page = (tmp_path / "README.md").read_text().split("---\n", 2)
    metrics = yaml.safe_load(metadata)["model-index"][0]["results"][0]["metrics"]
    values = {one["type"]: float(one["value"].split()[0]) for one in metrics}
    said = re.search(r"5 episodes: return (\S+) .*, cost (\S+) .*, limit 2: ", page)
    assert "# CPO on Filmed-v0\n\nA **CPO** agent" in page
    got = [values["mean_reward"], values["mean_cost"]]
    assert got == pytest.approx([float(said[1]), float(said[2])], abs=0.006)


def test_the_commands_of_the_card_are_commands(logs, tmp_path, capsys):
    assert staged(logs, tmp_path, "--no-video") == 0
    assert f"hf upload YOU/cpo-Filmed-v0 {tmp_path}\n" in capsys.readouterr().out
    page = (tmp_path / "README.md").read_text()
    lines = [line for line in page.splitlines() if line.startswith("sb3-guard ")]
    play, again = (shlex.split(line) for line in lines)
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


def test_what_was_written_is_played_alike(logs, tmp_path, capsys):
    assert staged(logs, tmp_path / "cpo" / "Filmed-v0_1", "--no-video") == 0
    outputs = []
    for folder in (logs, tmp_path):
        capsys.readouterr()
        play = [*PLAY, "-f", str(folder), "--n-episodes", "2", "--verbose", "0"]
        assert enjoy.main(play) == 0
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1]


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

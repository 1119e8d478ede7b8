"""Agents for the hub: what is uploaded, and that it is played as it was."""

import shlex
import shutil

import pytest
import yaml
from typed import PLAY, TOY, refused, trained

from sb3_guard import certify_agent, enjoy, hub, train
from sb3_guard.zoo.agents.flags import EnjoyFlags


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(
        tmp_path_factory.mktemp("logs"), "-n", "480", "-params", "normalize:True", "cost_limit:2",
        env="Filmed-v0",
    )  # fmt: skip


def staged(run, folder):
    assert hub.main([str(run), "-o", str(folder), *TOY[:2]]) == 0
    return (folder / "README.md").read_text()


def test_what_is_uploaded(run, tmp_path):
    _, metadata, page = staged(run, tmp_path).split("---\n", 2)
    assert {path.name for path in tmp_path.iterdir()} >= {
        "Filmed-v0", "Filmed-v0.zip", "0.monitor.csv", "README.md",
    }  # fmt: skip
    assert not {*tmp_path.glob("checkpoint.zip"), *tmp_path.glob("result.json")}
    assert "Filmed-v0" in yaml.safe_load(metadata)["tags"]
    assert "# CPO on Filmed-v0\n" in page and "480 steps at cost limit 2.0, last epoch: " in page
    assert "sampled actions: return " in page and "most likely actions: return " in page


def test_the_commands_of_the_card_are_commands(run, tmp_path, capsys):
    page = staged(run, tmp_path)
    assert f"hf upload YOU/cpo-Filmed-v0 {tmp_path}\n" in capsys.readouterr().out
    lines = [line for line in page.splitlines() if line.startswith("sb3-guard ")]
    play, again = (shlex.split(line, comments=True) for line in lines)
    assert play[:2] == ["sb3-guard", "enjoy"] and EnjoyFlags.parse(play[2:])
    assert again[:2] == ["sb3-guard", "train"] and train.Flags.parse(again[2:])


def test_no_path_of_this_machine_is_uploaded(run, tmp_path):
    args, logs = run / "Filmed-v0" / "args.yml", run.parents[1]
    before = args.read_text()
    args.write_text(yaml.safe_dump(yaml.safe_load(before) | {"trained_agent": f"{logs}/old.zip"}))
    try:
        staged(run, tmp_path)
        assert str(logs) in args.read_text()
    finally:
        args.write_text(before)
    params = tmp_path / "Filmed-v0"
    assert " --trained-agent old.zip" in (params / "command.txt").read_text()
    for file in (tmp_path / "README.md", *params.glob("*.[yt]*")):
        assert str(logs.parent) not in file.read_text(), file
    flags = yaml.safe_load((params / "args.yml").read_text())
    assert (flags["algo"], flags["log_folder"]) == ("cpo", logs.name)


def test_what_was_written_is_played_alike(run, tmp_path, capsys):
    staged(run, tmp_path)
    outputs = []
    for folder in (run, tmp_path):
        capsys.readouterr()
        play = [*PLAY, "-f", str(folder), "--n-episodes", "2", "--verbose", "0"]
        assert enjoy.main(play) == 0
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1]


def test_a_folder_that_can_not_be_written(run, capsys):
    assert hub.main([str(run), "-o", "/dev/null/x"]) == 2
    assert "can't write to /dev/null/x: " in capsys.readouterr().err


@pytest.mark.parametrize(
    "name", ["certified_model.zip", "best_model.zip", "0.monitor.csv", "Filmed-v0/config.yml"]
)
def test_a_link_to_a_file_elsewhere_is_not_uploaded(run, tmp_path, capsys, name):
    copied, private = tmp_path / "run", tmp_path / "private"
    shutil.copytree(run, copied)
    (copied / name).unlink(missing_ok=True)
    private.write_text("a: secret")
    (copied / name).symlink_to("../" * (1 + name.count("/")) + "private")
    refused(hub.main, [str(copied), "-o", str(tmp_path / "agent")], capsys, name, "is a link")
    assert not (tmp_path / "agent").exists()


def test_a_link_within_the_run_is_a_file_of_it(run, tmp_path):
    copied = tmp_path / "run"
    shutil.copytree(run, copied)
    (copied / "certified_model.zip").symlink_to("Filmed-v0.zip")
    (tmp_path / "link").symlink_to("run")
    staged(tmp_path / "link", tmp_path / "agent")
    uploaded = tmp_path / "agent" / "certified_model.zip"
    assert uploaded.read_bytes() == (run / "Filmed-v0.zip").read_bytes()
    assert not uploaded.is_symlink()


def test_a_folder_holds_the_last_agent_alone(run, tmp_path):
    other, folder = tmp_path / "Other-v0_1", tmp_path / "agent"
    shutil.copytree(run, other)
    for name in ("certified_model.zip", "best_model.zip"):
        (other / name).touch()
    (other / "Filmed-v0.zip").rename(other / "Other-v0.zip")
    (other / "Filmed-v0").rename(other / "Other-v0")
    args = other / "Other-v0" / "args.yml"
    args.write_text(args.read_text().replace("Filmed-v0", "Other-v0"))
    staged(other, folder)
    (folder / ".gitattributes").touch()  # of a clone
    staged(run, folder)
    staged(run, tmp_path / "alone")
    names = {path.relative_to(folder) for path in folder.rglob("*")}
    alone = {path.relative_to(tmp_path / "alone") for path in (tmp_path / "alone").rglob("*")}
    assert {path.name for path in names - alone} == {".gitattributes"} and names > alone


@pytest.mark.parametrize("name", ["notes.txt", "Filmed-v0/notes.txt", "Filmed-v0.zip"])
def test_files_of_others_are_not_overwritten(run, tmp_path, capsys, name):
    folder = tmp_path / "agent"
    if name != "Filmed-v0.zip":  # among those of an agent
        staged(run, folder)
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text("mine")
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    refused(hub.main, [str(run), "-o", str(folder)], capsys, f"{folder} holds", name, "-o")
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


def test_only_what_a_run_writes_is_uploaded(run, tmp_path):
    copied = tmp_path / "run"
    shutil.copytree(run, copied)
    for name in ("certificate_private.key", "best_model_notes.txt"):
        (copied / name).write_text("mine")
    staged(copied, tmp_path / "agent")
    assert not {*(tmp_path / "agent").glob("*private*"), *(tmp_path / "agent").glob("*notes*")}


def test_a_certificate_without_its_model_is_not_shown(run, tmp_path, capsys):
    copied = tmp_path / "run"
    shutil.copytree(run, copied)
    (copied / "certificate.json").write_text("{}")  # as certify --json may write it
    refused(
        hub.main, [str(copied), "-o", str(tmp_path / "agent")], capsys, "no certified_model.zip"
    )
    assert enjoy.main([*PLAY, "-f", str(copied), "--n-episodes", "1"]) == 0
    assert f"Playing {copied / 'Filmed-v0.zip'}" in capsys.readouterr().out


def test_the_card_shows_the_certificate_of_this_very_agent_alone(run, tmp_path):
    copied = tmp_path / "run"
    shutil.copytree(run, copied)
    shutil.copy(copied / "Filmed-v0.zip", copied / "certified_model.zip")
    statistics = copied / "certified_model_vecnormalize.pkl"
    shutil.copy(copied / "Filmed-v0" / "vecnormalize.pkl", statistics)
    pages = []
    for number, more in enumerate(([], ["--env-kwargs", "max_episode_steps:3"])):
        file = str(copied / "certificate.json")
        asked = ["--cost-limit", "1000", "--n-episodes", "100", "--json", file]
        assert certify_agent.main(["-f", str(copied), *PLAY[:4], *asked, *more]) == 0
        pages.append(staged(copied, tmp_path / f"agent{number}"))
    assert "certified: mean cost " in pages[0]
    assert "certified: " not in pages[1] and "certificate is of another environment" in pages[1]


def test_a_run_is_not_written_into_its_own_folder(run, capsys):
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    refused(hub.main, [str(run), "-o", str(run)], capsys, "holds files of others")
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before

"""Agents for the hub: what is uploaded, what becomes of a download, and no network."""

import json

import pytest
import yaml
from test_commands import PLAY, trained

from sb3_guard import enjoy, hub
from sb3_guard.zoo import hub as zoo_hub

WHICH = ["--env", "Filmed-v0", "--gym-packages", "registered_envs", "--n-episodes", "2"]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    trained(folder, "--eval-freq", "-1", "-params", "normalize:True", env="Filmed-v0")
    return folder


NAME = "cpo-Goal_Point_8Hazards-v0"
ZOO = "!!python/object/apply:collections.OrderedDict\n- - [algo, ppo]\n  - [env, X-v0]\n"


def staged(logs, folder, *flags):
    push = ["push", *WHICH, "-f", str(logs), "-orga", "me", "--to", str(folder), *flags]
    return hub.main(push)


def test_what_is_uploaded(logs, tmp_path):
    assert staged(logs, tmp_path, "--dry-run") == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "cpo-Filmed-v0.zip", "vec_normalize.pkl", "config.yml", "args.yml", "command.txt",
        "0.monitor.csv", "results.json", "README.md", "replay.mp4",
    }  # fmt: skip
    results = json.loads((tmp_path / "results.json").read_text())
    _, metadata, page = (tmp_path / "README.md").read_text().split("---\n", 2)
    metrics = yaml.safe_load(metadata)["model-index"][0]["results"][0]["metrics"]
    values = {one["type"]: float(one["value"].split()[0]) for one in metrics}
    assert values["mean_cost"] == pytest.approx(results["cost"]["mean"], abs=0.006)
    assert values["mean_reward"] == pytest.approx(results["return"]["mean"], abs=0.006)
    assert "under a limit of 2.0" in page and "--repo-id me/cpo-Filmed-v0" in page


def test_no_path_of_this_machine_is_uploaded(logs, tmp_path):
    params = logs / "cpo" / "Filmed-v0_1" / "Filmed-v0"
    (params / "command.txt").write_text(f"{logs}/bin/python -m sb3_guard.train -f {logs}")
    assert staged(logs, tmp_path, "--dry-run", "--no-video") == 0
    assert str(logs) in (params / "args.yml").read_text()
    expected = f"python -m sb3_guard.train -f {logs.name}"
    assert (tmp_path / "command.txt").read_text() == expected
    for file in ("args.yml", "command.txt", "config.yml", "README.md"):
        assert str(logs.parent) not in (tmp_path / file).read_text(), file
    flags = yaml.safe_load((tmp_path / "args.yml").read_text())
    assert (flags["algo"], flags["log_folder"]) == ("cpo", logs.name)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{algo: cpo, env: X-v0}", "is cpo on X-v0"),
        (ZOO, "is ppo on X-v0"),
        ("[", "can't read"),
        ("a", "is damaged"),
    ],
)
def test_a_download_that_is_another_agent(tmp_path, monkeypatch, capsys, text, message):
    (tmp_path / "hub").mkdir()
    for name, content in {"args.yml": text, "config.yml": "", f"{NAME}.zip": ""}.items():
        (tmp_path / "hub" / name).write_text(content)
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda repo: str(tmp_path / "hub"))
    assert hub.main(["load", "-orga", "me", "-f", str(tmp_path / "logs")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


def test_there_and_back(logs, tmp_path, monkeypatch, capsys):
    assert staged(logs, tmp_path / "hub", "--dry-run", "--no-video") == 0
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda repo: str(tmp_path / "hub"))
    load = ["load", *WHICH[:4], "--repo-id", "me/cpo-Filmed-v0", "-f", str(tmp_path / "logs")]
    (tmp_path / "logs" / "cpo" / "Filmed-v0_1").mkdir(parents=True)
    monkeypatch.setattr("sb3_guard.zoo.run_folder.latest_run", lambda *_: 0)  # taken meanwhile
    assert hub.main(load) == 0
    monkeypatch.undo()
    out = capsys.readouterr().out
    assert "load only from people you trust" in out and "Filmed-v0_2" in out
    outputs = []
    for folder in (logs, tmp_path / "logs"):
        capsys.readouterr()
        assert enjoy.main([*PLAY, "-f", str(folder), "--n-episodes", "2"]) == 0
        outputs.append(capsys.readouterr().out.splitlines()[1:])
    assert outputs[0] == outputs[1]


@pytest.mark.parametrize("error", [ConnectionError("no route to host"), TimeoutError()])
def test_without_a_network(logs, tmp_path, monkeypatch, capsys, error):
    def fail(*args, **kwargs):
        raise error

    monkeypatch.setattr("huggingface_hub.HfApi.create_repo", fail)
    monkeypatch.setattr("huggingface_hub.snapshot_download", fail)
    assert staged(logs, tmp_path / "hub", "--no-video") == 2
    assert f"the upload of {tmp_path / 'hub'} to me/cpo-Filmed-v0" in capsys.readouterr().err
    assert (tmp_path / "hub" / "README.md").is_file()  # the work is not lost
    assert hub.main(["load", "-orga", "me", "-f", str(tmp_path / "logs")]) == 2
    assert "the hub can't be reached" in capsys.readouterr().err
    assert not (tmp_path / "logs").exists()


def test_a_repository_of_another_agent(tmp_path, monkeypatch, capsys):
    (tmp_path / "hub").mkdir()
    (tmp_path / "hub" / "ppo-X-v0.zip").touch()
    monkeypatch.setattr("huggingface_hub.snapshot_download", lambda repo: str(tmp_path / "hub"))
    assert hub.main(["load", "-orga", "me", "-f", str(tmp_path / "logs")]) == 2
    assert "has no cpo-Goal_Point_8Hazards-v0.zip, but ppo-X-v0.zip" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [([], "give -orga"), (["--repo-id", "me"], "user/name"), (["--repo-id", "a/b/c"], "user/name")],
)
def test_whose_repository(flags, message, capsys):
    assert hub.main(["push", *flags]) == 2
    assert message in capsys.readouterr().err


def test_a_login_is_asked_for(logs, tmp_path, monkeypatch, capsys):
    from huggingface_hub.errors import LocalTokenNotFoundError

    def fail(*args, **kwargs):
        raise LocalTokenNotFoundError("no token")

    monkeypatch.setattr("huggingface_hub.HfApi.create_repo", fail)
    assert staged(logs, tmp_path, "--no-video") == 2
    assert "needs a login" in capsys.readouterr().err


def test_names_are_rl_zoos():
    assert zoo_hub.model_name("cpo", "ALE/Pong-v5") == "cpo-ALE-Pong-v5"

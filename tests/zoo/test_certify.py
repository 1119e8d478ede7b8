"""``sb3-guard certify``: agents of run folders and of the package, by fresh episodes."""

import json

import pytest

from sb3_guard import certify_agent

SHORT = ["--pretrained", "--algo", "trpo", "--env-kwargs", "max_episode_steps:5"]


@pytest.mark.parametrize(("limit", "verdict"), [("5", "certified"), ("-1", "exceeded")])
def test_the_status_is_the_verdict(limit, verdict, tmp_path, capsys):
    file = tmp_path / "certificate.json"
    status = certify_agent.main([*SHORT, "--cost-limit", limit, "--json", str(file)])
    assert status == (verdict != "certified")
    assert f"\n{verdict}: mean cost " in capsys.readouterr().out
    content = json.loads(file.read_text())
    assert content["verdict"] == verdict and content["costs"]["cost"]["limit"] == float(limit)
    assert content["env"] == {
        "id": "Goal_Point_8Hazards-v0",
        "kwargs": {"scenario": "Goal_Point_8Hazards-v0", "max_episode_steps": 5},
    }


@pytest.mark.parametrize(
    ("flags", "match"),
    [
        ([], "cost_limit"),
        (["--cost-limit", "1", "2"], "cost_limit"),
        (["--cost-limit", "5", "--n-episodes", "99"], "100"),
    ],
)
def test_what_is_wrong_is_a_line_and_writes_nothing(flags, match, tmp_path, capsys):
    file = tmp_path / "certificate.json"
    assert certify_agent.main([*SHORT, *flags, "--json", str(file)]) == 2
    error = capsys.readouterr().err
    assert match in error and len(error.splitlines()) == 1 and not file.exists()


def test_a_file_that_cannot_be_written_is_told_before_the_episodes(tmp_path, capsys):
    (tmp_path / "taken").touch()
    file = str(tmp_path / "taken" / "certificate.json")
    assert certify_agent.main([*SHORT, "--cost-limit", "5", "--json", file]) == 2
    told = capsys.readouterr()
    assert "taken" in told.err and not told.out

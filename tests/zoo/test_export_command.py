"""``sb3-guard export``: an agent of a run folder as an ONNX file, with what it was measured at."""

import hashlib
import json
import re

import onnxruntime
import pytest
from typed import refused, trained

from sb3_guard import cli, enjoy, export_agent
from sb3_guard.zoo.agents.playback import find_run

WHICH = ["--env", "CostPoint-v0", "--gym-packages", "registered_envs", "--n-episodes", "5"]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    trained(folder, "-params", "normalize:True", "cost_limit:2")
    return folder


def test_an_exported_run_says_what_it_was_trained_at(logs, tmp_path, capsys):
    path = tmp_path / "robot" / "policy.onnx"
    assert cli.main(["export", *WHICH, "-f", str(logs), "--load-best", "-o", str(path)]) == 0
    out = capsys.readouterr().out
    assert str(path) in out and re.search(r"cost \S+ ± \S+, limit 2$", out, re.M)
    session = onnxruntime.InferenceSession(path)
    assert [(each.name, each.shape) for each in session.get_inputs()] == [
        ("observation", ["batch", 4])
    ]
    contract = json.loads((tmp_path / "robot" / "contract.json").read_text())
    run = find_run(logs, "cpo", "CostPoint-v0")
    trained_at = contract["trained"]
    digest = hashlib.sha256((run.path / "best_model.zip").read_bytes()).hexdigest()
    assert trained_at["model_sha256"] == digest
    assert (trained_at["algo"], trained_at["env"]) == ("cpo", "CostPoint-v0")
    assert trained_at["env_kwargs"] == {"episode_length": 20} and trained_at["cost_limit"] == 2
    assert trained_at["measured"]["episodes"] == 5
    assert {*trained_at["measured"]["costs"]["cost"]} == {"mean", "standard_error", "limit"}
    assert contract["costs"] == [{"name": "cost", "limit": 2.0, "per": "episode"}]
    assert contract["inputs"][0]["normalized"] is True


def test_the_folder_of_a_run_says_which_it_is(logs, tmp_path):
    run = find_run(logs, "cpo", "CostPoint-v0")
    here = [*WHICH[2:], "-f", str(run.path), "-o", str(tmp_path / "policy.onnx")]
    args = run.params / "args.yml"
    args.write_text(args.read_text() + "optimize_hyperparameters: false\n")  # as RL-Zoo's has
    assert export_agent.main(here) == 0
    trained_at = json.loads((tmp_path / "contract.json").read_text())["trained"]
    assert (trained_at["algo"], trained_at["env"]) == ("cpo", "CostPoint-v0")


def test_what_can_not_be_exported_is_said_in_a_line(logs, tmp_path, capsys):
    here = [*WHICH, "-f", str(logs)]
    refused(export_agent.main, [*here, "-o", "policy.pt"], capsys, "'policy.pt' must end in .onnx")
    refused(export_agent.main, [*here, "--algo", "pcpo"], capsys, "there is no run of pcpo")
    run = find_run(logs, "cpo", "CostPoint-v0")
    statistics = run.normalizer.read_bytes()
    run.normalizer.unlink()
    refused(export_agent.main, here, capsys, "observation statistics", "No such file")
    run.normalizer.write_bytes(statistics)
    sde = ["-params", "cost_limit:2", "use_sde:True", "--eval-freq", "-1"]
    trained(tmp_path, *sde)
    refused(export_agent.main, [*WHICH, "-f", str(tmp_path)], capsys, "can't export", "gSDE's")


def test_a_pretrained_agent_says_which_limit_it_keeps_and_which_it_was_trained_at(tmp_path):
    which = ["--pretrained", "--env", "Goal_Point_8Ghosts", "--n-episodes", "2"]
    assert export_agent.main([*which, "-o", str(tmp_path / "policy.onnx")]) == 0
    contract = json.loads((tmp_path / "contract.json").read_text())
    assert contract["costs"][0]["limit"] == 5.0 and contract["trained"]["cost_limit"] == 4


def test_each_cost_has_its_error_and_limit_wherever_one_is_shown(tmp_path, capsys):
    limits = "cost_keys:['cost','heat'] cost_limit:[2,1000] normalize:True".split()
    kwargs = ["--env-kwargs", "cost_keys:('cost','heat')", "episode_length:20"]
    trained(tmp_path, "-params", *limits, *kwargs)
    which = [*WHICH[:4], "-f", str(tmp_path)]
    path = tmp_path / "policy.onnx"
    capsys.readouterr()
    assert export_agent.main([*which, "-o", str(path)]) == 0
    exported = capsys.readouterr().out
    assert enjoy.main([*which, "--no-render", "--verbose", "0"]) == 0
    played = capsys.readouterr().out
    measured = json.loads((tmp_path / "contract.json").read_text())["trained"]["measured"]
    assert "100 episodes" in exported and "100 episodes" in played and measured["episodes"] == 100
    for key, limit in (("cost", 2.0), ("heat", 1000.0)):
        cost = measured["costs"][key]
        assert set(cost) == {"mean", "standard_error", "limit"} and cost["limit"] == limit
        words = f", {key} {cost['mean']:.3f} ± {cost['standard_error']:.3f}, limit {limit:g}"
        assert words in exported and words in played

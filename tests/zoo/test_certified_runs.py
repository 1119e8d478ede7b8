"""A run that ends with a certified agent: trained, cut and continued, played, exported."""

import json
import shutil
from contextlib import closing

import pytest
import torch
from killed import crash, runs_of
from typed import LENGTH, SMALL, TOY, refused, trained

from sb3_guard import CPO, certify_agent, enjoy, export_agent, hub, train
from sb3_guard.common.certificate import Certificate
from sb3_guard.judging import EPISODES
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.run import Run

CERTIFY = ["--certify", "100", "--eval-freq", "40", "--eval-episodes", "4", "-n", "240"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("logs"), *CERTIFY, "-params", "cost_limit:400")


def test_a_run_delivers_and_says_so(run, capsys, tmp_path):
    certificate = Certificate.from_json((run / "certificate.json").read_text())
    assert certificate.verdict == "certified"
    delivered = json.loads((run / "result.json").read_text())["delivered"]
    assert delivered == certificate.summary()
    # What plays the agent takes the certified one, and says what is certified.
    here = ["-f", str(run), *TOY[:2], "--n-episodes", "2"]
    assert enjoy.main([*here, "--no-render"]) == 0
    out = capsys.readouterr().out
    assert f"Playing {run / 'certified_model.zip'}" in out and str(certificate) in out
    assert enjoy.main([*here, "--no-render", "--load-final"]) == 0
    assert f"Playing {run / 'CostPoint-v0.zip'}" in capsys.readouterr().out
    assert export_agent.main([*here, "-o", str(tmp_path / "policy.onnx")]) == 0
    trained_at = json.loads((tmp_path / "contract.json").read_text())["trained"]
    assert trained_at["certificate"] == json.loads((run / "certificate.json").read_text())
    # Of sampled actions nothing is certified.
    sampled = [*here, "--stochastic", "-o", str(tmp_path / "policy.onnx")]
    assert export_agent.main(sampled) == 0
    assert json.loads((tmp_path / "contract.json").read_text())["trained"]["certificate"] is None


def test_an_agent_is_played_with_the_actions_that_are_certified(run, capsys, tmp_path, monkeypatch):
    predict, played = CPO.predict, set()

    def watched(self, *args, deterministic=False, **kwargs):
        played.add(not deterministic)
        return predict(self, *args, deterministic=deterministic, **kwargs)

    monkeypatch.setattr(CPO, "predict", watched)
    file, path = run / "certificate.json", tmp_path / "policy.onnx"
    before = file.read_text()
    file.write_text(before.replace('"deterministic": true', '"deterministic": false'))
    here = ["-f", str(run), *TOY[:2], "--n-episodes", "2"]
    for flag, sampled in ([], True), (["--deterministic"], False):
        assert enjoy.main([*here, "--no-render", *flag]) == 0
        assert ("sampled actions, confidence" in capsys.readouterr().out) == sampled
        assert played == {sampled}
        played.clear()
        assert export_agent.main([*here, "-o", str(path), *flag]) == 0
        contract = json.loads((tmp_path / "contract.json").read_text())
        assert bool(contract["trained"]["certificate"]) == sampled
        assert any(entry["name"] == "noise" for entry in contract["inputs"]) == sampled
        assert sampled in played  # beside the comparison with the file
        played.clear()
        certify_agent.main([*here[:-2], "--n-episodes", "100", *flag])
        assert ("sampled actions" in capsys.readouterr().out) == sampled
        assert played == {sampled}
        played.clear()
    file.write_text(before)


def test_the_certified_model_knows_its_age(run):
    model = CPO.load(run / "certified_model.zip")
    ages = {}
    for file in (run / "candidates").iterdir():
        candidate = torch.load(file)
        ages[candidate["num_timesteps"]] = candidate["policy"]
    ages[240] = CPO.load(run / "CostPoint-v0.zip").policy.state_dict()
    for key, value in model.policy.state_dict().items():
        assert torch.equal(value, ages[model.num_timesteps][key])


def test_a_repository_has_the_certificate(run, capsys, tmp_path):
    assert hub.main([str(run), "-o", str(tmp_path), *TOY[:2]]) == 0
    certificate = Certificate.from_json((tmp_path / "certificate.json").read_text())
    assert str(certificate) in (tmp_path / "README.md").read_text()
    assert enjoy.main(["-f", str(tmp_path), *TOY[:2], "--n-episodes", "2", "--no-render"]) == 0
    assert str(certificate) in capsys.readouterr().out


def test_a_certificate_is_not_shown_in_another_world(run, capsys):
    here = ["-f", str(run), "--n-episodes", "2", "--no-render", *TOY[:2]]
    assert enjoy.main([*here, "--env-kwargs", "episode_length:12"]) == 0
    out = capsys.readouterr().out
    assert "Its certificate is of another environment" in out and "certified: mean" not in out


def test_a_certificate_of_another_agent_is_not_shown(run, capsys):
    file = run / "certificate.json"
    before = file.read_text()
    file.write_text(before.replace(json.loads(before)["agent"], "0" * 64))
    here = ["-f", str(run), *TOY[:2], "--n-episodes", "2", "--no-render"]
    assert enjoy.main(here) == 0
    out = capsys.readouterr().out
    assert "Its certificate is of another agent" in out and "certified: mean cost" not in out
    file.write_text(before)


DAMAGES = {
    "text for a number": lambda content: content.update(mean_return="high"),
    "a number for a cost": lambda content: content["costs"].update(cost=3.0),
    "no costs": lambda content: content.update(costs={}),
    "a cost without its limit": lambda content: content["costs"]["cost"].pop("limit"),
    "a number that is none": lambda content: content["costs"]["cost"].update(upper=float("nan")),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_certificate_is_a_line(run, capsys, tmp_path, damage):
    file = run / "certificate.json"
    before = file.read_text()
    DAMAGES[damage](content := json.loads(before))
    file.write_text(json.dumps(content))
    here = ["-f", str(run), *TOY[:2]]
    try:
        refused(enjoy.main, [*here, "--no-render"], capsys, f"{file} is damaged: ")
        refused(
            hub.main,
            [str(run), "-o", str(tmp_path / "agent"), *TOY[:2]],
            capsys,
            f"{file} is damaged: ",
        )
        assert not (tmp_path / "agent").exists()
    finally:
        file.write_text(before)


def test_a_damaged_candidate_is_left_out(run, capsys, tmp_path):
    shutil.copytree(run, folder := tmp_path / "run")
    (folder / "result.json").unlink()
    min((folder / "candidates").iterdir()).write_bytes(b"")
    assert train.main(["-i", str(folder), *TOY[:2], "--verbose", "0"]) == 0
    certificate = Certificate.from_json((folder / "certificate.json").read_text())
    assert certificate.verdict == "certified"


@pytest.mark.parametrize("step", [230, pytest.param(150, marks=pytest.mark.slow)])
def test_a_run_that_is_killed_delivers_the_same(step, tmp_path, monkeypatch):
    more = [*CERTIFY, "-params", "normalize:True", "cost_limit:400"]
    arguments = [*LENGTH, *TOY, *SMALL, *more, "--verbose", "0", "--checkpoint-every", "0"]
    assert train.main([*arguments, "-f", str(tmp_path / "whole")]) == 0
    crash(monkeypatch, [*arguments, "-f", str(tmp_path / "cut")], step)
    assert train.main(["-i", str(runs_of(tmp_path / "cut")), *TOY[:2]]) == 0
    whole, cut = runs_of(tmp_path / "whole"), runs_of(tmp_path / "cut")
    assert (whole / "certificate.json").read_text() == (cut / "certificate.json").read_text()
    parts = [file.name for file in sorted((whole / "candidates").iterdir())]
    assert len(parts) > 1
    for name in parts:
        one, other = (torch.load(run / "candidates" / name) for run in (whole, cut))
        assert one["num_timesteps"] == other["num_timesteps"]
        assert all(torch.equal(value, other["policy"][key]) for key, value in one["policy"].items())


def test_too_few_episodes_are_refused_before_the_training(tmp_path, capsys):
    arguments = [*LENGTH, *TOY, *SMALL, "-f", str(tmp_path), "-n", "120", "--certify", "99"]
    refused(train.main, arguments, capsys, "--certify", "at least 100")
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(("steps", "most"), [("999999", 0), ("1000000", EPISODES)])
def test_a_training_of_a_thousand_episodes_ends_with_a_certificate(steps, most):
    world = ["--algo", "cpo", "--env", "Goal_Point_8Hazards", *SMALL]
    flags = RunFlags.parse([*world, "-n", steps])
    with closing(Run.check(flags).make()) as run:
        assert (run.delivery.n_episodes if run.delivery else 0) == most

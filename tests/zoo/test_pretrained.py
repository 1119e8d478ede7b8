"""The agents that come with the package: shipped, loaded, played, listed and filmed."""

import json
import re
import runpy
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch as th
from PIL import Image
from stable_baselines3.common.vec_env import VecNormalize
from typed import require_rendering

from sb3_guard import cli, enjoy, evaluate_policy, load_pretrained, train
from sb3_guard.common.certificate import Certificate
from sb3_guard.judging import Mean
from sb3_guard.zoo.agents import pretrained
from sb3_guard.zoo.run.folder import RunFolder

POINT = "Goal_Point_8Hazards"
SHIPPED = pretrained.pretrained()
SCRIPTS = Path(__file__).parents[2] / "scripts"
RECORDED = Path(__file__).parents[1] / "data" / "pretrained.npz"


@pytest.mark.parametrize("run", SHIPPED, ids=lambda run: f"{run.path.parent.name}-{run.name}")
def test_a_shipped_agent_is_small_and_acts_as_the_one_that_was_trained(run):
    algo, env_id = run.path.parent.name, run.name
    files = [path for path in run.path.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".pth", ".yml", ".json"}
    assert sum(path.stat().st_size for path in files) < 300_000
    text = "".join(path.read_text() for path in files if path.suffix != ".pth")
    assert "/tmp" not in text and "/work" not in text
    result = run.checked_result()
    for actions, shown in pretrained.certificates(run).items():
        assert shown.deterministic is (actions == "deterministic") and shown.env["id"] == env_id
        assert shown.verdict == ("certified" if "cost_limit" in result else "exceeded")
        assert shown.nearest.limit == result.get("cost_limit", shown.nearest.limit)

    model = load_pretrained(env_id, algo, device="cpu")
    assert model.num_timesteps == result["n_timesteps"] >= 1e6  # contract.json states it
    env = model.get_env()
    for actions, shown in pretrained.certificates(run).items():
        assert shown.foreign(model, env, actions == "deterministic") == ""
    with np.load(RECORDED) as recorded:
        seen = recorded[f"{algo}/{env_id}/observations"]
        if isinstance(env, VecNormalize):
            seen = env.normalize_obs(seen)
        for actions in pretrained.PLAYED:
            th.manual_seed(0)
            got, _ = model.predict(seen, deterministic=actions == "deterministic")
            want = recorded[f"{algo}/{env_id}/{actions}"]
            np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)
    if "cost_limit" in result:
        assert model.final_cost_limits.tolist() == [result["cost_limit"]]


def test_shipped_agents_are_small_together():
    files = [path for path in pretrained.PRETRAINED.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 5_000_000


@pytest.mark.slow
def test_a_certified_run_of_the_grand_table_is_shipped(tmp_path, monkeypatch, capsys):
    """The best certified one of those of an environment; the agent before it is gone."""
    monkeypatch.syspath_prepend(SCRIPTS)
    script = runpy.run_path(str(SCRIPTS / "pretrain.py"))
    toy = (
        "--env Goal_Point_8Hazards --env-kwargs max_episode_steps:50 -n 200 --eval-freq -1 "
        "--verbose 0 --device cpu -f "
        f"{tmp_path / 'grand' / 'grand_table_guard'} -params cost_limit:2 n_envs:2 n_steps:100 "
        "n_critic_updates:1 normalize:True"
    ).split()
    for algo, sampled, greedy, got in (
        ("cpo", 1.0, 1.0, 5.0), ("pcpo", 1.5, 1.5, 6.0), ("trpo_ipo", 3.0, 1.0, 7.0),
        ("trpo_lag", 1.0, 3.0, 7.0), ("rcpo", 0.0, 0.0, 8.0),
    ):  # fmt: skip
        assert train.main(["--algo", algo, "--seed", "0", *toy]) == 0
        file = next((tmp_path / "grand").glob(f"*/{algo}/*/result.json"))
        result = json.loads(file.read_text())
        final = {
            split: {"returns": [got] * 5, "costs": [cost] * 5, "lengths": [9] * 5}
            for split, cost in (("stochastic", sampled), ("greedy", greedy))
        }
        if algo == "rcpo":  # does nothing with its most likely actions
            final["greedy"]["returns"] = [0.5] * 5
        file.write_text(json.dumps(result | {"final": final}))
    there = tmp_path / "pretrained"
    before = there / "trpo_usl" / "Goal_Point_8Hazards-v0_1"
    shutil.copytree(pretrained.PRETRAINED / "trpo_usl" / before.name, before)
    result = json.loads((before / "result.json").read_text())
    (before / "result.json").write_text(json.dumps(result | {"cost_limit": 5}))
    names = script["main"].__globals__
    text = json.dumps(json.loads((before / "result.json").read_text())["played"]["stochastic"])
    shown = replace(Certificate.from_json(text), mean_return=6.0)
    monkeypatch.setitem(names, "played", lambda run: dict.fromkeys(pretrained.PLAYED, shown))
    monkeypatch.setitem(names, "RECORDED", tmp_path / "pretrained.npz")
    for module in (names, vars(pretrained)):
        monkeypatch.setitem(module, "PRETRAINED", there)
    monkeypatch.setattr("sys.argv", ["pretrain.py", str(tmp_path / "grand")])
    script["main"]()
    assert [path.name for path in there.glob("*/*")] == [
        "Goal_Point_8Hazards-v0_1"
    ] and not before.exists()
    result = json.loads((there / "pcpo" / "Goal_Point_8Hazards-v0_1" / "result.json").read_text())
    assert (result["cost_limit"], result["trained_at"]) == (2, 2)
    line = next(
        line for line in capsys.readouterr().out.splitlines() if line.startswith("| Goal_P")
    )
    assert line.count(f"| certified: {shown.nearest.mean:.4g}, upper bound") == 2
    assert line.split()[9] == "6.0"

    best, higher = (tmp_path / "grand" / "grand_table_guard" / algo / before.name
                    for algo in ("pcpo", "trpo_ipo"))  # fmt: skip
    (higher / "result.json").write_text((best / "result.json").read_text().replace("6.0", "8.0"))
    RunFolder(higher).model.unlink()
    made = (there / "pcpo" / before.name).stat().st_mtime_ns
    script["main"]()
    assert (
        f"return 8, but no model: sb3-guard reproduce grand_table_guard/trpo_ipo/{before.name}"
        in capsys.readouterr().out
    )
    assert (there / "pcpo" / before.name).stat().st_mtime_ns == made


@pytest.mark.slow
@pytest.mark.parametrize("run", SHIPPED, ids=lambda run: f"{run.path.parent.name}-{run.name}")
@pytest.mark.parametrize("noise", [False, True])
def test_a_shipped_agent_keeps_its_limit(run, noise):
    """On average, by two standard errors of 200 episodes."""
    model = load_pretrained(run.name, run.path.parent.name, n_envs=50)
    evaluation = evaluate_policy(model, model.get_env(), 200, deterministic=not noise)
    limit = run.checked_result().get("cost_limit", np.inf)
    cost = Mean.of(evaluation.costs)
    assert cost.mean > 0.1 or not noise  # the most likely may cost nothing
    assert cost.mean + 2.0 * cost.error <= limit


def test_a_shipped_agent_is_played(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert enjoy.main(["--pretrained", "--env", POINT, "-n", "20", "--no-render"]) == 0
    out = capsys.readouterr().out
    assert f"{POINT}-v0_1" in out and f"on {POINT}-v0, trained at limit 2\n" in out
    which = ["--algo", "trpo", "--env", POINT, "--no-render"]
    short = ["--n-episodes", "1", "--env-kwargs", "max_episode_steps:30"]
    assert enjoy.main([*which, "--pretrained", *short]) == 0
    out = capsys.readouterr().out
    assert f"on {POINT}-v0\n" in out and "   30 steps\n" in out  # it has no limit


def test_a_film_of_a_shipped_agent_is_not_written_into_the_package(tmp_path, monkeypatch):
    require_rendering()
    monkeypatch.chdir(tmp_path)
    assert enjoy.main(["--pretrained", "--env", POINT, "-n", "3", "--record"]) == 0
    algo = pretrained.find_pretrained(POINT).path.parent.name
    assert [path.name for path in tmp_path.iterdir()] == [f"{algo}-Goal_Point_8Hazards-v0.mp4"]


@pytest.mark.slow
def test_the_film_of_the_readme_is_made_of_shipped_agents(tmp_path, monkeypatch):
    require_rendering()
    script = runpy.run_path(
        str(pretrained.PRETRAINED.parent.parent / "scripts" / "render_gallery.py")
    )
    animation = script["animation"]
    monkeypatch.setitem(animation.__globals__, "FRAMES", 2)
    animation(tmp_path / "film.gif", 0)
    with Image.open(tmp_path / "film.gif") as film:
        assert (film.n_frames, film.size) == (2, (808, 304))
    clip = script["clip"]
    monkeypatch.setitem(clip.__globals__, "CLIP", 2)
    clip("Goal_Point_8Hazards-v0", tmp_path / "clip.webp", "fixed", "no runs", 0)
    with Image.open(tmp_path / "clip.webp") as film:
        assert (film.n_frames, film.size) == (2, (300, 250))


def test_what_is_not_shipped_is_not_played(capsys):
    which = ["--algo", "ppo", "--env", "Goal_Ant_8Hazards"]
    assert enjoy.main(["--pretrained", "--no-render", *which]) == 2
    error = capsys.readouterr().err
    assert "no agent comes with the package for ppo on Goal_Ant_8Hazards-v0" in error


@pytest.mark.parametrize("command", [["list", "agents"], ["enjoy", "--pretrained"]])
def test_the_pretrained_agents_are_listed(command, capsys):
    assert cli.main(command) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    head, *cells = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    assert head[:4] == ["environment", "algorithm", "steps", "trained at"]
    assert [(row[0], row[1]) for row in cells] == [
        (run.name, run.path.parent.name) for run in SHIPPED
    ]
    assert all(re.search(r" bound [\d.]+, limit \d+$", row[5]) for row in cells)

"""RL-Zoo's algorithms on cost environments, and RL-Zoo's own command with ours."""

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from killed import assert_same_run, crash, runs_of

from sb3_guard import enjoy, train
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.run.algos import algorithm, baselines
from sb3_guard.zoo.run.hyperparams import shipped_file

TOY = "--gym-packages registered_envs --env CostPoint-v0 --env-kwargs episode_length:25".split()
SMALL = "--seed 3 --checkpoint-every 0 --verbose 0 --device cpu --eval-episodes 2".split()
ON_POLICY = ["n_envs:2", "n_steps:30"]
OFF_POLICY = ["n_envs:2", "buffer_size:500", "learning_starts:40", "batch_size:16"]
OFF_POLICY += ["policy_kwargs:{'net_arch':[16]}"]
NOISY = ["gradient_steps:2", "noise_type:ornstein-uhlenbeck"]
SLOW = pytest.mark.slow
PARAMS = {
    "ppo": [*ON_POLICY, "batch_size:20", "n_epochs:2"],
    "ppo_lstm": [*ON_POLICY, "batch_size:20", "n_epochs:2"],
    "sac": OFF_POLICY,
    "tqc": OFF_POLICY,
    "crossq": OFF_POLICY,
}
# Within the hazard, far above the limit: multipliers and cost critics matter.
COSTLY = ["cost_limit:0.01", "env_kwargs:{'hazard': (-1.0, 0.0)}"]


def arguments(algo: str, folder: Path, *more: str) -> list[str]:
    params = ["-params", *PARAMS.get(algo, OFF_POLICY), *more]
    return [*TOY, *SMALL, "--algo", algo, "-n", "180", *params, "-f", str(folder)]


@pytest.mark.parametrize(
    "algo",
    [algo if algo == "sac" else pytest.param(algo, marks=SLOW) for algo in PARAMS],
)
def test_trains_with_costs_logged(algo, tmp_path):
    extra = ["--eval-freq", "60", "--log-interval", "1"]
    extra += ["--env-kwargs", "hazard:(-1.0, 0.0)"]  # where episodes start: each has a cost
    assert train.main([*arguments(algo, tmp_path), *extra]) == 0
    run = tmp_path / algo / "CostPoint-v0_1"
    log = pd.read_csv(run / "progress.csv").dropna(subset=["rollout/ep_cost_mean"])
    episodes = pd.read_csv(run / "0.monitor.csv", skiprows=1)
    assert log["rollout/ep_cost_mean"].iloc[-1] == pytest.approx(episodes["c"].mean(), abs=1e-3)
    assert log["rollout/cost_rate"].iloc[-1] > 0.0
    assert np.isfinite(np.load(run / "evaluations.npz")["costs"]).all()
    assert (run / "best_model.zip").is_file()
    assert enjoy.main([*TOY[:4], "--algo", algo, "-f", str(tmp_path), "--n-episodes", "1"]) == 0


def test_costs_of_other_names_are_those_of_the_monitor(tmp_path, capsys):
    """In every evaluation, too: PPO itself does not know of costs."""
    params = ["monitor_kwargs:{'cost_keys': ['heat', 'noise']}", "selection_limit:[1, 2]"]
    extra = ["--eval-freq", "60", "--verbose", "1"]
    extra += [
        "--env-kwargs",
        "hazard:(-1.0, 0.0)",
        "cost_keys:('heat', 'noise')",
        "episode_length:10",
    ]
    assert train.main([*arguments("ppo", tmp_path, *params), *extra]) == 0
    run = tmp_path / "ppo" / "CostPoint-v0_1"
    costs = np.load(run / "evaluations.npz")["key_costs"]  # [evaluations, episodes, 2]
    np.testing.assert_allclose(costs[..., 1], 2 * costs[..., 0], rtol=1e-5)
    assert (costs > 0).all()
    result = json.loads((run / "result.json").read_text())
    assert min(result["final"]["greedy"]["costs"]) > 0
    out = capsys.readouterr().out
    for name, played in zip(("sampled", "most likely"), result["final"].values(), strict=True):
        said = out.partition(f"Final policy, {name} actions")[2].partition("\n")[0]
        assert f", noise {np.mean(played['bounded']['noise']):.3f}" in said
    assert set(result["final"]["greedy"]["bounded"]) == set(result["costs"]) == {"heat", "noise"}
    assert result["costs"]["noise"]["mean"] == pytest.approx(2 * result["costs"]["heat"]["mean"])


@pytest.mark.parametrize(
    ("algo", "more"),
    [
        ("ppo", []),
        pytest.param("sac_lag", ["use_sde:True", *COSTLY], marks=SLOW),
        pytest.param("td3_lag", [*NOISY, *COSTLY], marks=SLOW),
        pytest.param("tqc_lag", COSTLY, marks=SLOW),
    ],
)
def test_killed_and_resumed(algo, more, tmp_path, monkeypatch):
    """In the middle of an episode, where Ornstein-Uhlenbeck noise has a state."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert train.main([*arguments(algo, whole, *more), "--eval-freq", "50"]) == 0
    crash(monkeypatch, [*arguments(algo, cut, *more), "--eval-freq", "50"], 115)
    assert train.main(["-i", str(runs_of(cut)), *TOY[:2]]) == 0
    assert_same_run(whole, cut)


def test_discrete_actions_with_rl_zoos_own_file(tmp_path):
    command = "--algo dqn --env CartPole-v1 -n 300 --eval-freq -1 --verbose 0 -f".split()
    assert train.main([*command, str(tmp_path)]) == 0
    assert shipped_file("dqn").parent.parent.name == "rl_zoo3"


def test_shipped_files_name_only_what_the_algorithms_take():
    from sb3_guard.zoo.run.hyperparams import check, hyperparams_folder, read_hyperparams

    shipped = {path.stem for path in hyperparams_folder().glob("*.yml")} & set(baselines())
    assert shipped == {"a2c", "crossq", "ddpg", "ppo", "ppo_lstm", "sac", "td3", "tqc"}
    for algo in shipped:
        check(algo, algorithm(algo), read_hyperparams(algo, "Goal_Point_8Hazards-v0"))


def test_what_cannot_be_measured_is_refused():
    with pytest.raises(UsageError, match="unknown algorithm 'ars'"):
        algorithm("ars")
    with pytest.raises(UsageError, match="unknown algorithm 'pppo'; did you mean 'ppo'"):
        algorithm("pppo")


def test_rl_zoos_command_with_our_algorithm(tmp_path, monkeypatch, capsys):
    words = (
        "--algo guard_trpo --env Goal_Point_8Hazards-v0 -n 400 --eval-freq 200 --eval-episodes 1 "
        "--env-kwargs max_episode_steps:20 -params n_envs:2 n_steps:100 n_critic_updates:2"
    ).split()
    where = ["-conf", str(shipped_file("trpo")), "-f", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["train", *words, *where])
    runpy.run_module("sb3_guard.zoo.rl_zoo3", run_name="__main__")
    assert "cost_rate" in capsys.readouterr().out
    run = tmp_path / "guard_trpo" / "Goal_Point_8Hazards-v0_1"
    assert (run / "best_model.zip").is_file()
    # Our player reads what RL-Zoo wrote, ordered mappings and all.
    (tmp_path / "guard_trpo").rename(tmp_path / "trpo")
    assert enjoy.main(["--algo", "trpo", "--n-episodes", "1", "-f", str(tmp_path)]) == 0

"""The commands as users type them."""

import json
import os
import re
import signal
import subprocess
import sys
from contextlib import closing, contextmanager
from types import SimpleNamespace

import gymnasium
import numpy as np
import pandas as pd
import pytest
import yaml
from cost_envs import CostPoint
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv
from matplotlib import image
from rl_zoo3.utils import EnvironmentName, get_model_path
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from typed import PLAY, SMALL, TOY, require_rendering, trained

from sb3_guard import CPO, cli, enjoy, make_model, train
from sb3_guard.common.monitor import CostMonitor
from sb3_guard.envs import Scenario, register
from sb3_guard.envs.registry import CONSTRAINTS, ROBOTS, TASKS
from sb3_guard.zoo.agents import playback
from sb3_guard.zoo.cli import usage
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.run import Run, standing_return


def test_track_sends_what_tensorboard_gets_and_goes_on(tmp_path, monkeypatch):
    """With a stand-in for wandb, which sees the event files that are opened after init only."""
    calls, finished, logs = [], [], tmp_path / "logs"

    def init(**kwargs):
        calls.append((kwargs, len(list(tmp_path.rglob("events.*")))))
        return finishing()

    @contextmanager
    def finishing():
        yield
        assert (logs / "cpo" / "CostPoint-v0_1" / "result.json").exists()
        finished.append(True)

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init))
    run = trained(logs, "--track", "-tb", str(tmp_path / "tb"))
    again = ["-i", str(run), *TOY[:2], "--track", "-tb", str(tmp_path / "tb"), "--verbose", "0"]
    assert train.main([*again, "-n", "180"]) == 0
    assert json.loads((run / "result.json").read_text())["n_timesteps"] == 180
    (first, before), (second, after) = calls
    assert (before, after) == (0, 1) and len(finished) == 2
    assert first["sync_tensorboard"] and first["id"] == second["id"]
    assert first["resume"] == second["resume"] == "allow"


def test_run_folder_is_rl_zoos(tmp_path):
    run = trained(tmp_path, "--save-freq", "60")
    assert run.name == "CostPoint-v0_1"
    assert {path.name for path in run.iterdir() if path.name[0] != "."} == {
        "CostPoint-v0", "CostPoint-v0.zip", "0.monitor.csv", "progress.csv", "evaluations.npz",
        "best_model.zip", "checkpoint.zip", "result.json", "rl_model_60_steps.zip",
        "rl_model_120_steps.zip",
    }  # fmt: skip
    for flags in ({}, {"load_best": True}, {"load_last_checkpoint": True}):
        name = EnvironmentName("CostPoint-v0")
        assert get_model_path(0, str(tmp_path), "cpo", name, **flags)[2] == str(run)
    args = yaml.safe_load((run / "CostPoint-v0" / "args.yml").read_text())
    config = yaml.safe_load((run / "CostPoint-v0" / "config.yml").read_text())
    assert (args["seed"], args["env"]) == (3, "CostPoint-v0")
    assert (config["n_envs"], config["n_timesteps"], config["policy"]) == (2, 120, "MlpPolicy")
    assert (run / "CostPoint-v0" / "command.txt").read_text()
    assert CPO.load(run / "CostPoint-v0.zip").num_timesteps == 120
    assert trained(tmp_path).name == "CostPoint-v0_2"


def test_costs_are_in_the_files(tmp_path):
    run = trained(tmp_path)
    episodes = load_results(str(run))
    assert len(episodes) == 6 and (episodes["l"] == 20).all() and (episodes["c"] >= 0).all()
    log = pd.read_csv(run / "progress.csv")
    for key in ("rollout/ep_cost_mean", "rollout/cost_rate", "eval/mean_ep_cost", "train/kl"):
        assert log[key].notna().any()
    assert np.load(run / "evaluations.npz")["costs"].shape == (2, 2)
    result = json.loads((run / "result.json").read_text())
    # Of 20 steps each: one ended in the first rollout of 30 per environment, two in the second.
    last = episodes.sort_values("t").tail(4)
    assert result["episodes"] == 4
    assert result["return"] == pytest.approx(last["r"].mean())
    assert result["cost"] == pytest.approx(last["c"].mean())
    assert result["cost_rate"] == pytest.approx(episodes["c"].sum() / 120)


def test_few_updates_and_few_episodes_are_told(capsys):
    """Advice keeps 20 whole episodes in an update; 600 episodes are 30 such updates."""
    for steps, length, n_steps, said in (
        (9_000, 1000, 500, ""),
        (12_000, 20, 500, "Only 2 updates in 12,000 steps; -params n_envs:20 n_steps:20 makes 30"),
        (90_000, 70, 900, ""),  # 10 updates
        (90_000, 70, 1000, "-params n_envs:20 n_steps:140 makes 32"),
        (60_000, 1000, 500, "60,000 steps are 60 episodes: too few; at least 600,000, 30 updates"),
        (60_000, 1000, 25, "60,000 steps are 60 episodes: too few; at least 600,000, 30 updates"),
        (60_000, 20, 500, ""),
    ):
        given = {"env": "CostPoint-v0", "gym_packages": ["registered_envs"]}
        sizes = {"n_envs": 10, "n_steps": n_steps, "cost_limit": 1.0}
        given |= {"n_timesteps": steps, "hyperparams": sizes}
        given["env_kwargs"] = {"max_episode_steps": length}
        run = Run.check(RunFlags.of(given)).make()
        capsys.readouterr()
        run._advise()
        run.close()
        out = capsys.readouterr().out
        assert said in out and bool(said) == bool(out), (steps, length, out)


def test_no_episode_ends(tmp_path, capsys):
    arguments = [*TOY, *SMALL, "-n", "60", "-f", str(tmp_path), "--eval-freq", "-1"]
    assert train.main([*arguments, "--env-kwargs", "episode_length:1000"]) == 0
    assert "no episode has ended" in capsys.readouterr().out


def test_every_limit_has_its_cost(tmp_path, capsys):
    limits = ["cost_keys:['cost','heat']", "cost_limit:[1000.0, 0.0]"]
    arguments = [*TOY, *SMALL, "-n", "120", "-f", str(tmp_path)]
    world = ["episode_length:10", "cost_keys:['cost','heat']", "hazard:[-1.0, 0.0]"]
    assert train.main([*arguments, "-params", *limits, "--env-kwargs", *world]) == 0
    (run,) = tmp_path.glob("cpo/*_1")
    out = capsys.readouterr().out
    result = json.loads((run / "result.json").read_text())
    cost, heat = result["costs"]["cost"], result["costs"]["heat"]
    assert heat["mean"] == pytest.approx(2 * cost["mean"])  # as the environment has it
    assert cost["mean"] == pytest.approx(result["cost"])
    assert (cost["limit"], heat["limit"]) == (1000, 0) and cost["standard_error"] > 0
    assert f"episode cost M_c {result['cost']:.5g}, " in out


def test_our_environments(tmp_path, capsys):
    run = trained(
        tmp_path, "--env-kwargs", "goal:dict(size=0.5)", "--eval-freq", "-1",
        env="Goal_Point_3Hazards-v0",
    )  # fmt: skip
    config = yaml.safe_load((run / "Goal_Point_3Hazards-v0" / "config.yml").read_text())
    assert config["env_kwargs"]["goal"] == {"size": 0.5}
    capsys.readouterr()
    play = ["--env", "Goal_Point_3Hazards", "-f", str(tmp_path), "--no-render", "-n", "20"]
    assert enjoy.main([*TOY[:2], *play]) == 0
    assert "No episode ended" in capsys.readouterr().out


def test_trpo_on_an_environment_without_costs(tmp_path):
    trained(tmp_path, "--env", "NoCost-v0", algo="trpo", env="NoCost-v0")


def test_missing_costs_may_count_as_zero(tmp_path):
    trained(tmp_path, "-params", "missing_cost:zero", "n_steps:30", env="NoCost-v0")


def test_warm_start_begins_a_new_run_from_an_agent(tmp_path):
    run = trained(tmp_path, "-params", "normalize:True")
    second = trained(tmp_path, "-params", "normalize:True", "-i", str(run / "CostPoint-v0.zip"))
    assert second.name == "CostPoint-v0_2"
    assert CPO.load(second / "CostPoint-v0.zip").num_timesteps == 120
    first, later = (np.load(one / "evaluations.npz")["results"] for one in (run, second))
    assert not np.array_equal(first, later)


def test_tensorboard_and_uuid(tmp_path):
    run = trained(tmp_path / "logs", "-tb", str(tmp_path / "tb"), "-uuid")
    assert len(run.name) > len("CostPoint-v0_1_") + 30
    (events,) = (tmp_path / "tb").rglob("events.*")
    assert events.parent.parent.name == "CostPoint-v0"


# enjoy


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    trained(folder, "--save-freq", "60", "-params", "normalize:True", env="Filmed-v0")
    return folder


@pytest.mark.parametrize(
    "which", [[], ["--load-best"], ["--load-last-checkpoint"], ["--load-checkpoint", "60"]]
)
def test_enjoy_prints_return_and_cost(logs, which, capsys):
    assert enjoy.main([*PLAY, "-f", str(logs), "--n-episodes", "3", *which]) == 0
    out = capsys.readouterr().out
    rows = [line for line in out.splitlines() if line.endswith("20 steps")]
    assert len(rows) == 3 and all("return" in row and "cost" in row for row in rows)
    returns = [float(row.split()[1]) for row in rows]
    *_, mean = out.splitlines()
    assert mean.startswith("3 episodes: return ")
    assert float(mean.split()[3]) == pytest.approx(np.mean(returns), abs=1e-3)


def test_enjoy_says_what_was_cut(logs, capsys):
    assert enjoy.main([*PLAY, "-f", str(logs), "-n", "110"]) == 0
    assert "10 steps so far" in capsys.readouterr().out
    assert enjoy.main([*PLAY, "-f", str(logs), "-n", "50", "--verbose", "0"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("2 episodes: ") and line.endswith("limit 2")  # two decide nothing


def test_enjoy_is_seeded_and_deterministic_by_default(logs, capsys):
    def play(*arguments):
        assert enjoy.main([*PLAY, "-f", str(logs), "--n-episodes", "2", *arguments]) == 0
        return capsys.readouterr().out

    assert play() == play("--deterministic", "--seed", "0") == play()
    assert play("--seed", "1") != play() != play("--stochastic")
    assert play("--stochastic") == play("--stochastic")


def test_an_unfinished_run_is_played_from_its_checkpoint(logs, tmp_path, capsys):
    run = trained(tmp_path, "-params", "normalize:True")
    play = [*TOY, "-f", str(tmp_path), "--no-render", "--n-episodes", "2"]

    def table() -> list[str]:
        assert enjoy.main(play) == 0
        first, *rest = capsys.readouterr().out.splitlines()
        return [first.split()[1], *rest]

    final = table()
    (run / "CostPoint-v0.zip").unlink()
    (run / "CostPoint-v0" / "vecnormalize.pkl").unlink()
    # The last checkpoint is the final agent, observation statistics included.
    assert table() == [str(run / "checkpoint.zip"), *final[1:]]


def test_enjoy_normalises_as_training_did(tmp_path, capsys):
    run = trained(tmp_path, "-params", "normalize:True")
    play = [*TOY, "-f", str(tmp_path), "--no-render", "--n-episodes", "2"]
    path = run / "CostPoint-v0" / "vecnormalize.pkl"
    assert enjoy.main(play) == 0
    before = capsys.readouterr().out
    statistics = VecNormalize.load(str(path), DummyVecEnv([CostPoint]))
    statistics.obs_rms.mean += 5.0
    statistics.save(str(path))
    assert enjoy.main(play) == 0
    assert capsys.readouterr().out != before
    statistics.norm_obs = False
    statistics.save(str(path))
    assert enjoy.main(play) == 2
    assert "statistics lack some that normalize asks for" in capsys.readouterr().err
    path.unlink()
    assert enjoy.main(play) == 2
    assert "can't read the observation statistics" in capsys.readouterr().err


def test_a_normalizer_among_the_wrappers_is_refused(tmp_path, capsys):
    wrapper = "vec_env_wrapper:stable_baselines3.common.vec_env.VecNormalize"
    assert (
        train.main([*TOY, "-f", str(tmp_path), "-n", "60", "-params", "cost_limit:1.0", wrapper])
        == 2
    )
    assert "VecNormalize in vec_env_wrapper: use normalize" in capsys.readouterr().err


@pytest.mark.parametrize("vec_env", ["subproc", "gymnasium"])
def test_processes_of_environments_see_no_interrupt(vec_env, monkeypatch):
    flags = {"env": "CostPoint-v0", "gym_packages": ["registered_envs"], "vec_env": vec_env}
    usage.import_packages(flags["gym_packages"])
    monkeypatch.setattr(
        gymnasium.spec("CostPoint-v0"),
        "vector_entry_point",
        lambda num_envs: AsyncVectorEnv([CostPoint] * num_envs, context="fork"),
    )
    run = Run(RunFlags(**flags), {"cost_limit": 1.0})
    with closing(run.make_envs(1, 0)) as env:
        owner = getattr(env.unwrapped, "envs", env.unwrapped)
        os.kill(owner.processes[0].pid, signal.SIGINT)
        env.reset()


def test_an_interrupt_while_a_command_is_imported(monkeypatch, capsys):
    def interrupted(name):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.importlib, "import_module", interrupted)
    assert cli.main(["train"]) == 130 and capsys.readouterr().err == ""


def test_packages_are_found_in_the_current_folder(tmp_path, monkeypatch):
    """The script sb3-guard has its own folder on the path, not the current one."""
    (tmp_path / "parts_of_mine.py").touch()
    monkeypatch.setattr(sys, "path", [one for one in sys.path if one not in ("", os.getcwd())])
    monkeypatch.chdir(tmp_path)
    usage.import_packages(["parts_of_mine"])
    assert sys.modules.pop("parts_of_mine")


@pytest.fixture(scope="module")
def ours(tmp_path_factory):
    """Flags that play an agent of an environment of ours for three steps."""
    folder = tmp_path_factory.mktemp("ours")
    trained(folder, "--eval-freq", "-1", env="Goal_Point_2Hazards-v0")
    return [*TOY[:2], "--env", "Goal_Point_2Hazards", "-f", str(folder), "-n", "3"]


def test_our_environment_has_a_window(ours, monkeypatch):
    frames = []
    monkeypatch.setattr("sb3_guard.envs.GuardEnv.render", lambda self: frames.append(self))
    monkeypatch.setenv("DISPLAY", ":0")
    assert enjoy.main(ours) == 0
    assert len(frames) >= 3 and {env.render_mode for env in frames} == {"human"}


# list and show


def rows(text: str) -> list[list[str]]:
    """The cells of the tables in what a command printed."""
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_list_prints_what_there_is(capsys):
    assert cli.main(["list"]) == 0
    cells = rows(capsys.readouterr().out)
    names = [row[0] for row in cells]
    assert (
        sum(row.count(f"{row[0]}_8Hazards") + row.count(f"{row[0]}_8Ghosts") for row in cells) == 72
    )
    for kind, known in (("robot", ROBOTS), ("task", TASKS), ("constraint", CONSTRAINTS)):
        first = names.index(kind) + 1
        assert names[first : first + len(known)] == list(known)
    assert ["Ant", "8", "planar", "0.2"] in [row[:4] for row in cells]
    assert cli.main(["list", "robots"]) == 0
    assert [row[0] for row in rows(capsys.readouterr().out)] == ["robot", *ROBOTS]


@pytest.mark.parametrize("name, version", [("SafetyHopperVelocity", 1), ("CostPoint", 0)])
def test_a_run_is_of_the_latest_version_where_none_is_given(tmp_path, name, version):
    for number in (0, 1):
        (tmp_path / "cpo" / f"{name}-v{number}_1" / f"{name}-v{number}").mkdir(parents=True)
        (tmp_path / "cpo" / f"{name}-v{number}_1" / f"{name}-v{number}" / "args.yml").touch()
    assert playback.find_run(tmp_path, "cpo", name).path.name == f"{name}-v{version}_1"


def test_the_only_algorithm_that_has_runs_is_taken_and_several_are_listed(tmp_path):
    def runs(algo):
        (tmp_path / algo / "CostPoint-v0_2" / "CostPoint-v0").mkdir(parents=True)
        (tmp_path / algo / "CostPoint-v0_2" / "CostPoint-v0" / "args.yml").touch()
        return playback.only_algorithm(str(tmp_path), "CostPoint", "cpo")

    assert playback.only_algorithm(str(tmp_path), "CostPoint", "cpo") == "cpo"
    assert runs("pcpo") == "pcpo"
    with pytest.raises(usage.UsageError, match="runs of CostPoint by pcpo, sac_lag: add --algo"):
        runs("sac_lag")


def test_an_environment_without_a_time_limit_is_warned_about_before_training(recwarn):
    for given, warned in ({}, True), ({"max_episode_steps": 5}, False):
        recwarn.clear()
        make_model("cpo", CostPoint, cost_limit=1.0, n_envs=2, n_steps=10, env_kwargs=given)
        said = [str(each.message) for each in recwarn]
        assert any(each.startswith("cost_envs.CostPoint states no") for each in said) == warned


class Rewarding(CostPoint):
    """Rewards the length of the action."""

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, float(np.linalg.norm(action)), *rest


@pytest.mark.parametrize("low, standing", [(-1.0, 0.0), (0.6, 5 * 0.6 * 2**0.5)])
def test_an_agent_that_does_no_better_than_standing_still_is_told(low, standing, capsys):
    def make():
        env = Rewarding(episode_length=5)
        env.action_space = spaces.Box(low, 1.0, (2,), np.float32)
        return env

    env = CostMonitor(DummyVecEnv([make, make]))
    assert standing_return(env) == pytest.approx(standing)
    run = Run(RunFlags.of({"seed": 0}))
    for better in (0.1, 0.0):
        certificate = SimpleNamespace(mean_return=standing + better)
        run._beside_standing(certificate, env)
        said = f"no better than standing still, of return {standing:.4g} in one episode"
        assert (said in capsys.readouterr().out) == (not better)
    env.action_space = spaces.Discrete(2)
    assert standing_return(env) is None


def test_show_prints_an_environment_and_draws_it(tmp_path, monkeypatch, capsys):
    require_rendering()
    monkeypatch.chdir(tmp_path)
    assert cli.main(["show", "Goal_Ant_8Ghosts"]) == 0
    text = capsys.readouterr().out
    scenario = yaml.safe_load(text.partition("\n\n")[0])
    ghosts = {"ghosts": {"num": 8}}
    assert scenario == {"robot": "Ant", "task": "Goal", "constraints": ghosts, "cost": "sum"}
    cells = rows(text)
    assert ["accelerometer", "0:3", "[-inf, inf]", "m/s²"] in cells
    costs = text.split("\n\n")[1].splitlines()
    assert costs[0].startswith("info['cost_ghosts']: Zones that follow the robot")
    assert costs[1].startswith("    Cost: 1.0 · Σ max(0, size − distance), m, over the ghosts")
    assert costs[2:] == [
        "Usual cost limit of an episode: 2.", "An episode has 1000 steps of 0.2 s."
    ]  # fmt: skip
    assert ["ghosts_lidar", "3:19", "[0, 1]", "closeness"] in cells
    assert cells[cells.index(["action", "actuator", "range", "control"]) - 1][1].endswith(":62")
    assert [row[1] for row in cells[-8:]] == [
        f"{j}_{i}" for i in (1, 2, 3, 4) for j in ("hip", "ankle")
    ]
    took = r"A million steps take \d+\.\d min on this machine, without learning\."
    assert re.search(took + "\nwrote Goal_Ant_8Ghosts.png\n$", text)
    frame = image.imread(tmp_path / "Goal_Ant_8Ghosts.png")[..., :3]
    red, green, blue = np.moveaxis(frame, -1, 0)
    assert ((red - green > 0.25) & (blue > green)).sum() > 1000  # ghosts
    assert ((green - red > 0.25) & (green > blue)).sum() > 1000  # the goal


def test_show_knows_what_users_registered(tmp_path, request, capsys):
    require_rendering()
    request.addfinalizer(lambda: gymnasium.registry.pop("TwoPits-v0", None))
    register("TwoPits-v0", Scenario(constraints={"pits": {"type": "hazards", "num": 2}}))
    assert cli.main(["show", "TwoPits-v0", "-o", str(tmp_path / "pits.png")]) == 0
    out = capsys.readouterr().out
    assert "pits_lidar" in out and "\nNo cost limit is usual here: choose cost_limit.\n" in out
    words = ["show", "-o", str(tmp_path / "x.png"), "--gym-packages", "registered_envs"]
    assert cli.main([*words, "TwoPits-v0"]) == 0
    capsys.readouterr()
    assert cli.main(words) == 2
    assert capsys.readouterr().err.startswith("error: name an environment: sb3-guard show Goal_A")
    assert cli.main(["show", "CartPole-v1"]) == 2
    assert "'CartPole-v1' is not an environment of sb3_guard's" in capsys.readouterr().err
    assert cli.main(["show", "goal_ant_8ghosts"]) == 2
    assert "did you mean 'Ant'?" in capsys.readouterr().err


# help and the dispatcher


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_shows_an_example(command, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main([command, "--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    examples = text[text.index("examples:") :]
    assert f"sb3_guard.{command} " in examples or f"sb3-guard {command}" in examples


def test_help_is_quick_and_loads_nothing_heavy():
    script = (
        "import sys\n"
        "from sb3_guard import enjoy, train\n"
        "try:\n"
        "    train.main(['--help'])\n"
        "except SystemExit as end:\n"
        "    assert end.code == 0\n"
        "import time\n"
        "print(sorted({'torch', 'rl_zoo3', 'stable_baselines3'} & sys.modules.keys()))\n"
        "print(time.process_time())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=300
    )
    *text, heavy, seconds = done.stdout.splitlines()
    assert heavy == "[]" and "--env" in "\n".join(text)
    assert float(seconds) < 5  # of the processor, whatever else runs; usually 0.5


def test_dispatcher(capsys, tmp_path):
    assert cli.main([]) == cli.main(["--help"]) == 0
    assert "train" in capsys.readouterr().out
    assert cli.main(["--version"]) == 0
    assert cli.main(["trian"]) == 2
    assert "unknown command 'trian'; did you mean 'train'?" in capsys.readouterr().err
    assert cli.main(["enjoy", "-f", str(tmp_path), "--no-render"]) == 2
    assert "there is no run of cpo on Goal_Point_8Hazards-v0" in capsys.readouterr().err


def test_early_termination_is_for_training_alone(tmp_path):
    """With it, no episode costs much more than its budget, whatever the agent does."""
    early = "{'sb3_guard.common.vec_budgets.EarlyTermination': {'budget': 0.2}}"
    wrapped = f"env_wrapper:{early}", "normalize:True"
    run = trained(tmp_path, "-n", "480", "-params", *wrapped)
    episodes = load_results(str(run))
    assert (episodes["l"] < 20).any()
    result = json.loads((run / "result.json").read_text())
    assert [*result["final"]] == ["stochastic", "greedy"]
    for split in result["final"].values():
        assert {*split["lengths"]} == {20}
    evaluations = np.load(run / "evaluations.npz")
    assert (evaluations["ep_lengths"] == 20).all()
    # That cut episodes cost little says nothing of the limit.
    assert result["cut"] and "verdict" not in result["costs"]["cost"]


@pytest.mark.parametrize("evaluation", [False, True])
def test_an_overspent_budget_changes_the_rewards_of_the_training_alone(evaluation):
    arguments = {"budget": 0.01, "unsafe_reward": -100.0}
    wrapper = {"sb3_guard.common.vec_budgets.VecRemainingBudget": arguments}
    setup = {"cost_limit": 1.0, "vec_env_wrapper": wrapper}
    here = {"gym_packages": ["registered_envs"], "env_kwargs": {"hazard": (-1.0, 0.0)}}
    run = Run.check(RunFlags(algo="cpo", env="CostPoint-v0", seed=0, hyperparams=setup, **here))
    env = run.make_envs(4, seed=0, evaluation=evaluation)
    env.reset()
    rewards = [env.step(np.zeros((4, *env.action_space.shape)))[1] for _ in range(10)]
    assert (np.min(rewards) == -100.0) == (not evaluation)
    env.close()

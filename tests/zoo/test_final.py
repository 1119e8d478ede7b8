"""What a finished run says of itself: the final policy's episodes, its command, its curve."""

import hashlib
import shlex
from pathlib import Path

import numpy as np
import pytest

from sb3_guard import evaluate_policy, train
from sb3_guard.zoo.agents.flags import EnjoyFlags
from sb3_guard.zoo.agents.playback import open_agent
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder
from sb3_guard.zoo.run.make_envs import evaluation_seed

TOY = (
    "--gym-packages registered_envs --env CostPoint-v0 --env-kwargs episode_length:20 --seed 3 "
    "--eval-freq -1 --verbose 0 --device cpu "
    "-params n_envs:2 n_steps:100 n_critic_updates:3 cost_limit:2 normalize:True"
).split()


def trained(folder: Path, *more: str) -> RunFolder:
    assert train.main([*TOY, "-f", str(folder), *more]) == 0
    return RunFolder(max(folder.glob("*/*_*"), key=lambda path: int(path.name.rpartition("_")[2])))


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> RunFolder:
    """Forty training episodes: an eighth of them is played in the end."""
    return trained(tmp_path_factory.mktemp("logs"), "-n", "800")


def test_the_final_policy_is_played_in_both_ways(run):
    final = run.checked_result()["final"]
    assert [*final] == ["stochastic", "greedy"]
    for name, played in final.items():
        agent = open_agent(
            EnjoyFlags(
                algo="cpo", env="CostPoint-v0", folder=str(run.path.parent.parent),
                gym_packages=["registered_envs"], num_threads=1,
            ),
            None,
        )  # fmt: skip
        seed = evaluation_seed(3, 1)
        again = evaluate_policy(agent.model, agent.env, 5, name == "greedy", seed=seed)
        agent.env.close()
        np.testing.assert_allclose(played["returns"], again.returns, rtol=1e-5)
        np.testing.assert_allclose(played["costs"], again.costs, rtol=1e-5)
        assert played["lengths"] == again.lengths.tolist() == [20] * 5
        assert "bounded" not in played
    assert final["stochastic"]["returns"] != final["greedy"]["returns"]


def test_what_limits_bound_is_kept_where_it_is_not_the_cost(tmp_path):
    worst = trained(tmp_path, "--algo", "scpo", "-n", "100").checked_result()["final"]["greedy"]
    (highest,) = worst["bounded"].values()
    assert 0 < max(highest) < max(worst["costs"])


def test_a_short_training_is_not_followed_by_a_long_play(tmp_path):
    assert trained(tmp_path, "-n", "100").checked_result()["final"]
    short = trained(tmp_path / "short", "-n", "100", "-params", "n_steps:70")
    assert short.checked_result()["final"] == {}


def test_a_result_says_how_to_train_it_again(run):
    words = shlex.split(run.checked_result()["command"])
    again = RunFlags.parse(words[2:])
    of = run.flags()
    assert words[:2] == ["sb3-guard", "train"]
    assert {name for name in of.names() if getattr(of, name) != getattr(again, name)} == {
        "log_folder", "verbose",
    }  # fmt: skip


def test_equal_curves_have_equal_hashes(run, tmp_path):
    text = ""
    step = 0
    for line in run.monitor.read_text().splitlines()[2:]:
        episode_return, length, _, cost = line.split(",")
        step += int(length)
        text += f"{step},{episode_return},{cost}\n"
    curve = run.checked_result()["curve"]
    assert curve == hashlib.sha256(text.encode()).hexdigest()
    assert trained(tmp_path, "-n", "800").checked_result()["curve"] == curve
    assert trained(tmp_path, "-n", "100", "--seed", "4").checked_result()["curve"] != curve

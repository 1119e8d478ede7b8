"""Datasets of played episodes: read by Minari's own loader, compared with what was played."""

import json
import os
import re
import signal

import gymnasium as gym
import numpy as np
import pytest
from full_disk import files_end_at
from gymnasium import spaces
from killed import SMALL, TOY
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_guard import enjoy, evaluate_policy, load_pretrained, train
from sb3_guard.common.monitor import CostMonitor
from sb3_guard.zoo.agents import dataset as dataset_module
from sb3_guard.zoo.agents.dataset import DSRLFile, MinariDataset, Recorder

minari = pytest.importorskip("minari")
h5py = pytest.importorskip("h5py")

PLAY = "--pretrained --env Goal_Point_8Hazards --algo trpo_usl --verbose 0 --device cpu".split()
ROWS, SEED = 50, 7
# 50 rows play 53 episodes: the last three rows play two each.
HAZARDS = {"num": 4, "size": 0.5}
SHORT = [
    *"--n-episodes 53 --seed 7 --env-kwargs max_episode_steps:60".split(),
    f"hazards:{HAZARDS}",
]
KEYS = ("cost", "depth")


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def test_minari_plays_every_episode_again(capsys):
    """In the environment that Minari recovers, the actions lead to the same steps, bit for bit."""
    assert enjoy.main([*PLAY, *SHORT, "--verbose", "1", "--dataset", "point/usl-v0"]) == 0
    lines = re.findall(r"^  return +(\S+) +cost +(\S+) +60 steps$", capsys.readouterr().out, re.M)
    returns, costs = np.array(lines, np.float64).T
    dataset = minari.load_dataset("point/usl-v0")
    episodes = list(dataset.iterate_episodes())
    assert (dataset.total_episodes, dataset.total_steps) == (53, 53 * 60)

    got = [(episode.rewards.sum(), episode.infos["cost"].sum()) for episode in episodes]
    np.testing.assert_allclose(got, np.stack([returns, costs], axis=1), atol=1e-3)
    assert np.any(costs)

    env = dataset.recover_environment()
    assert env.spec.kwargs["hazards"] == HAZARDS and env.spec.max_episode_steps == 60
    model = load_pretrained("Goal_Point_8Hazards", "trpo_usl", device="cpu")
    for i, episode in enumerate(episodes):
        obs, _ = env.reset(seed=SEED + i)
        for t, action in enumerate(episode.actions):
            np.testing.assert_array_equal(episode.observations[t], obs)
            obs, reward, terminated, truncated, info = env.step(action)
            assert np.float32(reward) == episode.rewards[t]
            assert info["cost"] == episode.infos["cost"][t + 1]
            assert terminated == episode.terminations[t]
            assert truncated == episode.truncations[t] == (t == 59)
        np.testing.assert_array_equal(episode.observations[-1], obs)
        assert episode.infos["cost"][0] == 0.0
    acted, _ = model.predict(episodes[0].observations[:1], deterministic=True)
    np.testing.assert_allclose(acted, episodes[0].actions[:1], atol=1e-5)


def test_so_it_does_those_of_other_environments(tmp_path):
    """Alone, in their wrappers; observations are those that nothing has normalised."""
    words = [*TOY, "--env-kwargs", "episode_length:25", "-f", str(tmp_path)]
    normed = ["-params", "normalize:True", "env_wrapper:gymnasium.wrappers.NormalizeReward"]
    assert train.main([*words, *SMALL, *normed, "--eval-freq", "-1", "-n", "60"]) == 0
    play = [*words, "--verbose", "0", "--n-episodes", "3", "--seed", "7", "--dataset"]
    assert enjoy.main([*play, "toy-v0"]) == 0
    dataset = minari.load_dataset("toy-v0")
    env = dataset.recover_environment()
    assert [wrapper.name for wrapper in env.spec.additional_wrappers] == ["NormalizeReward"]
    for i, episode in enumerate(dataset.iterate_episodes()):
        obs, _ = env.reset(seed=7 + i)
        for t, action in enumerate(episode.actions):
            np.testing.assert_array_equal(episode.observations[t], obs)
            obs, _, _, truncated, info = env.step(action)
            assert info["cost"] == episode.infos["cost"][t + 1]
        assert truncated and t == 24


def test_without_the_environment_where_nobody_can_make_it(tmp_path):
    gym.register("Own-v0", entry_point=lambda: Random(0, [], False))
    try:
        venv = DummyVecEnv([lambda: gym.make("Own-v0")])
        kept = MinariDataset("own-v0", venv, {})
    finally:
        del gym.registry["Own-v0"]
    evaluate_policy(
        Sampling(venv.action_space), CostMonitor(Recorder(venv, 2, KEYS, kept.write, [])), 2
    )
    assert minari.load_dataset("own-v0").total_episodes == 2


def test_the_metadata_says_whose_episodes_these_are():
    assert enjoy.main([*PLAY, "--env-kwargs", "max_episode_steps:5", "--n-episodes", "2",
                       "--dataset", "usl-v3"]) == 0  # fmt: skip
    about = minari.load_dataset("usl-v3").storage.metadata
    assert about["algorithm_name"] == "trpo_usl"
    assert about["cost_limits"] == {"cost": 2.0}
    assert about["certificate"] is None  # which is of episodes of 1,000 steps
    assert about["actions"] == "most likely"
    command = about["command"].split()
    assert command[:2] == ["sb3-guard", "enjoy"]
    flags = enjoy.Flags.parse(command[2:])
    assert (flags.n_episodes, flags.dataset) == (2, "usl-v3")


def test_a_file_has_dsrls_keys_shapes_and_types(tmp_path):
    assert enjoy.main([*PLAY, *SHORT, "--dataset", str(tmp_path / "new" / "usl.hdf5")]) == 0
    assert enjoy.main([*PLAY, *SHORT, "--dataset", "usl-v0"]) == 0
    with h5py.File(tmp_path / "new" / "usl.hdf5") as file:
        data = {key: values[:] for key, values in file.items()}
        about = json.loads(file.attrs["metadata"])
    n, space = 53 * 60, load_pretrained("Goal_Point_8Hazards").observation_space
    shapes = {
        "observations": (n, *space.shape), "next_observations": (n, *space.shape),
        "actions": (n, 2), "rewards": (n,), "costs": (n,), "terminals": (n,), "timeouts": (n,),
    }  # fmt: skip
    assert {key: values.shape for key, values in data.items()} == shapes
    kinds = {key: values.dtype for key, values in data.items()}
    assert {kinds.pop(key) for key in ("terminals", "timeouts")} == {np.dtype(bool)}
    assert set(kinds.values()) == {np.dtype(np.float32)}
    assert about["algorithm_name"] == "trpo_usl"
    # DSRL ends an episode where one of the two is true.
    ends = np.flatnonzero(data["terminals"] | data["timeouts"])
    np.testing.assert_array_equal(ends, np.arange(59, n, 60))
    for end, episode in zip(ends, minari.load_dataset("usl-v0"), strict=True):
        steps = slice(end - 59, end + 1)
        np.testing.assert_array_equal(data["observations"][steps], episode.observations[:-1])
        np.testing.assert_array_equal(data["next_observations"][steps], episode.observations[1:])
        np.testing.assert_array_equal(data["actions"][steps], episode.actions)
        np.testing.assert_array_equal(data["costs"][steps], np.float32(episode.infos["cost"][1:]))


class Random(gym.Env):
    """Episodes of random length that end in either way; what it saw and gave is in ``log``."""

    # (row, seeded, steps): steps are (obs, action, reward, terminated, cost, depth, next_obs)
    log: list

    def __init__(self, row, log, several):
        self.row, self.log = row, log
        box = spaces.Box(-np.inf, np.inf, (3,), np.float64)
        image = spaces.Box(0, 255, (32, 32, 3), np.uint8)
        self.observation_space = spaces.Dict({"box": box, "image": image}) if several else box
        self.action_space = spaces.Discrete(4) if several else spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        self.steps, self.length = [], int(self.np_random.integers(1, 8))
        self.seeded = seed is not None
        self.obs = self.observation_space.sample()
        return self.obs, {}

    def step(self, action):
        before, self.obs = self.obs, self.observation_space.sample()
        reward, cost, depth = (float(x) for x in self.np_random.normal(size=3))
        over = len(self.steps) + 1 == self.length
        terminated = over and bool(self.np_random.integers(2))
        info = {"cost": cost} | ({"depth": depth} if len(self.steps) % 2 else {})
        kept = info.get("depth", 0.0)
        self.steps.append((before, action, reward, terminated, cost, kept, self.obs))
        if over:
            self.log.append((self.row, self.seeded, self.steps))
        return self.obs, reward, terminated, over and not terminated, info


class Sampling:
    """An agent that acts at random, whatever it sees."""

    def __init__(self, space):
        self.space = space

    def predict(self, obs, state=None, episode_start=None, deterministic=False):
        return np.stack([self.space.sample() for _ in episode_start]), None


def leaves(obs):
    return obs if isinstance(obs, dict) else {"": obs}


def play(log, write, several, stop=()):
    rows = [lambda row=row: Random(row, log, several) for row in range(4)]
    venv = Recorder(DummyVecEnv(rows), 21, KEYS, write, list(stop))
    venv.action_space.seed(0)
    evaluate_policy(Sampling(venv.action_space), CostMonitor(venv), 21, seed=3, cost_keys=KEYS)
    return venv


@pytest.mark.parametrize("several", [False, True], ids=["flat", "dictionary"])
def test_rows_that_end_at_different_steps(several):
    log, sizes = [], []
    venv = DummyVecEnv([lambda: Random(0, [], several)])
    kept = MinariDataset("rows-v0", venv, {"algorithm_name": "random"})
    play(log, lambda episodes: (sizes.append(len(episodes)), kept.write(episodes)), several)
    assert sum(sizes) == 21 and 1 < max(sizes) <= 4  # written as they end
    # A row that has played its episode plays others, unseeded, until all have: they don't count.
    begun = [(row, steps) for row, seeded, steps in log if seeded]
    counted = [steps for _, steps in begun[:20]] + [steps for row, steps in begun[20:] if row == 0]
    assert len(log) > 21
    dataset = minari.load_dataset("rows-v0")
    assert dataset.observation_space == venv.observation_space
    for steps, episode in zip(counted, dataset.iterate_episodes(), strict=True):
        before, actions, rewards, terminated, costs, depths, after = zip(*steps, strict=True)
        for key, values in leaves(episode.observations).items():
            want = [leaves(obs)[key] for obs in (*before, after[-1])]
            np.testing.assert_array_equal(values, np.stack(want))
            assert values.dtype == want[0].dtype
        np.testing.assert_array_equal(episode.actions, actions)
        np.testing.assert_array_equal(episode.rewards, np.float32(rewards))
        np.testing.assert_array_equal(episode.terminations, terminated)
        np.testing.assert_array_equal(
            episode.truncations, [*[False] * (len(steps) - 1), not terminated[-1]]
        )
        np.testing.assert_array_equal(episode.infos["cost"], [0.0, *costs])
        if len(steps) > 1:  # a cost that no step of an episode reported is not in it
            np.testing.assert_array_equal(episode.infos["depth"], [0.0, *depths])
        else:
            assert episode.infos.keys() == {"cost"}


@pytest.mark.parametrize("kind", [MinariDataset, DSRLFile])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_leaves_whole_episodes(kind, number, tmp_path, monkeypatch, capsys):
    """Even if it comes while they are written: the second write is then the last one."""
    whole, chunks = kind.write, []

    def write(self, episodes):
        chunks.append(len(episodes))
        if len(chunks) == 2:
            os.kill(os.getpid(), number)
        whole(self, episodes)

    monkeypatch.setattr(kind, "write", write)
    name = "cut-v0" if kind is MinariDataset else str(tmp_path / "cut.hdf5")
    steps = "--n-episodes 200 --env-kwargs max_episode_steps:5 --verbose 1 --dataset".split()
    assert enjoy.main([*PLAY[:-4], *steps, name]) == 130
    assert chunks == [50, 50]
    assert "Dataset: 100 episodes in " in capsys.readouterr().out
    assert whole_episodes(name) == 100


def whole_episodes(name):
    """How many episodes of five steps a dataset has, and nothing else."""
    if not name.endswith(".hdf5"):
        lengths = [len(episode) for episode in minari.load_dataset(name).iterate_episodes()]
        assert {*lengths} == {5}
        return len(lengths)
    with h5py.File(name) as file:
        ends = np.flatnonzero(file["timeouts"])
        assert all(len(values) == 5 * len(ends) for values in file.values())
        np.testing.assert_array_equal(ends, np.arange(4, 5 * len(ends), 5))
        assert np.abs(file["observations"][:]).sum(axis=1).all()
        return len(ends)


@pytest.mark.parametrize("name", ["full-v0", "full.hdf5"])
def test_a_full_disk_leaves_whole_episodes(name, tmp_path, capsys):
    """They are those that the message counts."""
    name = str(tmp_path / name) if name.endswith(".hdf5") else name
    steps = "--n-episodes 200 --env-kwargs max_episode_steps:5 --dataset".split()
    with files_end_at(500_000 if name.endswith(".hdf5") else 4_000_000):
        assert enjoy.main([*PLAY, *steps, name]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: can't write --dataset {name}: ") and error.count("\n") == 1
    assert whole_episodes(name) == int(re.search("; it has ([0-9]+) whole episodes$", error)[1])


@pytest.mark.parametrize("name", ["none-v0", "none.hdf5"])
def test_a_disk_that_is_full_before_leaves_nothing(name, tmp_path, capsys):
    place = tmp_path / name
    steps = "--n-episodes 2 --env-kwargs max_episode_steps:5 --dataset".split()
    with files_end_at(1000):
        assert enjoy.main([*PLAY, *steps, str(place) if place.suffix else name]) == 2
    assert capsys.readouterr().err.endswith("File too large; it has no whole episodes\n")
    assert not place.exists() and not [*tmp_path.glob("minari/**/*.hdf5")]


def test_nothing_is_left_if_no_episode_ends(tmp_path, capsys):
    steps = "--verbose 1 -n 10 --dataset".split()
    for name in ("none-v0", str(tmp_path / "none.hdf5")):
        assert enjoy.main([*PLAY[:-4], *steps, name]) == 0
        assert "Dataset: no episode ended" in capsys.readouterr().out
    assert "none-v0" not in minari.list_local_datasets() and not list(tmp_path.glob("*.hdf5"))


def test_names_that_can_not_be_written(tmp_path, capsys, monkeypatch):
    def refused(name, *parts):
        assert enjoy.main([*PLAY, "-n", "5", "--dataset", name]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and all(part in error for part in parts), error

    (tmp_path / "there.hdf5").touch()
    (tmp_path / "minari" / "there-v0").mkdir(parents=True)
    refused("there", "'there'", "point/cpo-v0", "cpo.hdf5")
    refused("there-v0", "exists; remove the folder", str(tmp_path / "minari" / "there-v0"))
    refused(str(tmp_path / "there.hdf5"), "exists; remove it, or")
    monkeypatch.setattr(
        dataset_module.importlib.util, "find_spec", lambda name: None if name == "minari" else name
    )
    refused("new-v0", "--dataset needs minari: pip install 'sb3-guard[datasets]'")


def test_dsrls_layout_is_for_arrays(tmp_path):
    venv = DummyVecEnv([lambda: Random(0, [], True)])
    with pytest.raises(Exception, match="has no Dict observations"):
        DSRLFile(str(tmp_path / "new.hdf5"), venv, {})

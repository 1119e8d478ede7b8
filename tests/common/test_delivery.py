"""A training ends with a certified agent, or says how far the nearest is away."""

import re
import shutil
from contextlib import ExitStack

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from full_disk import files_end_at
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_guard import CPO, TD3Lag, evaluate_policy, make_vec_env
from sb3_guard.common.certificate import Certificate, agent_hash, certify
from sb3_guard.common.delivery import DeliveryCallback


class Dose(gym.Env):
    """One step: the action in [0, 1] is the reward and, times a random number, the cost."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Box(0, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample() * 0 + np.float32(0.5), {}

    def step(self, action):
        dose = float(action[0])
        cost = dose * self.np_random.exponential(2.0)
        return np.full(2, 0.5, np.float32), dose, True, False, {"cost": cost}


def envs(normalize=True):
    env = make_vec_env(Dose, n_envs=10, vec_env="dummy")
    return VecNormalize(env, norm_reward=False) if normalize else env


def trained(folder, limit, seed=0, eval_env=None, done=0, **kwargs):
    model = CPO("MlpPolicy", envs(), n_steps=10, cost_limit=1.0, seed=seed, device="cpu", **kwargs)
    model.n_critic_updates = 5
    if eval_env is None:
        eval_env = envs()
        eval_env.training = False
    deliver = DeliveryCallback(eval_env, folder, limit, candidates=3, screening=20, verbose=1)
    model.num_timesteps = done
    model.learn(600 - done, callback=deliver, reset_num_timesteps=not done)
    return model, deliver


def kept(folder):
    files = sorted((folder / "candidates").glob("*.pt"))
    return [th.load(file, weights_only=True) for file in files]


@pytest.fixture(scope="module")
def delivered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, *trained(folder, 1.6)


def test_the_first_candidate_that_is_certified_is_delivered(delivered):
    folder, model, deliver = delivered
    certificate = Certificate.from_json((folder / "certificate.json").read_text())
    assert certificate == deliver.certificate and certificate.verdict == "certified"
    assert certificate.tries == 3 and certificate.costs["cost"].limit == 1.6
    # The file is the agent of the certificate, and its play is within the limit.
    env = VecNormalize.load(str(folder / "certified_model_vecnormalize.pkl"), envs(normalize=False))
    env.training = False
    agent = CPO.load(folder / "certified_model.zip", env=env)
    assert agent_hash(agent, env) == certificate.agent
    assert certify(agent, env, 1.6, seed=99).verdict == "certified"
    # The model is as training left it.
    last, weights = kept(folder)[-1]["policy"], model.policy.state_dict()
    assert all(th.equal(value, weights[name]) for name, value in last.items())


def test_candidates_are_of_the_last_half_in_equal_parts(delivered):
    assert [candidate["num_timesteps"] for candidate in kept(delivered[0])] == [300, 500, 600]


def test_nothing_is_delivered_where_nothing_keeps_the_limit(tmp_path, capsys, monkeypatch):
    tried = []

    def spied(*args, **kwargs):
        tried.append(certify(*args, **kwargs))
        return tried[-1]

    monkeypatch.setattr("sb3_guard.common.delivery.certify", spied)
    _, deliver = trained(tmp_path, 0.01)
    assert deliver.certificate is None
    assert [path.name for path in tmp_path.iterdir()] == ["candidates"]
    said = capsys.readouterr().out
    assert "Nothing is delivered. The nearest candidate: exceeded: " in said
    assert re.search(r"\(\d+ s of a processor\)", said)
    # Each try has fresh episodes.
    assert len({certificate.seed for certificate in tried}) == len(tried) == 3


def test_a_training_that_continues_keeps_the_candidates_that_it_has(delivered, tmp_path):
    """Not those of a shorter training, nor those that it has not come to again."""
    first, _, last = kept(delivered[0])
    (tmp_path / "candidates").mkdir()
    for number, candidate, steps in ((0, last, 300), (1, last, 550), (2, first, 200)):
        there = {**candidate, "num_timesteps": steps}
        th.save(there, tmp_path / "candidates" / f"{number:03d}.pt")
    trained(tmp_path, 1.6, done=400)
    after = kept(tmp_path)
    assert [candidate["num_timesteps"] for candidate in after] == [300, 500, 600]

    def same(one, other):
        return all(th.equal(value, other["policy"][name]) for name, value in one["policy"].items())

    assert same(after[0], last) and not same(after[1], last) and not same(after[2], first)


def test_another_training_in_the_folder_has_nothing_of_the_first(delivered, tmp_path, capsys):
    shutil.copytree(delivered[0], tmp_path, dirs_exist_ok=True)
    _, deliver = trained(tmp_path, -1.0, seed=1, policy_kwargs={"net_arch": [8]})
    assert [candidate["num_timesteps"] for candidate in kept(tmp_path)] == [300, 500, 600]
    assert "Nothing is delivered" in capsys.readouterr().out
    assert deliver.certificate is None and not [*tmp_path.glob("certifi*")]


def test_a_callback_delivers_each_training_and_leaves_the_model_and_its_statistics(tmp_path):
    env = envs()
    model, deliver = trained(tmp_path, 1.6, eval_env=env)  # one of its own keeps them, too
    first = [candidate["policy"] for candidate in kept(tmp_path)]
    model.set_env(env)
    model.learn(600, callback=deliver)
    assert [candidate["num_timesteps"] for candidate in kept(tmp_path)] == [300, 500, 600]
    for before, after in zip(first, kept(tmp_path), strict=True):
        assert any(not th.equal(value, after["policy"][name]) for name, value in before.items())
    last = kept(tmp_path)[-1]
    np.testing.assert_array_equal(env.obs_rms.mean, last["statistics"][""][0])
    weights = model.policy.state_dict()
    assert all(th.equal(value, weights[name]) for name, value in last["policy"].items())


def files_of(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("mine.pt", {"num_timesteps": 10**6}),
        ("mine.pt", {"num_timesteps": 10**6, "policy": {}, "statistics": {}}),
        ("000.pt", {"a": th.zeros(1)}),
        ("002.pt", th.zeros(1)),
        ("002.pt", None),  # an empty file
    ],
)
def test_files_of_others_and_damaged_ones_stay_and_are_no_candidates(tmp_path, name, content):
    folder = tmp_path / "candidates"
    folder.mkdir()
    (folder / name).touch()
    if content is not None:
        th.save(content, folder / name)
    before = files_of(folder)
    _, deliver = trained(tmp_path, 1.6)
    assert files_of(folder).items() >= before.items()
    assert deliver.certificate.verdict == "certified"


def test_a_certificate_of_something_else_is_told_before_the_training(delivered, tmp_path):
    text = delivered[2].certificate.to_json()  # such as sb3-guard certify --json certificate.json
    (tmp_path / "certificate.json").write_text(text)
    with pytest.raises(FileExistsError, match=r"certificate\.json would be replaced"):
        trained(tmp_path, 1.6)
    assert files_of(tmp_path) == {"certificate.json": text.encode()}
    assert [path.name for path in tmp_path.iterdir()] == ["certificate.json"]


def test_an_interrupt_while_an_agent_is_certified_leaves_the_one_before(
    delivered, tmp_path, monkeypatch
):
    shutil.copytree(delivered[0], tmp_path, dirs_exist_ok=True)
    before = files_of(tmp_path)

    def interrupt(*args, **kwargs):
        assert files_of(tmp_path) == before
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_guard.common.delivery.certify", interrupt)
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path, 1.6, seed=1)
    assert files_of(tmp_path) == before
    monkeypatch.undo()
    assert trained(tmp_path, 1.6, seed=1)[1].certificate.verdict == "certified"
    after = files_of(tmp_path)
    assert after.keys() == before.keys() and all(after[name] != before[name] for name in after)


def test_an_agent_that_the_disk_has_no_room_for_leaves_the_one_before(
    delivered, tmp_path, monkeypatch
):
    shutil.copytree(delivered[0], tmp_path, dirs_exist_ok=True)
    before = files_of(tmp_path)
    full = ExitStack()

    def certified(*args, **kwargs):
        full.enter_context(files_end_at(len(before["certified_model.zip"]) // 2))
        return delivered[2].certificate

    monkeypatch.setattr("sb3_guard.common.delivery.certify", certified)
    with full, pytest.raises(OSError, match="too large"):
        trained(tmp_path, 1.6, seed=1)
    assert files_of(tmp_path) == before


class Restless(Dose):
    """An action costs three times the limit if it is the last one again, else nothing."""

    action_space = spaces.Box(-5, 5, (1,), np.float32)
    last = None

    def step(self, action):
        observation, reward, ended, cut, _ = super().step(action)
        again, self.last = self.last == action[0], action[0]
        return observation, reward, ended, cut, {"cost": 3.0 * again}


def restless(algorithm=CPO, env=Restless, **kwargs):
    model = algorithm("MlpPolicy", make_vec_env(env, n_envs=10), cost_limit=1.0, seed=0, **kwargs)
    return model, make_vec_env(env, n_envs=10)


@pytest.mark.parametrize("deterministic", [None, True])
def test_sampled_actions_are_certified_where_the_most_likely_ones_cost_too_much(
    deterministic, tmp_path
):
    model, env = restless(n_steps=10)
    deliver = DeliveryCallback(env, tmp_path, deterministic=deterministic, verbose=0)
    model.learn(200, deliver)
    if deterministic:
        assert deliver.certificate is None
    else:
        assert not deliver.certificate.deterministic and deliver.certificate.tries == 3
        assert deliver.certificate.costs["cost"].mean == 0.0


class Doses(Restless):
    action_space = spaces.Discrete(3)


@pytest.mark.parametrize(
    ("algorithm", "env", "kwargs"),
    [(CPO, Doses, {}), (CPO, Restless, {"use_sde": True}), (TD3Lag, Restless, {})],
)
def test_actions_that_are_sampled_alike_or_not_exported_are_not_tried(
    algorithm, env, kwargs, tmp_path
):
    model, eval_env = restless(algorithm, env, **kwargs)
    deliver = DeliveryCallback(eval_env, tmp_path)
    deliver.init_callback(model)
    assert deliver._kinds() == [True]


@pytest.mark.parametrize(
    ("screened", "tried"),
    [
        # The best return whose mean is 1, 2, 3 errors (of 0.1) below the limit, of either kind
        ({"0": (9, -0.15), "s1": (8, -0.25), "2": (7, -0.35), "s3": (6, -0.9)}, "0 s1 2"),
        ({"s0": (9, -0.15), "s1": (8, -0.15), "2": (7, -0.9)}, "s0 2 s1"),  # then the nearest
        ({}, "5 s5 4"),
    ],
)
def test_three_tries_the_best_first_then_more_cautious(screened, tried, tmp_path, monkeypatch):
    model, env = restless()
    deliver = DeliveryCallback(env, tmp_path)
    deliver.init_callback(model)

    def screen(steps, deterministic, limits):
        name = "s" * (not deterministic) + str(steps)
        above = 2.0 - steps / 10 + 0.01 * (not deterministic)
        mean_return, excess = screened.get(name, (99.0, above))
        return mean_return, np.array([-9.0, excess]), np.array([0.1, 0.1])

    monkeypatch.setattr(deliver, "_screen", screen)
    tries = deliver._tries({steps: steps for steps in range(6)}, np.ones(1))
    assert " ".join("s" * (not most_likely) + str(steps) for steps, most_likely in tries) == tried


class TwoCosts(Dose):
    action_space = spaces.Box(-5, 5, (1,), np.float32)

    def step(self, action):
        observation, reward, ended, cut, info = super().step(action)
        return observation, reward, ended, cut, {"cost": 2.0 - info["cost"], "dose": abs(reward)}


def test_the_screening_of_several_costs(tmp_path, monkeypatch):
    keys = {"cost_keys": ("cost", "dose")}
    env = make_vec_env(TwoCosts, n_envs=5, monitor_kwargs=keys)
    model = CPO("MlpPolicy", env, cost_limit=[1.0, 4.0], seed=0, **keys)
    deliver = DeliveryCallback(env, tmp_path, screening=20)
    deliver.init_callback(model)
    candidate = {"num_timesteps": 7, "policy": model.policy.state_dict(), "statistics": {}}
    for deterministic in True, False:
        th.manual_seed(0)
        played = evaluate_policy(model, env, 20, deterministic, seed=deliver.seed)
        th.manual_seed(0)
        mean_return, excess, error = deliver._screen(candidate, deterministic, np.array([1.0, 4.0]))
        assert mean_return == pytest.approx(played.returns.mean())
        assert excess == pytest.approx(played.limited.mean(axis=0) - [1.0, 4.0])
        assert error == pytest.approx(played.limited.std(axis=0, ddof=1) / 20**0.5)
    # Episodes without an end, or that ended in a physics error: only a first try, for a verdict
    played.limited[3, 1] = np.nan
    monkeypatch.setattr("sb3_guard.common.delivery.evaluate_policy", lambda *args, **kwargs: played)
    assert list(deliver._tries({7: candidate}, np.array([1.0, 4.0]))) == [(7, True)]


class Endless(Dose):
    def step(self, action):
        observation, reward, _, _, info = super().step(action)
        return observation, reward, False, False, info


def test_a_training_whose_agent_never_ends_an_episode_is_kept(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sb3_guard.common.evaluation.LONGEST", 50)
    eval_env = VecNormalize(make_vec_env(Endless, n_envs=10), norm_reward=False)
    with pytest.warns(UserWarning, match="had not ended"):
        model, deliver = trained(tmp_path, 1.6, eval_env=eval_env)
    assert deliver.certificate is None and model.num_timesteps == 600
    assert "Nothing is delivered: 100 of 100 episodes did not end" in capsys.readouterr().out


def test_an_absent_normaliser_is_told_before_the_training(tmp_path):
    with pytest.raises(ValueError, match="VecNormalize"):
        trained(tmp_path, 1.6, eval_env=envs(normalize=False))
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("limit", [np.nan, (1.0, 2.0)])
def test_a_wrong_limit_is_told_before_the_training(limit, tmp_path):
    with pytest.raises(ValueError, match="cost_limit"):
        trained(tmp_path, limit)
    assert not [*tmp_path.iterdir()]


def test_a_folder_that_is_none_is_told_before_the_training(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        trained(tmp_path / "file", 1.0)


def test_other_actions_are_told_before_the_training(tmp_path):
    class Scaled(Dose):
        action_space = spaces.Box(-20.0, 20.0, (1,), np.float32)

    other = VecNormalize(make_vec_env(Scaled, vec_env="dummy"), norm_reward=False, training=False)
    with pytest.raises(ValueError, match=r"the agent's actions are Box\(.* those here Box\(-20.0"):
        trained(tmp_path, 1.0, eval_env=other)
    assert not [*tmp_path.iterdir()]

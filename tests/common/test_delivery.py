"""A training ends with a certified agent, or says how far the nearest is away."""

import re
import shutil
from contextlib import ExitStack
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from full_disk import files_end_at
from gymnasium import spaces
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.vec_env import VecNormalize

from sb3_guard import CPO, TD3Lag, evaluate_policy, make_vec_env
from sb3_guard.common.certificate import Certificate, agent_hash, certify
from sb3_guard.common.delivery import DeliveryCallback, _played
from sb3_guard.judging import Limits


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


def trained(folder, limit, seed=0, eval_env=None, done=0, deliver=(), **kwargs):
    model = CPO("MlpPolicy", envs(), n_steps=10, cost_limit=1.0, seed=seed, device="cpu", **kwargs)
    model.n_critic_updates = 5
    if eval_env is None:
        eval_env = envs()
        eval_env.training = False
    deliver = DeliveryCallback(eval_env, folder, limit, n_eval_episodes=20, **dict(deliver))
    model.num_timesteps = done
    model.learn(600 - done, callback=deliver, reset_num_timesteps=not done)
    return model, deliver


def kept(folder):
    files = sorted((folder / "candidates").glob("*.pt"), key=lambda file: int(file.stem))
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
    alone = CPO("MlpPolicy", envs(), n_steps=10, cost_limit=1.0, seed=0, device="cpu")
    alone.n_critic_updates = 5
    alone.learn(600)
    others = alone.policy.state_dict()
    assert all(th.equal(value, others[name]) for name, value in model.policy.state_dict().items())


STEPS = [300, 360, 420, 480, 540, 600]  # ten evaluations, from the middle of the training on


def test_candidates_are_what_evaluations_of_the_last_half_have_played(delivered):
    folder, _, deliver = delivered
    assert [candidate["num_timesteps"] for candidate in kept(folder)] == STEPS
    assert deliver.evaluations_timesteps == [60, 120, 180, 240, *STEPS]
    for candidate, costs in zip(kept(folder), deliver.evaluations_costs[-6:], strict=True):
        _, seen = candidate["played"][True]
        assert seen[:, 0].tolist() == costs  # each episode is played once
    assert {*deliver.final} == {True, False} and len(deliver.final[True]) == 100


def test_no_more_candidates_are_kept_than_may_be_tried(tmp_path):
    """The best ones by the number that the best model is chosen by."""
    _, deliver = trained(tmp_path, 1.6, deliver={"eval_freq": 2})
    assert len(deliver.evaluations_timesteps) == 30 and len(kept(tmp_path)) == 8
    limits = Limits(np.array([1.6]))
    ranks = [max(one.rank(limits, 1.0) for one in _played(c)) for c in kept(tmp_path)]
    worst = min(returns for safe, returns in ranks if safe)
    for steps, returns, costs in zip(
        deliver.evaluations_timesteps,
        deliver.evaluations_results,
        deliver.evaluations_costs,
        strict=True,
    ):
        if steps >= 300 and (limits.excess(np.array(costs)[:, None]) <= 0.0).all():
            assert np.mean(returns) <= worst or steps in [
                c["num_timesteps"] for c in kept(tmp_path)
            ]


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
    first, *_, last = kept(delivered[0])
    (tmp_path / "candidates").mkdir()
    for candidate, steps in ((last, 300), (last, 550), (first, 460)):
        there = {**candidate, "num_timesteps": steps}
        th.save(there, tmp_path / "candidates" / f"{steps}.pt")
    trained(tmp_path, 1.6, done=400)
    after = kept(tmp_path)
    assert [candidate["num_timesteps"] for candidate in after] == [300, 460, 520, 580]

    def same(one, other):
        return all(th.equal(value, other["policy"][name]) for name, value in one["policy"].items())

    assert same(after[0], last) and not same(after[1], first)


def test_another_training_in_the_folder_has_nothing_of_the_first(delivered, tmp_path, capsys):
    shutil.copytree(delivered[0], tmp_path, dirs_exist_ok=True)
    _, deliver = trained(tmp_path, -1.0, seed=1, policy_kwargs={"net_arch": [8]})
    assert [candidate["num_timesteps"] for candidate in kept(tmp_path)] == STEPS
    assert "Nothing is delivered" in capsys.readouterr().out
    assert deliver.certificate is None and not [*tmp_path.glob("certifi*")]


def test_a_callback_delivers_each_training_and_leaves_the_model_and_its_statistics(tmp_path):
    env = envs()
    model, deliver = trained(tmp_path, 1.6, eval_env=env)  # one of its own keeps them, too
    first = [candidate["policy"] for candidate in kept(tmp_path)]
    weights = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(600, callback=deliver)
    assert [candidate["num_timesteps"] for candidate in kept(tmp_path)] == STEPS
    for before, after in zip(first, kept(tmp_path), strict=True):
        assert any(not th.equal(value, after["policy"][name]) for name, value in before.items())
    np.testing.assert_array_equal(env.obs_rms.mean, model.get_env().obs_rms.mean)
    assert any(not th.equal(value, weights[k]) for k, value in model.policy.state_dict().items())


def files_of(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("mine.pt", {"num_timesteps": 10**6}),
        ("mine.pt", {"num_timesteps": 10**6, "policy": {}, "statistics": {}}),
        ("300.pt", {"a": th.zeros(1)}),
        ("600.pt", th.zeros(1)),
        ("600.pt", None),  # an empty file
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
    assert deliver.kinds() == [True]


@pytest.mark.parametrize(
    ("screened", "tried"),
    [
        # The best return whose mean is 1, 2, 3 errors (of 0.1) below the limit, of either kind
        ({"0": (9, -0.15), "s1": (8, -0.25), "2": (7, -0.35), "s3": (6, -0.9)}, "0 s1 2"),
        ({"s0": (9, -0.15), "s1": (8, -0.15), "2": (7, -0.9)}, "s0 2 s1"),  # then the nearest
        ({}, "5 s5 4"),
    ],
)
def test_three_tries_the_best_first_then_more_cautious(screened, tried):
    """Costs 100 of which 99 are equal: the error is a hundredth of the other's distance."""

    def played(steps, deterministic):
        name = "s" * (not deterministic) + str(steps)
        above = 2.0 - steps / 10 + 0.01 * (not deterministic)
        mean_return, excess = screened.get(name, (99.0, above))
        noise = np.tile([-1.0, 1.0], 50)
        noise *= 1.0 / noise.std(ddof=1)  # a standard error of 0.1
        return mean_return, th.from_numpy(np.stack([np.full(100, -9.0), 1.0 + excess + noise], 1))

    contents = [
        {"num_timesteps": steps, "played": {kind: played(steps, kind) for kind in (True, False)}}
        for steps in range(6)
    ]
    tries = DeliveryCallback._tries(contents, Limits(np.ones(2), ("a", "b")))
    names = ["s" * (not one.deterministic) + str(one.content["num_timesteps"]) for one in tries]
    assert " ".join(names) == tried


def test_episodes_that_did_not_end_or_broke_the_simulation_are_of_no_candidate(tmp_path):
    model, env = restless()
    deliver = DeliveryCallback(env, tmp_path)
    deliver.init_callback(model)
    seen = evaluate_policy(model, env, 20, seed=0)
    assert [*deliver._content({True: seen})["played"]] == [True]
    broken = replace(seen, key_costs=np.where(np.arange(20)[:, None] == 3, np.nan, 0.0))
    unfinished = replace(seen, unfinished=np.zeros((1, 3)))
    assert not deliver._content({True: broken, False: unfinished})["played"]


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
    assert "Nothing is delivered: no candidate's episodes came to an end" in capsys.readouterr().out


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


def test_a_training_that_another_callback_stops_delivers_nothing(tmp_path):
    model = CPO("MlpPolicy", envs(), cost_limit=100.0, n_steps=10, seed=0)
    deliver = DeliveryCallback(envs(), tmp_path, eval_freq=-1, verbose=0)
    stop = ConvertCallback(lambda local, _: local["self"].num_timesteps < 40)
    model.learn(100, callback=[deliver, stop])
    assert not deliver.final and not (tmp_path / "certificate.json").exists()

"""An agent of an algorithm that knows no cost becomes one that keeps a limit."""

import warnings
from typing import Any

import numpy as np
import pytest
import sb3_contrib
import stable_baselines3 as sb3
import torch as th
from cost_envs import CostPoint

from sb3_guard import (
    CPO,
    FOCOPS,
    TRPOUSL,
    PPOLag,
    SACLag,
    TD3Lag,
    evaluate_policy,
    train,
    warm_start,
)
from sb3_guard.zoo.run.checkpoint import read_normalizer

ON: dict[str, Any] = {"n_steps": 40, "policy_kwargs": {"net_arch": [16]}, "seed": 0}
OFF: dict[str, Any] = {"learning_starts": 10, "buffer_size": 100, "batch_size": 8, "seed": 0}
PAIRS = [
    (sb3.PPO, PPOLag, ON | {"batch_size": 20}),
    (sb3.A2C, FOCOPS, ON),
    (sb3_contrib.TRPO, TRPOUSL, ON),
    (sb3.SAC, SACLag, OFF),
    (sb3.TD3, TD3Lag, OFF),
]


@pytest.mark.parametrize(("theirs", "ours", "arguments"), PAIRS)
def test_what_was_learnt_is_taken_over(theirs, ours, arguments, tmp_path, capsys):
    old = theirs("MlpPolicy", CostPoint(10), **arguments).learn(60)
    old.save(tmp_path / "agent")
    env = CostPoint(10, hazard=(-1, 0))
    new = ours("MlpPolicy", env, cost_limit=3.0, **arguments)
    before = th.random.get_rng_state()
    assert warm_start(new, tmp_path / "agent") is new
    assert th.equal(before, th.random.get_rng_state())
    (line,) = capsys.readouterr().out.splitlines()
    assert "new: optimizers" in line and ("cost_critic" in line) == (ours is not TRPOUSL)
    obs = np.zeros((5, 4), np.float32)
    np.testing.assert_array_equal(
        new.predict(obs, deterministic=True)[0], old.predict(obs, deterministic=True)[0]
    )
    weights = new.policy.state_dict()
    for name, values in old.policy.state_dict().items():
        assert th.equal(weights[name], values)
    new.learn(80)
    assert new.cost_limit == 3.0 and new.total_cost > 0


@pytest.mark.parametrize(
    ("theirs", "ours", "kwargs"),
    [
        (sb3.PPO, PPOLag, {"policy_kwargs": {"net_arch": [8]}}),
        (sb3.PPO, SACLag, {}),
        (sb3.TD3, SACLag, {}),
    ],
)
def test_other_networks_are_refused(theirs, ours, kwargs, tmp_path):
    theirs("MlpPolicy", CostPoint(10), **kwargs).save(tmp_path / "agent")
    model = ours("MlpPolicy", CostPoint(10), cost_limit=3.0)
    before = {name: weight.clone() for name, weight in model.policy.state_dict().items()}
    with pytest.raises(ValueError, match=r"agent has .*\[.* policy_kwargs"):
        warm_start(model, tmp_path / "agent")
    assert all(map(th.equal, before.values(), model.policy.state_dict().values()))


def test_an_agent_of_normalised_observations_says_so(tmp_path):
    """Where the environment has no statistics: it would act on something else, and be judged."""
    venv = sb3.common.vec_env.DummyVecEnv([lambda: CostPoint(10)])
    env = sb3.common.vec_env.VecNormalize(venv)
    CPO("MlpPolicy", env, n_steps=40, cost_limit=1.0).learn(40).save(tmp_path / "a")
    normalized = CPO.load(tmp_path / "a", env=env)
    with warnings.catch_warnings(action="error"):
        evaluate_policy(normalized, env, 5)
    model = CPO.load(tmp_path / "a")
    for other in (venv, sb3.common.vec_env.VecNormalize(venv, norm_obs=False)):
        with pytest.warns(UserWarning, match="learnt from normalised .* no VecNormalize"):
            evaluate_policy(model, other, 5)
    with warnings.catch_warnings(action="error"):
        evaluate_policy(model, env, 5)


def test_a_training_that_goes_on_without_its_statistics_says_so(tmp_path):
    def venv() -> sb3.common.vec_env.DummyVecEnv:
        return sb3.common.vec_env.DummyVecEnv([lambda: CostPoint(10)])

    normalize, kwargs = sb3.common.vec_env.VecNormalize, {"n_steps": 40, "cost_limit": 1.0}
    statistics = normalize(venv())
    CPO("MlpPolicy", statistics, **kwargs).learn(40).save(tmp_path / "a")
    statistics.save(str(tmp_path / "s.pkl"))

    def set_env(env: Any) -> CPO:
        model = CPO.load(tmp_path / "a")
        model.set_env(env)
        return model

    begin = [
        lambda env: CPO.load(tmp_path / "a", env=env),
        set_env,
        lambda env: warm_start(CPO("MlpPolicy", env, **kwargs), tmp_path / "a"),
    ]
    for begun in begin:
        with warnings.catch_warnings(action="error"):
            begun(normalize.load(str(tmp_path / "s.pkl"), venv())).learn(40)
        for env in (venv(), normalize(venv()), normalize(venv(), norm_obs=False)):
            with pytest.warns(UserWarning, match=r"normalised .*: wrap it in VecNormalize.load"):
                model = begun(env).learn(40)
            with warnings.catch_warnings(action="error"):
                model.learn(40)


RUN = [
    *"--gym-packages registered_envs --env CostPoint-v0 --env-kwargs episode_length:20".split(),
    *"--algo ppo_lag -n 60 --eval-freq -1 --device cpu".split(),
    *"-params n_envs:2 n_steps:30 batch_size:60 cost_limit:4.0 normalize:True".split(),
]


@pytest.mark.parametrize("beside", ["ppo_vecnormalize.pkl", "run/vecnormalize.pkl", None])
def test_train_goes_on_with_the_statistics_beside_the_agent(tmp_path, capsys, beside):
    env = sb3.common.vec_env.DummyVecEnv([lambda: CostPoint(20)])
    statistics = sb3.common.vec_env.VecNormalize(env)
    statistics.obs_rms.count = 5000.0
    (tmp_path / "run").mkdir()
    if beside:
        statistics.save(str(tmp_path / beside))
    PPOLag("MlpPolicy", statistics, n_steps=30, batch_size=30, cost_limit=1.0).save(
        tmp_path / "ppo"
    )
    run = [*RUN, "-f", str(tmp_path / "logs"), "-i", str(tmp_path / "ppo.zip")]
    assert train.main(run) == 0
    said = "ppo.zip: observation statistics begin anew"
    assert capsys.readouterr().out.count(said) == (beside is None)
    (file,) = (tmp_path / "logs" / "ppo_lag").rglob("vecnormalize.pkl")
    assert (read_normalizer(file).obs_rms.count > 5000) == (beside is not None)
    assert train.main(["-i", str(file.parents[1]), "-n", "120", *run[:2]]) == 0


@pytest.mark.parametrize(("theirs", "algo"), [(sb3.PPO, "ppo_lag"), (PPOLag, "cpo")])
def test_train_refuses_an_agent_of_another_algorithm(tmp_path, capsys, theirs, algo):
    theirs("MlpPolicy", CostPoint(20), n_steps=30, batch_size=30).save(tmp_path / "ppo")
    run = [
        *RUN[:-1],
        "normalize:False",
        "--algo",
        algo,
        "-f",
        str(tmp_path / "logs"),
        "-i",
        str(tmp_path / "ppo.zip"),
    ]
    assert train.main(run) == 2
    said = capsys.readouterr().err
    holds = "cost_critic" if algo == "ppo_lag" else "holds an agent of PPOLag"
    assert holds in said and "warm_start" in said and said.count("\n") < 4
    assert not list((tmp_path / "logs").rglob("result.json"))

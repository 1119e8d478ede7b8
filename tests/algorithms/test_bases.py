"""The bases carry algorithms of anyone's: PPO-Lagrangian as the example has it, SAC with costs."""

import inspect
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from agents import points, state_of
from cost_envs import SB3_POLICY, LinearCostBandit
from ppo_lagrangian import PPOLagrangian
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env

from sb3_guard.algorithms import (
    ALGORITHMS,
    CPO,
    Constrained,
    FirstOrder,
    PPOLag,
    hyperparameter,
    register_algorithm,
)
from sb3_guard.algorithms.common.first_order import mean_kl


def test_without_a_price_it_is_sb3s_ppo_bit_for_bit() -> None:
    """Episodes are cut by a time limit of 30 steps."""
    kwargs: dict[str, Any] = {"n_steps": 32, "batch_size": 64, "seed": 0, "device": "cpu"}
    a = state_of(PPO("MlpPolicy", points(4), **kwargs).learn(256))
    model = PPOLagrangian("MlpPolicy", points(4), cost_limit=1e6, **kwargs).learn(256)
    assert a == state_of(model)
    assert model.total_cost > 0.0 and float(model.multiplier.value[0]) == 0.0
    assert model.logger.name_to_value["train/cost_value_loss"] > 0.0


def test_first_order_with_ppos_loss_is_ppo_bit_for_bit() -> None:
    kwargs: dict[str, Any] = {"n_steps": 32, "batch_size": 48, "seed": 0, "device": "cpu"}
    kwargs |= {"target_kl": None, "clip_range_vf": 0.1, "ent_coef": 0.01, "gae_lambda": 0.9}
    kwargs["policy_kwargs"] = SB3_POLICY
    model = FirstOrder("MlpPolicy", points(4), cost_limit=1.0, **kwargs)
    models = [PPO("MlpPolicy", points(4), **kwargs), model]
    states = []
    for model in models:
        model.set_random_seed(0)
        states.append(state_of(model.learn(256)))
    assert states[0] == states[1]
    theirs, ours = (model.logger.name_to_value for model in models)
    assert {name for name in theirs if name.startswith("train/")} <= ours.keys()
    for name in (
        "value_loss", "approx_kl", "policy_gradient_loss", "explained_variance", "clip_fraction",
        "loss", "clip_range", "clip_range_vf", "entropy_loss", "std",
    ):  # fmt: skip
        assert ours[f"train/{name}"] == pytest.approx(theirs[f"train/{name}"], rel=1e-5), name


def test_passes_stop_by_the_kl_of_the_rollout() -> None:
    """One pass where the first already goes too far, all where none does."""
    for target, passes in ((1e-9, 1), (1e9, 10)):
        kwargs: dict[str, Any] = {"n_steps": 32, "target_kl": target, "cost_limit": 1e6, "seed": 0}
        model = FirstOrder("MlpPolicy", points(4), **kwargs).learn(128)
        assert model._n_updates == passes and 0.0 < mean_kl(model) < 1.0


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_undiscounted_costs_end_with_the_time_limit(gamma: float) -> None:
    """γ V_C of the last observation is added at a time-out where γ < 1, and nothing at γ = 1."""
    model = CPO("MlpPolicy", points(2), n_steps=40, cost_gamma=gamma, n_critic_updates=1, seed=0)
    seen: list[np.ndarray] = []
    model.train = lambda: seen.append(model.rollout_buffer.cost_bootstraps.copy())
    model.learn(80)
    assert np.count_nonzero(seen[0]) == (2 if gamma < 1.0 else 0)
    assert np.count_nonzero(seen[0][29]) == np.count_nonzero(seen[0])


@pytest.mark.slow
def test_with_a_price_it_keeps_a_positive_limit() -> None:
    """A bandit whose best action costs 1.5; under the limit 0.5 the best return is 0.5."""
    env = make_vec_env(LinearCostBandit, 8, seed=0)
    model = PPOLagrangian(
        "MlpPolicy", env, n_steps=64, batch_size=512, n_epochs=4, learning_rate=1e-2,
        cost_limit=0.5, lambda_lr=0.1, seed=0, device="cpu",
    ).learn(20_000)  # fmt: skip
    assert float(model.multiplier.value[0]) > 0.1
    action, _ = model.predict(np.ones((1, 1), np.float32), deterministic=True)
    np.testing.assert_allclose(action[0], LinearCostBandit().optimum(0.5), atol=0.15)
    assert np.mean(model.costs.latest) == pytest.approx(0.5, abs=0.1)


class CostlySAC(Constrained, SAC):
    """SAC whose costs are counted: what stands before a replay buffer."""

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        self._estimate_costs()
        super().train(gradient_steps, batch_size)


def test_costs_of_an_off_policy_algorithm(tmp_path: Path) -> None:
    """Counted, estimated from the episodes that ended, logged, saved; SAC stays what it is."""
    kwargs: dict[str, Any] = {"learning_starts": 60, "seed": 0, "device": "cpu", "batch_size": 16}
    a = state_of_off_policy(SAC("MlpPolicy", points(2), **kwargs).learn(200))
    model = CostlySAC("MlpPolicy", points(2), cost_limit=2.0, **kwargs).learn(200)
    assert a == state_of_off_policy(model)
    assert model.costs.horizon == 30 and len(model.costs.latest) == 6
    assert model.costs.violation[0] == pytest.approx((model.costs.episode_cost[0] - 2.0) / 30)
    latest = np.array(model.costs.latest)[-2:].mean(axis=0)
    np.testing.assert_allclose(latest, model.costs.episode_cost)
    model.save(tmp_path / "model")
    again = CostlySAC.load(tmp_path / "model")
    assert again.total_cost == model.total_cost > 0.0 and again.cost_limit == 2.0
    with pytest.raises(TypeError, match="CostlySAC takes no argument 'bufer_size'; did you mean"):
        CostlySAC("MlpPolicy", points(2), bufer_size=3)


def state_of_off_policy(model: Any) -> list[Any]:
    tensors = [*model.policy.state_dict().values(), th.get_rng_state()]
    return [*(tensor.tolist() for tensor in tensors), random.getstate(), np.random.get_state()[2]]  # noqa: NPY002


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_the_progress_bar_shows_the_mean_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    write = "tqdm.rich.tqdm.set_description"
    monkeypatch.setattr(write, lambda bar, text, refresh: shown.append(text))
    model = CPO("MlpPolicy", points(), n_steps=60, cost_limit=1.0)
    model.learn(240, progress_bar=True)
    assert len(shown) == 2  # rollouts
    assert shown[-1] == f"cost {np.mean(model.costs.latest):.2f}" != "cost 0.00"


def test_policies_begin_calm_unless_told_otherwise(tmp_path: Path) -> None:
    """Key by key: what a user says of the networks leaves the first σ as it is."""
    for cls in (CPO, PPOLag):
        model = cls("MlpPolicy", points(2), n_steps=32, policy_kwargs={"net_arch": [8]})
        assert model.policy_kwargs == {"log_std_init": -0.5, "ortho_init": False, "net_arch": [8]}
        assert (model.policy.log_std == -0.5).all() and not model.policy.ortho_init
        model.save(tmp_path / "model")
        assert cls.load(tmp_path / "model", policy_kwargs={"net_arch": [8]}).policy.net_arch == [8]
        loud = cls("MlpPolicy", points(2), n_steps=32, policy_kwargs={"log_std_init": 0.0})
        assert (loud.policy.log_std == 0.0).all() and not loud.policy.ortho_init


def test_defaults_are_stated_where_only_they_differ() -> None:
    """The signature shows them, a call overrides them, and so does a class further down."""

    class Hasty(PPOLag):
        lambda_lr: float = hyperparameter(0.7)

        def __init__(self, *args: Any, n_steps: int = 32, **kwargs: Any) -> None:
            super().__init__(*args, n_steps=n_steps, **kwargs)

    class Hastier(Hasty):
        lambda_lr: float = hyperparameter(0.9)

    for cls, rate in ((PPOLag, 0.2), (Hasty, 0.7), (Hastier, 0.9)):
        taken = inspect.signature(cls).parameters
        assert taken["lambda_lr"].default == rate and taken["lambda_units"].default == "relative"
        assert list(taken)[:3] == ["policy", "env", "learning_rate"]
        model = cls("MlpPolicy", points(2), batch_size=16)
        assert model.lambda_lr == rate and model.lambda_units == "relative"
        assert model.n_steps == taken["n_steps"].default == (2048 if cls is PPOLag else 32)
        assert cls("MlpPolicy", points(2), batch_size=16, lambda_lr=0.3).lambda_lr == 0.3


# Algorithms from outside the package


def test_what_can_be_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_guard.algorithms.ALGORITHMS", table := dict(ALGORITHMS))
    register_algorithm("ppo_lagrangian", PPOLagrangian)
    register_algorithm("ppo_lagrangian", PPOLagrangian)
    assert table["ppo_lagrangian"].label == "PPOLagrangian"
    mine = type("CPO", (CPO,), {})  # of the same name
    register_algorithm("cpo", CPO)
    for key, value, error, named in (
        ("cpo", mine, ValueError, "'cpo' is CPO already"),
        ("PPO-Lag", PPOLagrangian, ValueError, "'PPO-Lag'"),
        ("cpo", PPOLagrangian, ValueError, "'cpo' is CPO already"),
        ("mine", "PPOLagrangian", TypeError, "'PPOLagrangian'"),
    ):
        with pytest.raises(error, match=named):
            register_algorithm(key, value)


@pytest.mark.parametrize("key", list(ALGORITHMS))
def test_every_algorithm_says_what_it_is(key: str) -> None:
    cls = ALGORITHMS[key]
    own = vars(cls)
    assert own["label"] and cls.family
    assert own["paper"][-4:].isdigit() and own["paper"].split()[0] in (cls.__doc__ or "")

"""PPO-Lagrangian and its kin: losses and multipliers by hand, and where others go wrong."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th
from agents import batch_of, state_of
from cost_envs import SB3_POLICY, CostPoint, TabularCMDP, told
from known_optima import problems, solve
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger, configure
from torch.distributions import Normal

from sb3_guard.algorithms import (
    ALGORITHMS,
    CPO,
    CPPOPID,
    CRPO,
    CUP,
    FOCOPS,
    P3O,
    PCPO,
    RCPO,
    TRPOFAC,
    TRPOIPO,
    TRPOSL,
    TRPOUSL,
    PPOLag,
    TrustRegion,
)
from sb3_guard.algorithms.common.filtering import FilteredTrustRegion
from sb3_guard.algorithms.common.first_order import FirstOrder
from sb3_guard.algorithms.common.lagrangian import Lagrangian

KEYS = ("ppo_lag", "cppo_pid", "focops", "cup", "p3o", "crpo", "rcpo")
LAGRANGIAN = [
    ALGORITHMS[key] for key in (*KEYS, "trpo_lag") if issubclass(ALGORITHMS[key], Lagrangian)
]


SB3 = {"gae_lambda": 0.95, "policy_kwargs": SB3_POLICY}  # where PPO's defaults are others


def make(cls: Any, n_costs: int = 1, **kwargs: Any) -> Any:
    keys = ("cost", "cost_1")[:n_costs]
    env = make_vec_env(lambda: CostPoint(30, cost_keys=keys, hazard=(-1.0, 0.0)), 4, seed=0)
    batch = {} if issubclass(cls, TrustRegion) else {"batch_size": 64}
    settings = {"n_steps": 32, "seed": 0, "device": "cpu", "cost_keys": keys, **batch, **kwargs}
    model = cls("MlpPolicy", env, **settings)
    model.set_logger(configure(format_strings=[]))
    return model


# While the limit is out of reach


@pytest.mark.parametrize("cls", [PPOLag, CPPOPID])
def test_out_of_reach_of_the_limit_it_is_sb3s_ppo(cls: Any) -> None:
    kwargs = {"target_kl": None, "clip_range_vf": 0.2}
    theirs = make_vec_env(lambda: CostPoint(30, hazard=(-1.0, 0.0)), 4, seed=0)
    settings = {"n_steps": 32, "batch_size": 64, "seed": 0, "device": "cpu", **SB3, **kwargs}
    a = state_of(PPO("MlpPolicy", theirs, **settings).learn(384))
    model = make(cls, cost_limit=1e6, **SB3, **kwargs).learn(384)
    assert a == state_of(model)
    assert model.total_cost > 0.0 and float(model.multiplier.value[0]) == 0.0


# Multipliers


@pytest.mark.parametrize("cls", LAGRANGIAN)
def test_a_broken_limit_raises_the_multiplier_and_a_kept_one_lowers_it(cls: Any) -> None:
    """By the estimate of each update, not by a mean over those before."""
    model = make(cls, cost_limit=10.0)
    seen = []
    for cost in (20.0, 20.0, 1.0):
        told(model, [cost], 30.0)
        model.set_logger(Logger(None, []))
        model.step()
        seen.append(float(model.multiplier.integral[0]))
    assert 0.0 < seen[0] < seen[1] > seen[2]


@pytest.mark.parametrize(
    "cls",
    [
        pytest.param(cls, marks=() if cls in (PPOLag, CPO, TRPOFAC, TRPOSL) else pytest.mark.slow)
        for cls in (*LAGRANGIAN, CPO, PCPO, TRPOFAC, TRPOIPO, TRPOSL, TRPOUSL)
    ],
)
def test_a_run_does_not_know_the_unit_of_cost(cls: Any) -> None:
    """Costs and limit × 100 and × 0.01: the same multipliers, the same policy to rounding.

    Prices, in return per cost, are divided by as much.
    """
    runs, prices = [], []
    filtered = issubclass(cls, FilteredTrustRegion)
    settings: dict[str, Any] = {"n_steps": 32, "seed": 0, "device": "cpu"}
    settings["policy_kwargs"] = SB3_POLICY
    settings |= {"warmup": 128, "threshold": 0.0} if filtered else {}
    settings |= {"batch_size": None} if issubclass(cls, TrustRegion) else {}
    for scale in (1.0, 100.0, 0.01):
        env = make_vec_env(
            lambda scale=scale: CostPoint(30, cost_scale=scale, hazard=(-1.0, 0.0)), 4, seed=0
        )
        model = cls("MlpPolicy", env, cost_limit=2.0 * scale, **settings).learn(256)
        logged = model.logger.name_to_value
        if filtered:
            assert logged["train/corrected_fraction"] > 0.1
        if cls in (*LAGRANGIAN, TRPOFAC, TRPOIPO):
            prices.append(scale * logged["train/cost_weight"])
        runs.append(model)
    assert prices == pytest.approx(prices[:1] * len(prices), rel=1e-2)
    assert np.all(np.array(prices) > 0.0)
    first, *others = runs
    for other in others:
        if cls in LAGRANGIAN:
            value, expected = (float(model.multiplier.value[0]) for model in (other, first))
            assert value == pytest.approx(expected, rel=1e-3) and value > 0.0
        for a, b in zip(first.policy.parameters(), other.policy.parameters(), strict=True):
            th.testing.assert_close(a, b, rtol=1e-2, atol=2e-3)


def test_prices_in_units_of_cost_weigh_costs_against_standardised_advantages() -> None:
    """As Ray et al. and OmniSafe do: A standardised over the rollout, A_C only centred."""
    fixed = {"lambda_init": 0.5, "lambda_lr": 0.0, "proportional_gain": 0.0}
    model = make(PPOLag, lambda_units="cost", **fixed)
    buffer, train = model.rollout_buffer, model.train

    def priced() -> None:
        raw, costs = buffer.advantages.copy(), buffer.cost_advantages[..., 0].copy()
        train()
        expected = raw - 0.5 * raw.std() * (costs - costs.mean())
        expected = buffer.swap_and_flatten(expected).ravel()
        np.testing.assert_allclose(buffer.advantages.ravel(), expected, rtol=1e-4, atol=1e-5)

    model.train = priced
    model.learn(128)


@pytest.mark.parametrize("cls", [FOCOPS, P3O, TRPOFAC, TRPOIPO, TRPOSL])
def test_the_weight_of_a_cost_does_not_know_the_unit_of_reward(cls: Any) -> None:
    """Advantages × 100, which are not standardised: the same gradient × 100."""
    name = "surrogate" if issubclass(cls, TrustRegion) else "loss"
    gradients = []
    for scale in (1.0, 100.0):
        model = make(cls, cost_limit=0.01)
        model.normalize_advantage = False
        buffer, train, loss = model.rollout_buffer, model.train, getattr(model, name)
        model._corrections = lambda rows: rows.observations[:, 0]  # of TRPO-SL

        def scaled(buffer: Any = buffer, train: Any = train, scale: float = scale) -> None:
            buffer.advantages *= scale
            train()

        def spy(rows: Any, ratio: th.Tensor, *new: Any, loss: Any = loss) -> th.Tensor:
            free = ratio.detach().requires_grad_()
            gradients.append(th.autograd.grad(loss(rows, free, *new), free)[0])
            raise StopIteration

        model.train = scaled
        setattr(model, name, spy)
        with pytest.raises(StopIteration):
            model.learn(128)
        if cls in (FOCOPS, P3O):
            weight = model._unit if cls is P3O else model._weight / model.multiplier.value
            expected = buffer.advantages.std() / buffer.cost_advantages.std()
            assert float(weight) == pytest.approx(expected, rel=1e-4)
        if cls is P3O:
            violation = expected * model.costs.violation
            assert model._violation.numpy() == pytest.approx(violation, rel=1e-4)
    th.testing.assert_close(100.0 * gradients[0], gradients[1], rtol=1e-3, atol=1e-5)


# Losses by hand


class Given:
    """Distributions that are given, in place of those that a policy had."""

    def __init__(self, mean: th.Tensor) -> None:
        self.mean = mean

    def at(self, places: Any) -> Any:
        return gaussian(self.mean)


def gaussian(mean: th.Tensor) -> Any:
    """SB3's distribution of actions with these means [B, 1] and the standard deviation 1."""
    from stable_baselines3.common.distributions import DiagGaussianDistribution

    made = DiagGaussianDistribution(1)
    made.distribution = Normal(mean, th.ones_like(mean))
    return made


def test_focops_loss_by_hand() -> None:
    """KL of unit Gaussians is half the squared distance: 0.005, 0.18, 0; η = 0.02 leaves two.

    A - ν A_C = 1 - 0.5·2 = 0, (masked), 2 + 0.5 = 2.5. Rows: 0.005 - 0; 0; 0 - 1.5·2.5/2. Over 3
    rows, by states and not by the batch's mean KL, 0.0617, which would leave nothing.
    """
    model = make(FOCOPS, temperature=2.0, trust_region=0.02)
    model._old, model._weight = Given(th.zeros(3, 1)), th.tensor([0.5])
    new = gaussian(th.tensor([[0.1], [0.6], [0.0]]))
    ratio = th.tensor([1.1, 0.9, 1.5])
    loss = model.loss(batch_of([1.0, 5.0, 2.0], [[2.0], [1.0], [-1.0]]), ratio, new)
    assert float(loss) == pytest.approx((0.005 - 1.5 * 2.5 / 2.0) / 3)


def test_cup_projection_by_hand() -> None:
    """(1 - 0.9·0.5)/(1 - 0.9) = 5.5; ν A_C = 1, -2; ratio · that = 1.2, -1; KL = 0.02, 0.08."""
    given = {"cost_gamma": 0.9, "cost_gae_lambda": 0.5}  # the rewards' are others
    model = make(CUP, gamma=1.0, **given)
    assert model.factor == pytest.approx(5.5)
    model._improved, model._weight = Given(th.zeros(2, 1)), th.tensor([0.5, 0.25])
    rows = batch_of([9.0, 9.0], [[1.0, 2.0], [-2.0, -4.0]])
    new = gaussian(th.tensor([[0.2], [0.4]]))
    loss = model.projection(rows, th.tensor([1.2, 0.5]), new)
    assert float(loss) == pytest.approx((0.02 + 0.08) / 2 + 5.5 * (1.2 - 1.0) / 2, rel=1e-5)


def test_p3o_by_hand() -> None:
    """A_C centred is 1, -1; ratios 1.5, 0.5 are clipped to 1.2, 0.8: max 1.5, -0.5; mean 0.5."""
    model = make(P3O, penalty=3.0, normalize_advantage=False)
    model._unit, model._violation = th.ones(1), th.tensor([0.25])
    rows, ratio = batch_of([2.0, 1.0], [[7.0], [5.0]]), th.tensor([1.5, 0.5])
    assert float(model.penalties(rows, ratio)) == pytest.approx(0.75)
    # PPO's part: min(3, 2.4), min(0.5, 0.8): mean 1.45
    assert float(model.loss(rows, ratio, None)) == pytest.approx(3.0 * 0.75 - 1.45)


def test_p3os_penalty_is_exactly_zero_at_the_old_policy_inside_the_limit() -> None:
    """Whatever the minibatch: without centring in it the mean of 64 advantages is noise."""
    model = make(P3O, n_costs=2)
    model._unit, model._violation = th.ones(2), th.tensor([-1e-3, 0.02])
    for seed in range(20):
        noise = th.randn(64, 2, generator=th.Generator().manual_seed(seed)).tolist()
        penalties = model.penalties(batch_of([0.0] * 64, noise), th.ones(64))
        assert float(penalties[0]) == 0.0 and float(penalties[1]) == pytest.approx(0.02, abs=1e-6)


@pytest.mark.parametrize(
    ("costs", "worst"), [([1.0, 2.0], None), ([3.0, 2.0], 0), ([3.0, 7.0], 1), ([2.1, 0.0], None)]
)
def test_crpo_lowers_the_cost_that_is_most_above_its_limit(costs: Any, worst: Any) -> None:
    """Limits 2 and 3 with a tolerance of a tenth; the surrogate is A or minus that cost's A_C."""
    model = make(CRPO, n_costs=2, cost_limit=[2.0, 3.0], tolerance=0.1)
    told(model, costs, 30.0)
    model.set_logger(Logger(None, []))
    assert model.violated == worst
    rows = batch_of([1.0, 2.0], [[3.0, 5.0], [4.0, 6.0]])
    expected = [1.0, 2.0] if worst is None else [[-3.0, -4.0], [-5.0, -6.0]][worst]
    assert model.advantages(rows).tolist() == expected
    model.cost_limit = [2.0, 0.0]  # of which any cost is one unit
    for cost, worst in ((4.0, 1), (5.0, 0)):
        told(model, [cost, 9.0], 30.0)
        assert model.violated == worst


def test_rcpo_takes_the_whole_step() -> None:
    model = make(RCPO, cost_limit=0.5).learn(256)
    assert model.logger.name_to_value["train/line_search_step"] == 1.0


def test_cups_second_step_is_stopped_by_its_own_distance() -> None:
    """The first goes beyond the bound in a pass; the second, hardly priced, stays and takes all."""
    still: dict[str, Any] = {"lambda_init": 1e-9, "lambda_lr": 0.0, "proportional_gain": 0.0}
    model = make(
        CUP, target_kl=1e-4, n_epochs=4, learning_rate=0.3, **still,
        policy_kwargs={"optimizer_class": th.optim.SGD, **SB3_POLICY},
    )  # fmt: skip
    calls = {"loss": 0, "projection": 0}

    def counting(name: str) -> Any:
        function = getattr(model, name)

        def count(*args: Any) -> th.Tensor:
            calls[name] += 1
            return function(*args)

        return count

    for name in calls:
        setattr(model, name, counting(name))
    model.learn(128)
    assert calls == {"loss": 2, "projection": 8}
    logged = model.logger.name_to_value
    assert logged["train/projection_kl"] < model.target_kl < logged["train/approx_kl"]
    assert logged["train/n_updates"] == model._n_updates == 5
    moving: dict[str, Any] = {**still, "lambda_init": 1.0, "projection_reach": 1e-9}
    assert make(CUP, target_kl=1.0, n_epochs=4, **moving).learn(128)._n_updates == 4 + 1


# Numbers that are not finite


@pytest.mark.parametrize("key", ["ppo_lag", "focops", "crpo", "td3_lag"])
def test_a_reward_that_is_not_finite_is_named(key: str) -> None:
    """Before torch refuses the policy's parameters, and though TD3 would train on."""

    class Broken(CostPoint):
        def step(self, action: Any) -> Any:
            observation, _, *rest = super().step(action)
            return observation, float("nan"), *rest

    cls = ALGORITHMS[key]
    off_policy = {"learning_starts": 20, "batch_size": 8, "buffer_size": 200}
    more = off_policy if key == "td3_lag" else {"n_steps": 40}
    more |= {"batch_size": 20} if issubclass(cls, PPO) else {}
    model = cls("MlpPolicy", Broken(30), cost_limit=1.0, device="cpu", **more)
    with pytest.raises(FloatingPointError, match=r"_loss is nan after .*: a reward"):
        model.learn(160)


# Known optima


@pytest.mark.parametrize(
    "key",
    [
        *("ppo_lag", "p3o"),
        *(
            pytest.param(key, marks=pytest.mark.slow)
            for key in KEYS
            if key not in ("ppo_lag", "p3o")
        ),
    ],
)
def test_a_known_optimum(key: str) -> None:
    """The five-step table under three quarters of its optimum's cost.

    Networks learn faster than by default, and so do multipliers, which takes seconds in place of
    minutes; scripts/known_optima.py has the defaults.
    """
    updates = {"focops": 100, "cup": 160}.get(key, 40)
    problem = replace(problems()["table"], updates=updates)
    assert isinstance(problem.world().cmdp, TabularCMDP)
    fast: dict[str, Any] = {"learning_rate": 3e-3, "batch_size": problem.n_envs * problem.n_steps}
    if key in ("crpo", "rcpo"):
        fast = {"learning_rate": 3e-3, "n_critic_updates": 20}
    if key == "cup":  # its second step needs several minibatches
        fast = {"learning_rate": 1e-3, "batch_size": 80}
    if issubclass(ALGORITHMS[key], Lagrangian):
        gains = {"cup": (0.05, 0.3), "rcpo": (0.3, 10.0)}.get(key, (0.5, 2.0))
        fast["lambda_lr"], fast["proportional_gain"] = gains
    outcome = solve(ALGORITHMS[key], problem, 0, **fast)
    assert outcome.good, outcome


def test_minibatches_that_are_searched_divide_rollouts():
    """Else SB3 warns of truncated minibatches in every trial, of what nobody has chosen."""
    space = FirstOrder.search_space
    for n_envs in space["n_envs"]:
        assert not any(1000 * n_envs % size for size in space["batch_size"])

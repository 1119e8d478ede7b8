"""The safety layers of TRPO-SL and TRPO-USL: projections, models, and when and where they act."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from agents import points
from cost_envs import CostPoint, RandomCostEnv, Wall
from gymnasium import spaces
from scipy.optimize import minimize
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import DummyVecEnv
from torch.nn import functional as F

from sb3_guard.algorithms import TRPOSL, TRPOUSL
from sb3_guard.algorithms.common import action_filters
from sb3_guard.algorithms.common.action_filters import (
    SafetyLayer,
    UnrolledSafetyLayer,
)
from sb3_guard.algorithms.common.filtering import FilteredTrustRegion
from sb3_guard.algorithms.common.policies import FilteredPolicy
from sb3_guard.common.evaluation import evaluate_policy

CLASSES = [TRPOSL, TRPOUSL]
STATE = spaces.Box(-np.inf, np.inf, (4,), np.float32)


def make(cls: Any, env: Any = None, policy: Any = "MlpPolicy", **kwargs: Any) -> Any:
    defaults = {"n_steps": 40, "n_critic_updates": 3, "seed": 0, "device": "cpu", "warmup": 1}
    if cls is TRPOSL:
        defaults["tolerance"] = 0.0  # a model that has hardly learnt would correct nothing
    return cls(policy, env or points(), **{**defaults, **kwargs})


def policy_of(k: int, **kwargs: Any) -> FilteredPolicy:
    th.manual_seed(0)
    box = spaces.Box(-1.0, 1.0, (k,), np.float32)
    return FilteredPolicy(STATE, box, lambda _: 1e-3, **{"net_arch": [16, 16], **kwargs})


def corrected_by(layer: Any, observations: th.Tensor, actions: np.ndarray, costs: Any) -> Any:
    """What a filter makes of actions, in NumPy."""
    last = None if costs is None else th.as_tensor(costs)
    with th.no_grad():
        return layer(observations, th.as_tensor(actions), last).numpy()


def clip_along(actions: np.ndarray, normals: np.ndarray, limits: np.ndarray) -> np.ndarray:
    tensors = map(th.as_tensor, (actions, normals, limits[:, None]))
    return action_filters.clip_along(*tensors).numpy()


# The safety layer's projection


def reference(action: np.ndarray, normals: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Nearest point of the box by SLSQP."""
    best = None
    for start in (action, np.zeros_like(action)):
        answer = minimize(
            lambda x: (0.5 * np.sum((x - action) ** 2), x - action),
            start,
            jac=True,
            bounds=[(-1, 1)] * len(action),
            constraints={
                "type": "ineq",
                "fun": lambda x: limits - normals @ x,
                "jac": lambda x: -normals,
            },
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 500},
        )
        if np.all(normals @ answer.x <= limits + 1e-7) and (best is None or answer.fun < best.fun):
            best = answer
    assert best is not None
    return best.x


@pytest.mark.parametrize("k", [1, 2, 6])
def test_one_half_space_and_the_box_against_an_optimiser(k: int) -> None:
    rng = np.random.default_rng(k)
    actions, normals = rng.uniform(-1, 1, (300, k)), rng.normal(size=(300, k))
    # Anything between unreachable by a little and already satisfied.
    limits = rng.uniform(-0.99, 0.5, 300) * np.abs(normals).sum(axis=1)
    found = clip_along(actions, normals, limits)
    walls = corrected = 0
    for action, normal, limit, x in zip(actions, normals, limits, found, strict=True):
        expected = reference(action, normal[None], np.array([limit]))
        np.testing.assert_allclose(x, expected, atol=1e-5)
        assert normal @ x <= limit + 1e-9
        corrected += not np.array_equal(x, action)
        walls += bool((np.abs(x) == 1.0).any())
    assert 100 < corrected < 300 and (walls > 20 or k == 1)


def test_an_unreachable_half_space_is_approached_as_far_as_the_box_goes() -> None:
    actions = np.array([[0.3, -0.2, 0.5]])
    normals = np.array([[2.0, -1e-6, 0.0]])
    found = clip_along(actions, normals, np.array([-100.0]))
    np.testing.assert_allclose(found, [[-1.0, 1.0, 0.5]])
    np.testing.assert_array_equal(clip_along(actions, 0 * normals, np.array([-1.0])), actions)


@pytest.mark.parametrize("drift", [False, True])
@pytest.mark.parametrize("m", [1, 2])
def test_the_safety_layer_keeps_its_prediction_below_the_threshold(m: int, drift: bool) -> None:
    layer = SafetyLayer(policy_of(3), m, drift)
    layer.threshold.fill_(0.1)
    observations, costs = th.randn(200, 4), np.full((200, m), 0.05)
    actions = np.random.default_rng(0).uniform(-3, 3, (200, 3))
    corrected = corrected_by(layer, observations, actions, costs)
    assert np.abs(corrected).max() <= 1.0

    def predicted(a: np.ndarray) -> np.ndarray:
        batch = (observations, th.as_tensor(a).float(), th.as_tensor(costs).float())
        return layer.predicted(batch)[:, :m].detach().numpy()

    clipped = np.clip(actions, -1, 1)
    broken = (predicted(clipped) > 0.1).any(axis=1)
    assert 20 < broken.sum() < 180
    np.testing.assert_allclose(corrected[~broken], clipped[~broken], atol=1e-12)
    slopes = layer._split(layer.network(observations))[0].detach().abs().sum(dim=2).numpy()
    reachable = (predicted(0 * actions) - slopes <= 0.1).all(axis=1)
    assert reachable[broken].any()
    if m == 1:
        assert predicted(corrected)[reachable].max() <= 0.1 + 1e-5
    else:  # but where the limits nearly contradict each other
        assert np.mean(predicted(corrected) <= 0.1 + 1e-3) > 0.95


def test_the_safety_layer_learns_a_linear_cost() -> None:
    """c = c_before + (1 + s_0) a_0 - 0.5 a_1: slopes and last costs are recovered."""
    layer = SafetyLayer(policy_of(2), 1)
    observations = th.rand(4000, 4) - 0.5
    actions, last = 2 * th.rand(4000, 2) - 1, observations[:, 1:2].abs()
    slopes = th.stack([1 + observations[:, 0], th.full((4000,), -0.5)], dim=1)
    costs = last + (slopes * actions).sum(dim=1, keepdim=True)
    for group in layer.optimizer.param_groups:
        group["lr"] = 1e-2
    targets = th.cat([costs, last], dim=1)
    loss = layer.learn((observations, actions, last), targets, 400, None)
    assert loss < 1e-3
    found, estimated, _ = layer._split(layer.network(observations))
    th.testing.assert_close(found[:, 0], slopes, atol=0.15, rtol=0)
    th.testing.assert_close(estimated, last, atol=0.15, rtol=0)


# The unrolled layer's descent


@pytest.mark.parametrize("m", [1, 2])
def test_descent_lowers_the_cost_to_come(m: int) -> None:
    layer = UnrolledSafetyLayer(policy_of(3), m)
    layer.threshold.fill_(0.7)
    observations = th.randn(300, 4)
    actions = np.random.default_rng(0).uniform(-2, 2, (300, 3))
    corrected = corrected_by(layer, observations, actions, None)
    clipped = np.clip(actions, -1, 1)

    def excess(a: np.ndarray) -> np.ndarray:
        values = layer.values(observations, th.as_tensor(a).float()).numpy()
        return np.maximum(0.0, values - 0.7).sum(axis=1)

    before, after = excess(clipped), excess(corrected)
    broken = before > 0.0
    assert 30 < broken.sum() < 290
    np.testing.assert_allclose(corrected[~broken], clipped[~broken], atol=1e-6)
    # In a corner of the box that the cost pushes towards, nothing moves.
    assert np.all(after <= before + 1e-6)
    assert (after < before)[broken].mean() > 0.95
    assert np.abs(corrected).max() <= 1.0
    assert np.abs(corrected - clipped).max() <= layer.steps * layer.rate + 1e-5


def test_descent_takes_steps_of_its_rate_in_the_fastest_coordinate() -> None:
    layer = UnrolledSafetyLayer(policy_of(3), 1, steps=1, rate=0.03)
    actions = np.zeros((50, 3))
    moved = np.abs(corrected_by(layer, th.randn(50, 4), actions, None)).max(axis=1)
    np.testing.assert_allclose(moved, 0.03, rtol=1e-4)


@pytest.mark.parametrize(
    ("net_arch", "threshold"), [([], 0.0), ([16, 8], 0.4), ([16], 100.0)], ids=str
)
@pytest.mark.parametrize("activation", action_filters.GRADIENTS, ids=lambda kind: kind.__name__)
def test_written_out_descent_is_autograds(activation: Any, net_arch: Any, threshold: float) -> None:
    policy = policy_of(2, net_arch=net_arch, activation_fn=activation)
    layer = UnrolledSafetyLayer(policy, 2)
    layer.threshold.fill_(threshold)
    observations, a = th.randn(100, 4), (2 * th.rand(100, 2) - 1).requires_grad_()
    first = layer.network.network[0]
    state = F.linear(observations, first.weight[:, :-2], first.bias)
    bound = th.log(th.expm1(th.tensor(max(threshold, 1e-30)))).expand(2)
    found = layer._slope(state, first.weight[:, -2:], bound, a.detach()).detach()
    values = F.softplus(layer.network.network(th.cat([observations, a], dim=1)))
    (expected,) = th.autograd.grad((values - threshold).clamp(min=0.0).sum(), a)
    th.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
    assert bool(found.any()) == (threshold < 100.0)


def test_an_activation_without_a_derivative_is_refused() -> None:
    with pytest.raises(ValueError, match=r"activation_fn=GELU: .*Tanh, ReLU"):
        UnrolledSafetyLayer(policy_of(2, activation_fn=th.nn.GELU), 1)


class Corridor(RandomCostEnv):
    """Three steps that cost 1, 2 and 4, then the end: costs to come known by hand."""

    def __init__(self, terminate: bool) -> None:
        box = spaces.Box(-1.0, 1.0, (1,), np.float32)
        super().__init__(box, box, episode_length=3)
        self.terminate = terminate

    def step(self, action: Any) -> Any:
        observation, reward, _, over, _ = super().step(action)
        cost = 2.0 ** (self.steps - 1)
        return (
            observation,
            reward,
            over and self.terminate,
            over and not self.terminate,
            {"cost": cost},
        )


@pytest.mark.parametrize("terminate", [True, False])
@pytest.mark.parametrize("lam", [0.0, 1.0])
def test_targets_of_the_cost_critic_by_hand(lam: float, terminate: bool) -> None:
    """c + γ Q' within an episode; c at its end; c + γ Q(cut observation) at a time-out.

    With λ = 1, sums of the costs that were paid and what is bootstrapped in the end.
    """
    env = make_vec_env(lambda: Corridor(terminate), 2, seed=0)
    model = make(TRPOUSL, env, n_steps=7, gamma=0.9, cost_gae_lambda=lam, warmup=10**9)
    # A critic that says half a unit everywhere.
    with th.no_grad():
        last = model.policy.action_filter.network.network[-1]
        last.weight.zero_()
        last.bias.fill_(float(np.log(np.expm1(0.5))))
    model.learn(14)
    unit = float(np.sqrt(np.mean(np.square([1, 2, 4, 1, 2, 4, 1]))))
    assert float(model.policy.action_filter.unit) == pytest.approx(unit)
    ahead = 0.9 * 0.5 * unit
    end = 0.0 if terminate else ahead
    if lam == 0.0:
        expected = [1 + ahead, 2 + ahead, 4 + end] * 2 + [1 + ahead]
    else:
        last_step = 4 + end
        episode = [1 + 0.9 * (2 + 0.9 * last_step), 2 + 0.9 * last_step, last_step]
        expected = episode * 2 + [1 + ahead]
    found = model.rollout_buffer.cost_returns.reshape(2, 7)
    np.testing.assert_allclose(found, [expected] * 2, rtol=1e-5)


def test_models_learn_in_units_of_the_largest_costs_so_far() -> None:
    """Root mean squares of those that are not zero; a rollout without any changes nothing."""
    model = make(TRPOSL, points(2))
    layer = model.policy.action_filter
    for costs, expected in (
        ([0.0, 0.0], 1.0),
        ([0.0, 0.1], 0.1),
        ([3.0, 4.0], 12.5**0.5),
        ([1.0, 0.0], 12.5**0.5),
    ):
        model.rollout_buffer.costs = np.array(costs, np.float32)[:, None, None]
        model._choose_cost_units()
        assert float(layer.unit) == pytest.approx(expected)


# The algorithms


@pytest.mark.parametrize("cls", CLASSES)
def test_corrected_actions_run_and_sampled_ones_are_learnt_from(cls: Any) -> None:
    executed: list[np.ndarray] = []

    class Spy(CostPoint):
        def step(self, action: np.ndarray) -> Any:
            executed.append(action.copy())
            return super().step(action)

    env = DummyVecEnv([lambda: Spy(episode_length=30, hazard=(-1.0, 0.0))] * 2)
    model = make(cls, env, threshold=-1.0)
    model.learn(160)
    buffer = model.rollout_buffer
    last = np.array(executed[-80:]).reshape(40, 2, 2)
    np.testing.assert_allclose(
        buffer.executed_actions.reshape(2, 40, 2).swapaxes(0, 1), last, atol=1e-6
    )
    sampled = np.clip(buffer.actions, -1, 1).reshape(2, 40, 2).swapaxes(0, 1)
    assert np.abs(sampled - last).max() > 0.1
    logged = model.logger.name_to_value
    assert logged["train/corrected_fraction"] > 0.5 and logged["train/correction_norm"] > 0.01


def test_last_costs_reach_the_batch() -> None:
    """The cost of the step before, zero where an episode starts, across rollouts too."""
    model = make(TRPOSL, points(2, episode_length=33))
    steps, batches = [], []

    def record(local: dict, _: dict) -> bool:
        steps.append(([info["cost"] for info in local["infos"]], local["dones"].copy()))
        return True

    fit = model.fit
    model.fit = lambda batch: batches.append(batch.previous_costs) or fit(batch)
    model.learn(240, callback=record)
    costs = np.array([cost * ~done for cost, done in steps])  # [120, 2]
    expected = np.concatenate([np.zeros((1, 2)), costs[:-1]]).reshape(3, 40, 2)
    for batch, rollout in zip(batches, expected, strict=True):
        np.testing.assert_allclose(batch[:, 0].reshape(2, 40).T, rollout, rtol=1e-5)
    assert expected.max() > 0.1


@pytest.mark.parametrize(("warmup", "on_at"), [(1 / 3, 80), (np.int64(100), 160), (1.0, None)])
def test_warmup(warmup: float, on_at: int | None) -> None:
    """The first rollout after that share of the first `learn`, or number of steps."""
    model = make(TRPOUSL, warmup=warmup, n_critic_updates=1)
    active = {}
    train = model.train

    def spy() -> None:
        train()
        active[model.num_timesteps] = model.policy.corrects

    model.train = spy
    model.learn(240)
    assert list(active) == [80, 160, 240]
    first = next((steps for steps, on in active.items() if on), None)
    assert first == (240 if on_at is None else on_at)
    model.learn(80)
    assert model.policy.corrects and model.num_timesteps == 80, "once on, it stays on"


@pytest.mark.parametrize("cls", CLASSES)
def test_the_filter_travels_with_model_and_policy(cls: Any, tmp_path: Path) -> None:
    model = make(cls).learn(240)
    observations = model.env.reset()
    expected, _ = model.predict(observations, deterministic=True)
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    policy = FilteredPolicy.load(tmp_path / "policy", device="cpu")
    for again in (cls.load(tmp_path / "model", device="cpu"), policy):
        np.testing.assert_array_equal(again.predict(observations, deterministic=True)[0], expected)
    assert policy.corrects
    assert type(policy.action_filter) is type(model.policy.action_filter)


def test_the_true_last_cost_wins() -> None:
    """Given as state it decides; at the start of an episode it is zero; without it h stands in."""
    model = make(TRPOSL, threshold=0.2).learn(80)
    layer = model.policy.action_filter
    seen: list[Any] = []
    correct = layer.forward
    layer.forward = lambda *args: seen.append(args[2]) or correct(*args)
    observations = model.env.reset()
    state = (np.array([[0.3], [0.1]]),)
    _, returned = model.predict(observations, state, np.array([False, True]))
    np.testing.assert_array_equal(seen[-1], [[0.3], [0.0]])
    assert returned is state
    model.predict(observations)
    assert seen[-1] is None
    # A cost above the threshold is answered, whatever the network thinks of the state.
    low, _ = model.predict(observations, (np.full((2, 1), -10.0),), deterministic=True)
    high, _ = model.predict(observations, (np.full((2, 1), 10.0),), deterministic=True)
    plain, _ = ActorCriticPolicy.predict(model.policy, observations, deterministic=True)
    np.testing.assert_array_equal(low, plain)
    assert np.abs(high - plain).max() > 0.1


def test_evaluation_tells_the_layer_what_the_last_step_cost() -> None:
    keys = ("cost", "cost_1")
    model = make(TRPOSL, points(2, cost_keys=keys), cost_keys=keys).learn(80)
    seen: list[Any] = []
    correct = model.policy.action_filter.forward
    model.policy.action_filter.forward = lambda *args: seen.append(args[2]) or correct(*args)
    env = points(2, cost_keys=keys)
    evaluation = evaluate_policy(model, env, 4)
    told = np.array(seen)  # [60, 2, m]
    assert told.shape == (60, 2, 2)
    np.testing.assert_array_equal(told[[0, 30]], 0.0)
    # All but the last cost of each episode are told.
    assert 0.5 * evaluation.costs.sum() < told[..., 0].sum() <= evaluation.costs.sum() + 1e-9
    np.testing.assert_allclose(told[..., 1], 2 * told[..., 0])
    model = make(TRPOUSL).learn(80)
    assert not model.policy.acts_on_cost
    assert len(evaluate_policy(model, points(2), 2)) == 2


@pytest.mark.parametrize("cls", CLASSES)
def test_boxes_of_any_size(cls: Any) -> None:
    """The filter works in units of the action space, and its actions stay in the box."""
    box = spaces.Box(np.array([-5.0, 0.0], np.float32), np.array([1.0, 0.1], np.float32))
    env = make_vec_env(lambda: RandomCostEnv(STATE, box), 2, seed=0)  # refuses others
    model = make(cls, env, threshold=-1.0).learn(240)
    assert model.logger.name_to_value["train/corrected_fraction"] > 0.5
    unit = model.policy.box.unit(th.tensor([[-5.0, 0.1], [-2.0, 0.05]]))
    np.testing.assert_allclose(unit, [[-1, 1], [0, 0]], atol=1e-6)
    action, _ = model.predict(env.reset())
    assert all(box.contains(each) for each in action)


def test_thresholds_default_to_the_limit() -> None:
    model = make(TRPOSL, points(2), cost_limit=3.0).learn(80)
    assert model.policy.action_filter.threshold.item() == pytest.approx(3.0 / 30)
    model = make(TRPOUSL, points(2), cost_limit=3.0).learn(80)
    expected = 0.1 / 0.01  # a time limit cuts the episodes
    assert model.policy.action_filter.threshold.item() == pytest.approx(expected)
    model = make(TRPOUSL, points(2), tolerance=0.07).learn(80)
    expected = 0.07 * model.policy.action_filter.unit.item()
    assert model.policy.action_filter.threshold.item() == pytest.approx(expected)
    keys = ("cost", "cost_1")
    model = make(TRPOSL, points(2, cost_keys=keys), cost_keys=keys, threshold=[0.1, 0.3]).learn(80)
    np.testing.assert_allclose(model.policy.action_filter.threshold.numpy(), [0.1, 0.3])


@pytest.mark.parametrize("cls", CLASSES)
def test_a_threshold_given_to_load_holds_at_once(cls: Any, tmp_path: Path) -> None:
    model = make(cls, n_critic_updates=1, threshold=100.0).learn(80)
    model.save(tmp_path / "model")
    kept = cls.load(tmp_path / "model", device="cpu").policy.action_filter.threshold
    assert th.equal(kept, model.policy.action_filter.threshold)
    again = cls.load(tmp_path / "model", device="cpu", threshold=-1.0)
    assert again.policy.action_filter.threshold.item() == -1.0
    observation = np.zeros((2, 4), np.float32)
    actions = [each.predict(observation, deterministic=True)[0] for each in (model, again)]
    assert np.abs(actions[1] - actions[0]).max() > 0.01


def test_the_tolerance_is_in_root_mean_square_errors_of_the_model() -> None:
    model = make(TRPOSL, tolerance=2.0).learn(80)
    batch, layer = model._batch(), model.policy.action_filter
    last = batch.previous_costs / layer.unit
    found = layer.predicted((batch.observations, model._executed(batch), last))[:, :1]
    error = (layer.unit * found - batch.costs).square().mean().sqrt()
    assert layer.noise.item() == pytest.approx(2.0 * error.item(), rel=1e-5)


def test_without_a_cost_the_cost_model_rests() -> None:
    model = make(TRPOSL, points(2, cost_scale=0.0)).learn(160)
    assert not model.policy.action_filter.optimizer.state
    assert "train/cost_model_loss" not in model.logger.name_to_value


def test_as_many_steps_without_cost_are_drawn_as_with() -> None:
    model = make(TRPOSL, points(4, hazard=(-0.5, 0.6)), n_steps=200)
    drawn: list[Any] = []
    learn = model.policy.action_filter.learn

    def spy(*args: Any) -> float:
        drawn.append(args[1][:, 0])
        return learn(*args)

    model.policy.action_filter.learn = spy
    model.learn(800)
    total = int((model.rollout_buffer.costs != 0).sum())
    assert 0 < total < 400 and len(drawn) == model.model_passes == 80
    for costs in drawn:
        assert len(costs) == 2 * total and int((costs != 0).sum()) == total


def test_the_policy_pays_for_corrections() -> None:
    """By κ times their length, centred, row by row."""
    model = make(TRPOUSL, points(2), threshold=0.0, warmup=0, correction_penalty=3.0).learn(80)
    batch, raw = model._batch(), model.rollout_buffer.whole()
    reward = (raw.advantages - raw.advantages.mean()) / raw.advantages.std()
    lengths = model._corrections(batch)
    assert lengths.std() > 0.0
    th.testing.assert_close(batch.advantages, reward - 3.0 * (lengths - lengths.mean()))


@pytest.mark.parametrize(("cost", "noise", "moves"), [(0.2, 0.0, True), (0.2, 0.4, False)])
@pytest.mark.parametrize("slope", [0.3, 0.5])
def test_what_is_below_the_models_error_is_not_corrected(
    cost: float, noise: float, moves: bool, slope: float
) -> None:
    """ĉ = 0.2 + slope · a at a = 1, threshold 0.3: 0.5 and 0.7 are above it, by less than 0.4."""
    layer = make(TRPOSL, points(2)).policy.action_filter
    outputs = th.tensor([[slope, 0.0, 0.0, 0.0]])  # g, h and drift, in units of 1
    layer.network.forward = lambda observations: outputs
    layer.threshold.fill_(0.3)
    layer.noise.fill_(noise)
    action = np.array([[1.0, 0.0]])
    executed = corrected_by(layer, th.zeros(1, 4), action, np.array([[cost]]))
    assert (np.abs(executed - action).max() > 0.1) == moves
    # far above threshold and error it corrects all the same, if actions matter more than the error
    executed = corrected_by(layer, th.zeros(1, 4), action, np.array([[5.0]]))
    assert (np.abs(executed - action).max() > 0.1) == (slope > noise)


class OwnPolicy(ActorCriticPolicy):
    """Somebody's policy."""


class FilteredOwnPolicy(FilteredPolicy, OwnPolicy):
    """The same with a filter, as the error message says."""


@pytest.mark.parametrize("cls", CLASSES)
def test_policies_of_ones_own(cls: Any) -> None:
    with pytest.raises(ValueError, match=r"class FilteredOwnPolicy\(FilteredPolicy, OwnPolicy\)"):
        make(cls, policy=OwnPolicy)
    assert isinstance(make(cls, policy=FilteredOwnPolicy).learn(80).policy, OwnPolicy)


@pytest.mark.parametrize(
    ("cls", "kwargs", "message"),
    [
        (TRPOSL, {"warmup": 1.5}, r"warmup ?= ?1.5.* 1"),
        (TRPOSL, {"warmup": -1}, r"warmup.*-1.*at least 0"),
        (TRPOSL, {"threshold": [0.1, 0.2]}, r"threshold=\[0.1, 0.2\].*one for each of the 1"),
        (TRPOUSL, {"steps": 0}, r"steps ?= ?0"),
    ],
)
def test_bad_values_are_named(cls: Any, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(cls, **kwargs)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("cls", CLASSES)
def test_it_stops_before_the_wall(cls: type[FilteredTrustRegion], seed: int) -> None:
    """Most of the return; from its first rollout on a fiftieth of what was paid just before.

    Means over rollouts: near its threshold the model forgets what lies behind, and is reminded.
    """
    seen: list[tuple[bool, float, float]] = []

    class Seen(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            buffer = self.model.rollout_buffer  # two episodes of 30 steps in each row
            sums = buffer.costs.sum(axis=0).mean() / 2, buffer.rewards.sum(axis=0).mean() / 2
            seen.append((self.model.policy.corrects, *sums))

    model = cls(
        "MlpPolicy",
        make_vec_env(Wall, 8, seed=seed),
        n_steps=60,
        gamma=0.95,
        gae_lambda=0.9,
        # A wall asks for no more than a few steps of foresight.
        cost_gamma=0.8,
        correction_penalty=0.0,  # the policy alone is to run into the wall
        cost_limit=0.3,  # a centimetre beyond the wall, in each of the 30 steps
        target_kl=0.05,
        learning_rate=3e-3,
        n_critic_updates=40,
        seed=seed,
        policy_kwargs={"net_arch": [32, 32], "log_std_init": -0.5},
    ).learn(24_000, callback=Seen())
    # Starting between -1 and -0.5, the wall is 0.75 away on average.
    assert np.mean([total for *_, total in seen[-12:]]) >= 0.85 * 0.75
    *_, before = (cost for corrects, cost, _ in seen if not corrects)
    since = [cost for corrects, cost, _ in seen if corrects]
    assert len(since) >= 30 and np.mean(since) <= 0.02 * before
    # The policy alone still runs into the wall.
    model.policy.action_filter.active.fill_(False)
    alone = evaluate_policy(model, make_vec_env(Wall, 10, seed=100), 50, seed=0)
    assert alone.costs.mean() >= 2.0

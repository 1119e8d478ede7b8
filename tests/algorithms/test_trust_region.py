"""The base algorithm: Fisher products, critics, line search, hooks, and TRPO without costs."""

import copy
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch as th
from cost_envs import SB3_POLICY, CostPoint, collect
from gymnasium import spaces
from stable_baselines3.common.distributions import kl_divergence
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    MultiInputActorCriticPolicy,
)
from torch import nn
from torch.nn import functional as F

from sb3_guard.algorithms import CPO, TRPO, TrustRegion
from sb3_guard.algorithms.common import rollouts, trust_region
from sb3_guard.algorithms.common.actor import (
    Actor,
    Before,
    actor_parameters,
    kl,
    value_parameters,
)
from sb3_guard.algorithms.common.batches import CHUNK
from sb3_guard.algorithms.common.critics import StateNetwork, regress
from sb3_guard.algorithms.common.vectors import assign, flatten
from sb3_guard.algorithms.fast.actor import TanhActor, actor_of, tanh_actor

BOX = spaces.Box(-np.inf, np.inf, (5,), np.float32)
HEADS: dict[str, spaces.Space] = {
    "gaussian": spaces.Box(-1.0, 1.0, (3,), np.float32),
    "categorical": spaces.Discrete(4),
    "multicategorical": spaces.MultiDiscrete([2, 3]),
    "bernoulli": spaces.MultiBinary(3),
}


def make_policy(action_space: spaces.Space, **kwargs: Any) -> ActorCriticPolicy:
    th.manual_seed(0)
    policy = ActorCriticPolicy(BOX, action_space, lambda _: 1e-3, **{"net_arch": [6, 4], **kwargs})
    # A fresh policy's head is nearly zero, which would hide a wrong curvature.
    with th.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.4 * th.randn_like(parameter))
    return policy


def make_batch(policy: ActorCriticPolicy, n: int) -> tuple[th.Tensor, th.Tensor]:
    observations = th.randn(n, 5)
    with th.no_grad():
        actions = policy.get_distribution(observations).sample()
    return observations, actions


def explicit_fisher(policy: ActorCriticPolicy, observations: th.Tensor) -> th.Tensor:
    """Hessian of the mean KL, one row at a time."""
    parameters = actor_parameters(policy)
    with th.no_grad():
        old = copy.copy(policy.get_distribution(observations))
    divergence = kl(old, policy.get_distribution(observations)).mean()
    slope = flatten(th.autograd.grad(divergence, parameters, create_graph=True))
    return th.stack([flatten(th.autograd.grad(s, parameters, retain_graph=True)) for s in slope])


@pytest.mark.parametrize("kind", [TanhActor, Actor])
@pytest.mark.parametrize("head", HEADS)
def test_fisher_product_is_the_hessian_of_the_kl(head: str, kind: type[Actor]) -> None:
    policy = make_policy(HEADS[head])
    observations, actions = make_batch(policy, 50)
    actor = kind(policy, observations, actions)
    hessian = explicit_fisher(policy, observations)
    order = _columns(actor, policy)
    for _ in range(3):
        vector = th.randn(len(hessian))
        expected = (hessian @ vector[order.argsort()])[order]
        th.testing.assert_close(actor.fisher(vector), expected, rtol=1e-4, atol=1e-5)


def _columns(actor: Actor, policy: ActorCriticPolicy) -> th.Tensor:
    """Where the entries of the actor's flat vector stand in the policy's own order."""
    starts, position = {}, 0
    for parameter in actor_parameters(policy):
        starts[id(parameter)] = position
        position += parameter.numel()
    return th.cat([th.arange(p.numel()) + starts[id(p)] for p in actor.parameters])


@pytest.mark.parametrize("n", [50, CHUNK + 1])
@pytest.mark.parametrize("head", HEADS)
def test_both_actors_agree(head: str, n: int) -> None:
    """Written-out passes and autograd, in one slice and in several, are the same numbers."""
    policy = make_policy(HEADS[head])
    observations, actions = make_batch(policy, n)
    fast, plain = TanhActor(policy, observations, actions), Actor(policy, observations, actions)
    order = th.argsort(_columns(fast, policy))
    weights, vector = th.randn(n) / n, th.randn(sum(p.numel() for p in fast.parameters))
    th.testing.assert_close(fast.score(weights)[order], plain.score(weights), rtol=1e-3, atol=1e-5)
    product = plain.fisher(vector[order])
    th.testing.assert_close(fast.fisher(vector)[order], product, rtol=1e-3, atol=1e-5)
    th.testing.assert_close(fast.old_log_prob, plain.old_log_prob)


def test_kl_is_summed_over_action_dimensions() -> None:
    """Three dimensions shifted by one standard deviation each: ½ + ½ + ½, not their mean."""
    policy = make_policy(HEADS["gaussian"])
    observations, actions = make_batch(policy, 8)
    actor = actor_of(policy, observations, actions)
    with th.no_grad():
        policy.action_net.bias.add_(policy.log_std.exp())
    assert actor.evaluate()[1] == pytest.approx(1.5, rel=1e-5)


@pytest.mark.parametrize("head", HEADS)
def test_kl_is_of_the_old_to_the_new_policy(head: str) -> None:
    policy = make_policy(HEADS[head])
    observations, actions = make_batch(policy, 30)
    actor = actor_of(policy, observations, actions)
    assert actor.evaluate()[1] == pytest.approx(0.0, abs=1e-6)
    old = copy.deepcopy(policy).get_distribution(observations)
    assign(actor.parameters, flatten(actor.parameters) + 0.1)
    ratio, divergence = actor.evaluate()
    new = policy.get_distribution(observations)
    expected = kl_divergence(old, new).reshape(30, -1).sum(dim=1).mean().item()
    assert divergence == pytest.approx(expected, rel=1e-4)
    expected_ratio = th.exp(new.log_prob(actions) - old.log_prob(actions))
    th.testing.assert_close(ratio, expected_ratio.detach(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("head", HEADS)
def test_what_a_policy_was_is_kept_row_by_row(head: str) -> None:
    """In more rows than are looked at together; the policy learns on."""
    policy = make_policy(HEADS[head])
    observations, actions = make_batch(policy, CHUNK + 40)
    before, old = Before(policy, observations, actions), copy.deepcopy(policy)
    assign(actor_parameters(policy), flatten(actor_parameters(policy)) + 0.1)
    places = th.tensor([3, CHUNK + 7, 0])
    with th.no_grad():
        expected = old.get_distribution(observations[places])
        log_prob = expected.log_prob(actions[places])
        th.testing.assert_close(before.log_prob[places], log_prob)
        th.testing.assert_close(before.at(places).log_prob(actions[places]), log_prob)
        zero = kl(before.at(places), expected)
        assert (
            float(zero.abs().max())
            < 1e-6
            < float(kl(before.at(places), policy.get_distribution(observations[places])).min())
        )


class _Noisy(ActorCriticPolicy):
    def get_distribution(self, obs: Any) -> Any:
        return super().get_distribution(2.0 * obs)


class _WiderTanh(nn.Tanh):
    def forward(self, input: th.Tensor) -> th.Tensor:
        return 2.0 * super().forward(input)


def test_the_fast_actor_is_chosen_only_for_plain_tanh_networks() -> None:
    action_space = HEADS["gaussian"]
    assert tanh_actor(make_policy(action_space)) is not None
    assert tanh_actor(make_policy(action_space, net_arch=[])) is not None
    assert tanh_actor(make_policy(action_space, activation_fn=nn.ReLU)) is None
    assert tanh_actor(make_policy(action_space, activation_fn=_WiderTanh)) is None
    assert tanh_actor(make_policy(action_space, use_sde=True)) is None
    assert tanh_actor(_Noisy(BOX, action_space, lambda _: 1e-3)) is None
    frozen = make_policy(action_space)
    frozen.action_net.bias.requires_grad_(False)
    assert tanh_actor(frozen) is None
    image = spaces.Dict({"image": spaces.Box(0, 255, (3, 36, 36), np.uint8), "vector": BOX})
    assert tanh_actor(MultiInputActorCriticPolicy(image, action_space, lambda _: 1e-3)) is None
    vectors = spaces.Dict({"a": BOX, "b": BOX})
    assert tanh_actor(MultiInputActorCriticPolicy(vectors, action_space, lambda _: 1e-3))


@pytest.mark.parametrize("share", [True, False])
def test_actor_and_value_parameters_are_disjoint_and_complete(share: bool) -> None:
    image = spaces.Box(0, 255, (3, 36, 36), np.uint8)
    policy = make_policy(HEADS["gaussian"], share_features_extractor=share)
    assert not _ids(actor_parameters(policy)) & _ids(value_parameters(policy))
    assert _ids(actor_parameters(policy)) | _ids(value_parameters(policy)) == _ids(
        policy.parameters()
    )
    cnn = ActorCriticCnnPolicy(
        image, HEADS["gaussian"], lambda _: 1e-3, share_features_extractor=share
    )
    shared = _ids(cnn.pi_features_extractor.parameters())
    assert shared <= _ids(actor_parameters(cnn))
    assert not shared & _ids(value_parameters(cnn))
    own = _ids(cnn.vf_features_extractor.parameters())
    assert (own <= _ids(value_parameters(cnn))) is not share


def _ids(parameters: Any) -> set[int]:
    return {id(parameter) for parameter in parameters}


# Critics


@pytest.mark.parametrize("batch_size", [None, 70])
def test_a_regression_takes_the_steps_of_a_loop_by_hand(batch_size: int | None) -> None:
    """Equal minibatches, a whole pass each, and the loss of the last one; slices change nothing."""
    n, k = (200, 3) if batch_size else (CHUNK + 100, 1)
    critic = StateNetwork(make_policy(HEADS["gaussian"]), 2)
    twin = copy.deepcopy(critic)
    twin.optimizer = th.optim.SGD(twin.parameters(), lr=0.1)
    observations, targets = th.randn(n, 5), th.randn(n, 2)
    losses = []
    order = np.random.default_rng(4).permutation(n) if batch_size else np.arange(n)
    for rows in np.array_split(order, k):
        error = F.mse_loss(twin(observations[rows]), targets[rows])
        twin.optimizer.zero_grad()
        error.backward()
        twin.optimizer.step()
        losses.append(error.item() * len(rows) / n)
    moving, rng = list(critic.parameters()), np.random.default_rng(4)
    descent = th.optim.SGD(moving, lr=0.1)
    loss = regress(critic, moving, descent, observations, targets, 1, batch_size, rng)
    assert loss == pytest.approx(sum(losses), rel=1e-5)
    for a, b in zip(critic.parameters(), twin.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("pass_of", "batch_size", "rows"),
    [(30_000, 2000, 2000), (2_000, 2000, 200), (100, 2000, 64), (100, 10, 10), (100, None, None)],
)
def test_a_pass_of_the_critics_has_ten_steps(pass_of, batch_size, rows) -> None:
    assert CPO("MlpPolicy", CostPoint(), batch_size=batch_size).critic_batch(pass_of) == rows


def test_value_regression_moves_the_value_network_alone() -> None:
    policy = make_policy(HEADS["gaussian"])
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    observations = th.randn(100, 5)
    targets = observations[:, :1] + 1.0
    fit = partial(
        regress,
        policy.predict_values,
        value_parameters(policy),
        policy.optimizer,
        observations,
        targets,
    )
    first = fit(1)
    assert fit(300) < 0.5 * first
    moved = {n for n, value in policy.state_dict().items() if not th.equal(value, before[n])}
    assert moved == {name for name in before if "value_net" in name}


def test_critics_are_fitted_to_discounted_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[tuple[Any, np.ndarray]] = []

    def fit(_: Any, __: Any, optimizer: Any, ___: Any, targets: th.Tensor, *____: Any) -> float:
        fitted.append((optimizer, targets.numpy().copy()))
        return 0.0

    monkeypatch.setattr(trust_region, "regress", fit)
    monkeypatch.setattr(rollouts, "regress", fit)
    model = _toy(CPO).learn(200)
    (policy, values), (critic, costs) = fitted
    assert policy is model.policy.optimizer and critic is model.cost_critic.optimizer
    buffer = model.rollout_buffer
    np.testing.assert_array_equal(values, buffer.returns.reshape(-1, 1))
    np.testing.assert_array_equal(costs, buffer.cost_returns)
    assert not np.allclose(buffer.returns.ravel(), buffer.advantages.ravel())


# TRPO


def test_costs_do_not_change_trpo() -> None:
    """A missing, a zero and a huge cost give the same policy, and the cost is only logged."""
    policies = []
    for kwargs in ({"cost_keys": ()}, {"cost_scale": 0.0}, {"cost_scale": 1e6}):
        env = make_vec_env(lambda kwargs=kwargs: CostPoint(**kwargs), 2, seed=0)
        model = TRPO("MlpPolicy", env, n_steps=100, n_critic_updates=5, seed=0).learn(400)
        policies.append(flatten(p.detach() for p in model.policy.parameters()))
        assert model.costs.seen is ("cost_keys" not in kwargs)
    assert th.equal(policies[0], policies[1]) and th.equal(policies[0], policies[2])


# Hooks and line search


def _toy(cls: type[TrustRegion], **kwargs: Any) -> TrustRegion:
    env = make_vec_env(CostPoint, 2, seed=0)
    return cls("MlpPolicy", env, n_steps=100, n_critic_updates=2, seed=0, **kwargs)


def _actor_vector(model: TrustRegion) -> th.Tensor:
    return flatten([p.detach().clone() for p in actor_parameters(model.policy)])


@pytest.mark.parametrize("size", [-200.0, 1e30, np.nan])
def test_a_candidate_that_is_no_distribution_is_rejected(size: float) -> None:
    """exp(log_std) is 0, or the step or the mean is not finite: training continues."""
    model = _toy(TRPO)
    model.line_search_max_iter = 2
    plan = model.plan
    model.plan = lambda region: (th.full_like(region.gradient, size), plan(region)[1])  # type: ignore
    before = _actor_vector(model)
    model.learn(200)
    assert th.equal(_actor_vector(model), before)
    assert model.logger.name_to_value["train/line_search_step"] == 0.0


def test_a_search_that_begins_too_far_off_goes_on() -> None:
    model = _toy(TRPO)
    plan = model.plan
    model.plan = lambda region: (1e5 * plan(region)[0], plan(region)[1])  # type: ignore
    before = _actor_vector(model)
    model.learn(200)
    assert not th.equal(_actor_vector(model), before)
    assert 0.0 < model.logger.name_to_value["train/kl"] <= model.target_kl


def test_an_error_during_the_search_leaves_the_old_policy() -> None:
    model = _toy(TRPO)

    def accept(trial: Any) -> bool:
        raise RuntimeError("nobody expected this")

    model.plan = lambda region: (region.natural_step(), accept)  # type: ignore[method-assign]
    before = _actor_vector(model)
    with pytest.raises(RuntimeError, match="nobody"):
        model.learn(200)
    assert th.equal(_actor_vector(model), before)


def test_a_trial_says_what_the_candidate_changes() -> None:
    """Improvement and change of the cost surrogate, from the probabilities before and after."""
    model = _toy(CPO, policy_kwargs=SB3_POLICY)
    changes: list[tuple[Any, float, float]] = []
    search = model._line_search

    def spy(region: Any, *args: Any) -> Any:
        batch = region.batch

        def log_prob() -> th.Tensor:
            with th.no_grad():
                distribution = model.policy.get_distribution(batch.observations)
                return distribution.log_prob(batch.actions).double()

        before = log_prob()
        fraction, trial = search(region, *args)
        gain = th.exp(log_prob() - before) - 1.0
        cost = float((gain * batch.cost_advantages[:, 0].double()).mean())
        changes.append((trial, float((gain * batch.advantages.double()).mean()), cost))
        return fraction, trial

    model._line_search = spy  # type: ignore[method-assign]
    model.learn(1000)
    for trial, improvement, cost in changes:
        assert trial.improvement == pytest.approx(improvement, rel=1e-3, abs=1e-6)
        assert trial.cost_change[0] == pytest.approx(cost, rel=1e-3, abs=1e-7)
    assert max(abs(cost) for _, _, cost in changes) > 1e-4


def test_a_steps_promise_is_logged_beside_what_it_brought() -> None:
    env = make_vec_env(lambda: CostPoint(20, hazard=(-1.0, 0.0)), 2, seed=0)
    model = CPO("MlpPolicy", env, n_steps=40, n_critic_updates=1, seed=0, device="cpu")
    logs: list[dict[str, float]] = []
    costs: list[float] = []
    train = model.train

    def spy() -> None:
        train()
        logs.append(dict(model.logger.name_to_value))
        costs.append(model.costs.episode_cost[0])

    model.train = spy
    model.learn(240)
    assert "train/cost_change" not in logs[0]
    for before, now in ((0, 1), (1, 2)):
        promised = 20.0 * logs[before]["train/cost_surrogate"]
        assert logs[now]["train/cost_change_promised"] == pytest.approx(promised, rel=1e-5)
        assert logs[now]["train/cost_change"] == pytest.approx(costs[now] - costs[before])


def test_the_step_respects_the_trust_region_and_improves() -> None:
    model = _toy(TRPO, target_kl=0.01)
    kls, gains = [], []
    search = model._line_search

    def spy(*args: Any) -> Any:
        fraction, trial = search(*args)
        kls.append(trial.kl)
        gains.append(trial.improvement)
        return fraction, trial

    model._line_search = spy  # type: ignore[method-assign]
    model.learn(2000)
    assert len(kls) == 10 and 0.002 < np.mean(kls) and max(kls) <= 0.01
    assert min(gains) >= 0.0 and np.mean(gains) > 0.0


class _Still(TRPO):
    def correct(self, observations: Any, actions: np.ndarray) -> np.ndarray:
        assert len(observations) == len(actions)
        return np.zeros_like(actions)


def test_correct_changes_what_is_executed_and_not_what_is_learnt_from() -> None:
    model = _toy(_Still)
    collect(model, 200)
    assert np.abs(model.rollout_buffer.actions).mean() > 0.3
    assert np.abs(np.diff(model.rollout_buffer.observations[:40], axis=0)).max() < 0.06
    assert type(model.env).__name__ == "DummyVecEnv"


class _Order(TRPO):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.order: list[str] = []
        super().__init__(*args, **kwargs)

    def surrogate(self, batch: Any, ratio: th.Tensor) -> th.Tensor:
        self.order.append("surrogate")
        return -(ratio * batch.advantages).mean()

    def fit(self, batch: Any) -> None:
        self.order.append("fit")
        assert self.costs is not None and len(batch.costs) == 200


def test_surrogate_is_ascended_and_fit_comes_after_the_step() -> None:
    moves = []
    for cls in (TRPO, _Order):
        model = _toy(cls)
        start = _actor_vector(model)
        moves.append(_actor_vector(model.learn(200)) - start)
    a, b = moves
    assert nn.functional.cosine_similarity(a, b, dim=0) < -0.9
    assert model.order[0] == "surrogate" and model.order[-1] == "fit"

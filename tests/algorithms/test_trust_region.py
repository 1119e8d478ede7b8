"""The base algorithm: Fisher products, critics, line search and hooks, and TRPO's reference."""

import copy
from typing import Any

import numpy as np
import pytest
import sb3_contrib
import torch as th
from cost_envs import SB3_POLICY, CostPoint
from gymnasium import spaces
from sb3_contrib.common.utils import conjugate_gradient_solver
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import kl_divergence
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    MultiInputActorCriticPolicy,
)
from torch import nn

from sb3_guard.algorithms import CPO, TRPO, TrustRegion
from sb3_guard.algorithms.common.actor import (
    Actor,
    Before,
    actor_parameters,
    kl,
    value_parameters,
)
from sb3_guard.algorithms.common.batches import CHUNK, chunks
from sb3_guard.algorithms.common.critics import CostCritic, Regression
from sb3_guard.algorithms.common.vectors import assign, flatten
from sb3_guard.algorithms.fast.actor import TanhActor, actor_of, distribution_of, tanh_actor
from sb3_guard.algorithms.fast.mlp import TanhMlp

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


@pytest.mark.parametrize("n", [1, 2, 9, 10, 11, 20, 21, 29, 31])
def test_no_row_is_left_alone(n: int) -> None:
    """Batch normalisation does not learn from one."""
    slices = chunks(n, size=10)
    sizes = [s.stop - s.start for s in slices]
    assert min(sizes) > 1 or n == 1
    assert max(sizes) <= 11
    covered = [row for s in slices for row in range(s.start, s.stop)]
    assert covered == list(range(n))


@pytest.mark.parametrize("n", [50, CHUNK + 1, 2 * CHUNK])
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


@pytest.mark.parametrize("head", HEADS)
def test_score_is_the_gradient_of_the_mean_ratio(head: str) -> None:
    policy = make_policy(HEADS[head])
    observations, actions = make_batch(policy, 40)
    actor = actor_of(policy, observations, actions)
    advantages = th.randn(40)
    log_prob = policy.get_distribution(observations).log_prob(actions)
    objective = (th.exp(log_prob - log_prob.detach()) * advantages).mean()
    expected = flatten(th.autograd.grad(objective, actor.parameters))
    th.testing.assert_close(actor.score(advantages / 40), expected, rtol=1e-4, atol=1e-6)


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
def test_a_written_out_policy_has_autograds_gradient(head: str) -> None:
    policy = make_policy(HEADS[head])
    observations, actions = make_batch(policy, 40)
    parameters, weights = actor_parameters(policy), th.randn(40)
    gradients, methods = [], [distribution_of(policy), policy.get_distribution]
    assert methods[0] != methods[1]
    for method in methods:
        distribution = method(observations)
        objective = th.exp(distribution.log_prob(actions)) @ weights
        gradients.append(flatten(th.autograd.grad(objective, parameters)))
    th.testing.assert_close(*gradients, rtol=1e-4, atol=1e-6)


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


@pytest.mark.parametrize("m", [1, 3])
@pytest.mark.parametrize("batch_size", [None, 64])
def test_regression_by_hand_equals_autograd(m: int, batch_size: int | None) -> None:
    policy = make_policy(HEADS["gaussian"])
    critic = CostCritic(policy, m)
    twin = copy.deepcopy(critic)
    twin.optimizer = th.optim.Adam(twin.parameters(), **policy.optimizer_kwargs, lr=1e-3)
    n = 200 if batch_size else CHUNK + 100
    observations, targets = th.randn(n, 5), th.randn(n, m)
    fast, plain = Regression.of_network(critic), Regression.of_network(twin)
    assert fast.network is not None
    plain.network = None
    losses = []
    for regression in (fast, plain):
        th.manual_seed(1)
        losses.append(regression.fit(observations, targets, 10, batch_size))
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    for a, b in zip(critic.parameters(), twin.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=1e-3, atol=1e-5)


def test_value_regression_moves_the_value_network_alone() -> None:
    policy = make_policy(HEADS["gaussian"])
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    regression = Regression.of_value(policy)
    observations = th.randn(100, 5)
    targets = observations[:, :1] + 1.0
    first = regression.fit(observations, targets, 1)
    last = regression.fit(observations, targets, 300)
    assert last < 0.5 * first
    moved = {n for n, value in policy.state_dict().items() if not th.equal(value, before[n])}
    assert moved == {name for name in before if "value_net" in name}


def test_one_full_batch_step_is_adam_on_the_mean_squared_error() -> None:
    """Ten passes over the whole batch are ten steps of Adam on the mean squared error."""
    policy = make_policy(HEADS["gaussian"])
    twin = copy.deepcopy(policy)
    optimizer = th.optim.Adam(twin.parameters(), lr=1e-3, **policy.optimizer_kwargs)
    observations, targets = th.randn(3000, 5), th.randn(3000, 1)
    Regression.of_value(policy).fit(observations, targets, 10)
    for _ in range(10):
        optimizer.zero_grad()
        nn.functional.mse_loss(twin.predict_values(observations), targets).backward()
        optimizer.step()
    for a, b in zip(policy.parameters(), twin.parameters(), strict=True):
        th.testing.assert_close(a, b, rtol=1e-3, atol=1e-5)


def test_critics_are_fitted_to_discounted_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[tuple[nn.Module, np.ndarray]] = []

    def fit(self: Regression, batch: Any, targets: th.Tensor, *_: Any) -> float:
        fitted.append((self.module, targets.numpy().copy()))
        return 0.0

    monkeypatch.setattr(Regression, "fit", fit)
    model = _toy(CPO).learn(200)
    (policy, values), (critic, costs) = fitted
    assert policy is model.policy and critic is model.cost_critic
    buffer = model.rollout_buffer
    np.testing.assert_array_equal(values, buffer.returns.reshape(-1, 1))
    np.testing.assert_array_equal(costs, buffer.cost_returns)
    assert not np.allclose(buffer.returns.ravel(), buffer.advantages.ravel())


def test_mlp_needs_bias_and_float32() -> None:
    assert TanhMlp.layers([nn.Linear(2, 2), nn.Tanh(), nn.Linear(2, 1)]) is not None
    assert TanhMlp.layers([nn.Linear(2, 2), nn.Tanh()]) is None
    assert TanhMlp.layers([nn.Linear(2, 2, bias=False)]) is None
    assert TanhMlp.layers([nn.Linear(2, 2).double()]) is None


# TRPO against sb3-contrib's


def _reference(cls: type, **kwargs: Any) -> Any:
    """A model with its first rollout collected; the global generators are its own until then."""
    env = make_vec_env(lambda: CostPoint(episode_length=30), 4, seed=3)
    model = cls(
        "MlpPolicy",
        env,
        n_steps=64,
        gamma=0.98,
        gae_lambda=0.9,
        seed=3,
        device="cpu",
        policy_kwargs=SB3_POLICY,
        **kwargs,
    )
    _collect(model, 256)
    return model


class _Stop(Exception):
    pass


def _collect(model: Any, total: int) -> None:
    """Run up to the first update."""

    def stop() -> None:
        raise _Stop

    model.train, train = stop, model.train
    with pytest.raises(_Stop):
        model.learn(total)
    model.train = train


def test_collection_is_bit_exact_with_sb3_contrib() -> None:
    ours, theirs = _reference(TRPO), _reference(sb3_contrib.TRPO, batch_size=64)
    for name in ("observations", "actions", "rewards", "values", "log_probs", "advantages"):
        a, b = getattr(ours.rollout_buffer, name), getattr(theirs.rollout_buffer, name)
        np.testing.assert_array_equal(a, b, err_msg=name)


def test_update_direction_is_that_of_sb3_contrib() -> None:
    """Its KL averages over two action dimensions: half the Fisher matrix and half the damping."""
    ours = _reference(TRPO, cg_max_steps=60, cg_damping=0.1)
    theirs = _reference(sb3_contrib.TRPO, cg_max_steps=60, cg_damping=0.05, batch_size=64)
    region = []
    ours.plan = lambda r: region.append(r) or (th.zeros_like(r.gradient), bool)  # type: ignore
    ours.train()
    x = region[0].solve(region[0].gradient)

    batch = next(theirs.rollout_buffer.get(batch_size=None))
    advantages = (batch.advantages - batch.advantages.mean()) / (batch.advantages.std() + 1e-8)
    with th.no_grad():
        old = copy.copy(theirs.policy.get_distribution(batch.observations))
    distribution = theirs.policy.get_distribution(batch.observations)
    ratio = th.exp(distribution.log_prob(batch.actions) - batch.old_log_prob)
    divergence = kl_divergence(distribution, old).mean()
    parameters, gradient, slope, _ = theirs._compute_actor_grad(
        divergence, (advantages * ratio).mean()
    )

    def product(vector: th.Tensor, retain_graph: bool = True) -> th.Tensor:
        return theirs.hessian_vector_product(parameters, slope, vector, retain_graph)

    expected = conjugate_gradient_solver(product, gradient, max_iter=60) / 2
    actor = region[0].actor
    pieces = dict(zip(_names(ours, actor.parameters), _split(x, actor.parameters), strict=True))
    found = th.cat([pieces[name] for name in _names(theirs, parameters)])
    assert nn.functional.cosine_similarity(found, expected, dim=0) > 1 - 1e-4
    assert found.norm() / expected.norm() == pytest.approx(1.0, rel=1e-2)


def _names(model: Any, parameters: list[th.Tensor]) -> list[str]:
    names = {id(parameter): name for name, parameter in model.policy.named_parameters()}
    return [names[id(parameter)] for parameter in parameters]


def _split(vector: th.Tensor, parameters: list[th.Tensor]) -> tuple[th.Tensor, ...]:
    return vector.split([parameter.numel() for parameter in parameters])


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


class _Reject(TRPO):
    trials = 0
    line_search_max_iter = 7

    def plan(self, region: Any) -> Any:
        return region.natural_step(), self.reject

    def reject(self, trial: Any) -> bool:
        self.trials += 1
        return False


def test_a_rejected_step_leaves_the_policy_as_it_was() -> None:
    model = _toy(_Reject)
    before = _actor_vector(model)
    model.learn(200)
    assert th.equal(_actor_vector(model), before)
    assert model.trials == 7
    assert model.logger.name_to_value["train/line_search_step"] == 0.0
    assert model.logger.name_to_value["train/kl"] == 0.0


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_step_that_is_not_finite_is_not_taken(value: float) -> None:
    model = _toy(TRPO)
    model.plan = lambda region: (th.full_like(region.gradient, value), bool)  # type: ignore
    before = _actor_vector(model)
    model.learn(200)
    assert th.equal(_actor_vector(model), before)


@pytest.mark.parametrize("size", [-200.0, 1e30, -3e38])
def test_a_candidate_that_is_no_distribution_is_rejected(size: float) -> None:
    """exp(log_std) is 0, or the mean is not a number: torch raises at that, training continues."""
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
    _collect(model, 200)
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


@pytest.mark.parametrize("cls", [TRPO, CPO])
def test_timing_is_split(cls: type[TrustRegion]) -> None:
    model = _toy(cls).learn(200)
    assert set(model.timing) == {"collect", "actor", "critics"}
    assert all(seconds > 0.0 for seconds in model.timing.values())


class _StopAt(BaseCallback):
    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        return self.num_timesteps < self.step


def test_a_callback_that_stops_a_rollout_loses_no_cost():
    env = make_vec_env(lambda: CostPoint(episode_length=50), 2)
    model = TRPO("MlpPolicy", env, n_steps=20, n_critic_updates=1, seed=0)
    seen: list[float] = []

    class Count(_StopAt):
        def _on_step(self) -> bool:
            seen.extend(info["cost"] for info in self.locals["infos"])
            return super()._on_step()

    model.learn(200, callback=Count(50))
    assert model.num_timesteps == 50
    assert model.costs.episodes.lengths is not None and model.costs.episodes.lengths.tolist() == [
        25,
        25,
    ]
    assert model.total_cost == pytest.approx(sum(seen))


def test_numbers_that_are_not_finite_stop_the_training():
    class Broken(CostPoint):
        def step(self, action: np.ndarray) -> Any:
            obs, _, *rest = super().step(action)
            return obs, np.nan, *rest

    model = TRPO("MlpPolicy", make_vec_env(Broken, 2), n_steps=20, n_critic_updates=2)
    with pytest.raises(FloatingPointError, match="value_loss is nan after 0 updates: a reward"):
        model.learn(40)
    assert all(bool(th.isfinite(p).all()) for p in actor_parameters(model.policy))


def test_the_horizon_of_the_last_ended_episode_is_remembered():
    env = make_vec_env(lambda: CostPoint(episode_length=30), 1)
    model = CPO("MlpPolicy", env, n_steps=20, n_critic_updates=1, cost_limit=3.0)
    model.learn(40)  # the episode ends in the second rollout
    assert model.costs is not None and model.costs.horizon == 30
    model.learn(10, reset_num_timesteps=False)  # none ends in the third: steps 41 to 60 end one
    model.learn(20, reset_num_timesteps=False)
    assert model.costs.horizon == 30
    rollout = make_vec_env(lambda: CostPoint(episode_length=1000), 1)
    model.set_env(rollout)
    model.learn(20, reset_num_timesteps=False)  # nothing ends
    assert model.costs.horizon == 30
    mean = model.rollout_buffer.costs.mean()
    assert model.costs.violation[0] == pytest.approx(mean - 3.0 / 30)

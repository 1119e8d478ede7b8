"""The file that explains CPO makes CPO's update: from the same rollout and policy."""

import cpo_in_one_file as paper
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_guard import CPO

TOLERANCE = {"rtol": 0.0, "atol": 1e-5}


class Nothing(BaseCallback):
    def _on_step(self):
        return True


@pytest.fixture(scope="module")
def costly():
    """The parameters of a policy that drives too fast, and the cost of its episodes."""
    return collected(limit=1.0)[1]


def collected(limit):
    """CPO with a rollout of the same seed, whatever its limit, and the cost of an episode in it."""
    model = CPO(
        "MlpPolicy",
        paper.Sprint(),
        n_steps=1000,
        cost_limit=limit,
        margin_lr=0.0,
        recovery=1.0,
        batch_size=None,
        n_critic_updates=80,
        seed=0,
        device="cpu",
    )
    with th.no_grad():
        model.policy.action_net.bias.fill_(0.6)
    _, callback = model._setup_learn(1000, Nothing())
    assert model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
    return model, float(model.rollout_buffer.costs.sum() / 20)


def copied(target, sources):
    """Give a module of the paper's file the weights of Stable-Baselines3's modules."""
    weights = [parameter for source in sources for parameter in source.parameters()]
    for mine, theirs in zip(target.parameters(), weights, strict=True):
        mine.data.copy_(theirs)


def vector(module):
    return th.nn.utils.parameters_to_vector(module.parameters()).detach().numpy()


@pytest.mark.parametrize(
    "share", [0.0, 0.97, 1.01, 3.0], ids=["out of reach", "violated", "binding", "inactive"]
)
def test_one_update_is_cpos(share, costly):
    limit = share * costly
    model, cost = collected(limit)
    assert cost == costly > 5.0
    policy, critic, cost_critic = paper.Policy(2, 1), paper.network(2, 1), paper.network(2, 1)

    def theirs():
        extractor = model.policy.mlp_extractor
        actor = [extractor.policy_net, model.policy.action_net]
        return {policy.mean: actor, critic: [extractor.value_net, model.policy.value_net],
                cost_critic: [model.cost_critic.network]}  # fmt: skip

    for module, sources in theirs().items():
        copied(module, sources)
    policy.log_std.data.copy_(model.policy.log_std)
    before = vector(policy)

    batch, buffer = model.rollout_buffer.whole(), model.rollout_buffer
    ends = np.arange(1000) % paper.HORIZON == paper.HORIZON - 1
    unit = float(model.cost_units[0]) or 1.0
    A, R = paper.advantages(buffer.rewards.ravel(), batch.old_values.numpy(), ends, 0.99, 0.97)
    values = batch.cost_returns[:, 0] * 0 + unit * cost_critic(batch.observations)[:, 0].detach()
    A_C, C = paper.advantages(batch.costs[:, 0].numpy(), values.numpy(), ends, 0.99, 0.5)
    for mine, ours in ((A, batch.advantages), (R, batch.returns)):
        np.testing.assert_allclose(mine, ours, rtol=1e-4, atol=1e-4)
    for mine, ours in ((A_C, batch.cost_advantages), (C, batch.cost_returns)):
        np.testing.assert_allclose(mine, ours[:, 0], rtol=1e-4, atol=1e-4)

    advantages = batch.advantages, batch.cost_advantages[:, 0]
    c = (cost - limit) / paper.HORIZON
    paper.update(policy, batch.observations, batch.actions, *advantages, c)
    targets = {critic: batch.returns, cost_critic: batch.cost_returns[:, 0] / unit}
    for module, target in targets.items():
        optimizer = th.optim.Adam(module.parameters(), 1e-3, eps=1e-5)  # SB3's eps
        paper.fit(module, optimizer, batch.observations, target)
    model.train()

    assert np.abs(vector(policy) - before).max() > 1e-3
    np.testing.assert_allclose(policy.log_std.detach(), model.policy.log_std.detach(), **TOLERANCE)
    for module, sources in theirs().items():
        expected = np.concatenate([vector(source) for source in sources])
        np.testing.assert_allclose(vector(module), expected, **TOLERANCE)


@pytest.mark.slow
def test_it_comes_to_its_limit(monkeypatch, capsys):
    monkeypatch.setattr(paper, "UPDATES", 12)
    monkeypatch.setattr(paper, "STEPS", 1000)
    paper.main()
    lines = capsys.readouterr().out.splitlines()
    costs = [float(line.split("cost ")[1].split(",")[0]) for line in lines]
    returns = [float(line.split("return ")[1].split(",")[0]) for line in lines]
    assert len(lines) == 12 and returns[-1] > returns[0] + 20.0
    assert np.mean(costs[-3:]) < 1.5 * paper.LIMIT

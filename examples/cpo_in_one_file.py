"""How does CPO work?

Constrained policy optimisation (Achiam et al., 2017, arXiv 1705.10528) with one limit. Equation
numbers and letters are the paper's, but g, b, c are of an ascent. ``sb3_guard.CPO`` makes the
same update: ``tests/docs/test_cpo_in_one_file.py`` compares them.
"""

import copy

import gymnasium as gym
import numpy as np
import torch as th
from torch import nn
from torch.distributions import Independent, Normal, kl_divergence

LIMIT = 10.0  # d: mean cost of an episode
UPDATES, STEPS, HORIZON = 60, 2000, 50  # updates, steps per update, steps per episode
GAMMA, LAMBDA, COST_LAMBDA = 0.99, 0.97, 0.5  # discount factor, and λ of the advantages
DELTA, DAMPING, CG_STEPS = 0.02, 0.1, 15  # trust region δ, added to the Fisher matrix H, solver
SHRINK, TRIALS = 0.8, 100  # line search
CRITIC_RATE, CRITIC_PASSES = 1e-3, 80


class Sprint(gym.Env):
    """A cart on a line: the reward is its speed v, and a step with v > 1 costs 1."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)  # speed, time left
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)  # force

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.v, self.t = 0.0, 0
        return self.observation(), {}

    def observation(self):
        return np.array([self.v, 1.0 - self.t / HORIZON], np.float32)

    def step(self, action):
        self.v += 0.2 * float(np.clip(action[0], -1.0, 1.0)) - 0.1 * self.v
        self.t += 1
        cost = float(self.v > 1.0)
        return self.observation(), self.v, self.t == HORIZON, False, {"cost": cost}


def network(n_in, n_out):
    return nn.Sequential(
        nn.Linear(n_in, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, n_out)
    )


class Policy(nn.Module):
    """π(a|s): a normal distribution whose mean is a network, with one deviation per dimension."""

    def __init__(self, n_in, n_out):
        super().__init__()
        self.log_std = nn.Parameter(th.full((n_out,), -0.5))
        self.mean = network(n_in, n_out)

    def forward(self, s):
        return Independent(Normal(self.mean(s), self.log_std.exp()), 1)


def advantages(r, v, end, gamma, lam):
    """Generalised advantage estimates and discounted sums to come, of whole episodes, both [N]."""
    advantage, to_come = np.zeros_like(r), np.zeros_like(r)
    next_v = next_advantage = next_sum = 0.0
    for i in reversed(range(len(r))):
        if end[i]:
            next_v = next_advantage = next_sum = 0.0
        next_advantage = r[i] + gamma * next_v - v[i] + gamma * lam * next_advantage
        next_v, next_sum = v[i], r[i] + gamma * next_sum
        advantage[i], to_come[i] = next_advantage, next_sum
    return advantage, to_come


def conjugate_gradient(product, y):
    """x with H x = y, from products with H alone."""
    x, residual, direction = th.zeros_like(y), y.clone(), y.clone()
    square = residual @ residual
    threshold = 1e-10 * square
    for _ in range(CG_STEPS):
        if square <= threshold:
            break
        image = product(direction)
        alpha = square / (direction @ image)
        x, residual = x + alpha * direction, residual - alpha * image
        square, before = residual @ residual, square
        direction = residual + square / before * direction
    return x


def solve(g, b, c, v, w):
    """The step x: most reward gᵀx with c + bᵀx ≤ 0 and ½ xᵀHx ≤ δ (11); v = H⁻¹g, w = H⁻¹b."""
    q, r, s = float(g @ v), float(g @ w), float(b @ w)
    if c > 0 and c**2 / s > 2 * DELTA:  # no point of the trust region satisfies the limit
        return -np.sqrt(2 * DELTA / s) * w, False  # (14): as much less cost as possible
    x = np.sqrt(2 * DELTA / q) * v  # TRPO's step, which may satisfy the limit anyway
    if c + float(b @ x) > 0:
        lam = np.sqrt((q - r**2 / s) / (2 * DELTA - c**2 / s))  # the dual (12), solved: theorem 2
        nu = (r + lam * c) / s
        x = (v - nu * w) / lam  # (13)
    return x, c <= 0


def update(policy, s, a, A, A_C, c):
    """One step of the policy, from N states s, actions a, advantages A, A_C; c = (J_C - d) / T."""
    A, A_C = (A - A.mean()) / (A.std() + 1e-8), A_C - A_C.mean()
    parameters = list(policy.parameters())
    old, old_log_prob = copy.deepcopy(policy)(s), policy(s).log_prob(a).detach()

    def flat(y, create_graph=False):
        gradients = th.autograd.grad(y, parameters, create_graph=create_graph, retain_graph=True)
        return th.cat([gradient.reshape(-1) for gradient in gradients])

    def measure():
        """Reward surrogate, cost surrogate, mean KL(old ‖ new)."""
        new = policy(s)
        ratio = th.exp(new.log_prob(a) - old_log_prob)
        return (ratio * A).mean(), (ratio * A_C).mean(), kl_divergence(old, new).mean()

    reward, cost, kl = measure()
    g, b, slope = flat(reward), flat(cost), flat(kl, create_graph=True)

    def product(x):
        return flat(slope @ x) + DAMPING * x  # H x, since H is the Hessian of the KL

    v, w = conjugate_gradient(product, g), conjugate_gradient(product, b)
    x, feasible = solve(g, b, c, v, w)
    origin = nn.utils.parameters_to_vector(parameters).detach()
    reward, cost, fraction = reward.item(), cost.item(), 1.0
    for _ in range(TRIALS):  # the first point on the way to x that keeps what the step promised
        nn.utils.vector_to_parameters(origin + fraction * x, parameters)
        with th.no_grad():
            new_reward, new_cost, kl = measure()
        cheap = new_cost - cost <= max(-c, 0.0)
        if kl <= DELTA and cheap and (new_reward >= reward or not feasible):
            return
        fraction *= SHRINK
    nn.utils.vector_to_parameters(origin, parameters)


def fit(critic, optimizer, s, target):
    for _ in range(CRITIC_PASSES):
        optimizer.zero_grad()
        ((critic(s)[:, 0] - target) ** 2).mean().backward()
        optimizer.step()


def rollout(env, policy):
    """States, actions, rewards, costs and ends of whole episodes, [N, …] each."""
    rows, s = [], env.reset()[0]
    for _ in range(STEPS):
        with th.no_grad():
            a = policy(th.as_tensor(s)[None]).sample()[0].numpy()
        next_s, reward, end, _, info = env.step(a)
        rows.append((s, a, reward, info["cost"], end))
        s = env.reset()[0] if end else next_s
    return [np.array(column, np.float32) for column in zip(*rows, strict=True)]


def main():
    th.manual_seed(0)
    env, policy = Sprint(), Policy(2, 1)
    critics = [network(2, 1), network(2, 1)]  # V and V_C
    optimizers = [th.optim.Adam(critic.parameters(), CRITIC_RATE) for critic in critics]
    for k in range(UPDATES):
        s, a, reward, cost, end = rollout(env, policy)
        s, a = th.as_tensor(s), th.as_tensor(a)
        values = [critic(s)[:, 0].detach().numpy() for critic in critics]
        A, R = advantages(reward, values[0], end, GAMMA, LAMBDA)
        A_C, C = advantages(cost, values[1], end, GAMMA, COST_LAMBDA)
        J, J_C = reward.sum() / end.sum(), cost.sum() / end.sum()
        update(policy, s, a, th.as_tensor(A), th.as_tensor(A_C), float(J_C - LIMIT) / HORIZON)
        for critic, optimizer, target in zip(critics, optimizers, (R, C), strict=True):
            fit(critic, optimizer, s, th.as_tensor(target))
        print(f"update {k + 1}: return {J:.1f}, cost {J_C:.1f}, limit {LIMIT:g}")


if __name__ == "__main__":
    main()

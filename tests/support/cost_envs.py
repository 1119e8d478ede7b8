"""Small environments with a cost whose answers are known, shared by the tests."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from scipy.optimize import linprog

#: SB3's first policy, which moves more than ours and so meets costs sooner.
SB3_POLICY = {"log_std_init": 0.0, "ortho_init": True}


def told(model: Any, cost: Any, horizon: float = 1.0) -> None:
    """Let an algorithm believe that episodes of so many steps cost so much."""
    model.costs.episode_cost = np.asarray(cost, np.float64)
    model.costs.horizon, model.costs.limits = horizon, model.cost_limits


class LinearCostBandit(gym.Env):
    """One continuous decision: a quadratic reward under a linear cost, solved by projection.

    Reward ``1 - |a - target|²``, cost ``normal · a + offset``; every episode is one step. With
    several offsets there are as many contexts, drawn at random and observed one-hot, which differ
    in nothing else.

    :param target: action of highest reward, shape (n,), inside the box [-1, 1]ⁿ
    :param normal: cost gradient, shape (n,)
    :param offset: cost of the zero action, one number or one per context
    """

    def __init__(
        self,
        target: Sequence[float] = (0.6, 0.4),
        normal: Sequence[float] = (1.0, 1.0),
        offset: float | Sequence[float] = 0.5,
    ) -> None:
        self.target = np.asarray(target, dtype=np.float64)
        self.normal = np.asarray(normal, dtype=np.float64)
        self.offset = offset
        self.contexts = np.eye(np.size(offset), dtype=np.float32)
        self.context = 0
        self.observation_space = spaces.Box(-1.0, 1.0, (np.size(offset),), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, self.target.shape, np.float32)

    def optimum(self, limit: float, context: int = 0) -> np.ndarray:
        """Action of highest reward whose cost is at most ``limit``, shape (n,)."""
        offset = np.ravel(self.offset)[context]
        excess = max(0.0, float(self.normal @ self.target) + offset - limit)
        return self.target - excess / (self.normal @ self.normal) * self.normal

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.context = int(self.np_random.integers(len(self.contexts)))
        return self.contexts[self.context], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        reward = 1.0 - float(np.sum((action - self.target) ** 2))
        cost = float(self.normal @ action + np.ravel(self.offset)[self.context])
        return self.contexts[self.context], reward, True, False, {"cost": cost}


class TwoCostBandit(LinearCostBandit):
    """:class:`LinearCostBandit` with a second cost, ``cost_1 = a_0 + 0.5``.

    Under the limits 0.5 and 0.4 both bind: the best action is (-0.1, 0.1), its reward 0.42.
    """

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        *rest, info = super().step(action)
        return (*rest, {**info, "cost_1": float(action[0]) + 0.5})


class TabularCMDP(gym.Env):
    """A random finite-horizon CMDP whose constrained optimum is a linear program's answer.

    The observation numbers the pair (time, state), so that a stationary policy of the observation
    can be the optimal, time-dependent one. Episodes terminate at the horizon (γ = 1 is exact).

    :param n_states: number of states
    :param n_actions: number of actions
    :param horizon: steps per episode
    :param n_costs: number of cost signals, reported as ``cost``, ``cost_1``, …
    :param seed: seed of transitions, rewards and costs (the world, not the episodes)
    """

    def __init__(
        self,
        n_states: int = 4,
        n_actions: int = 3,
        horizon: int = 5,
        n_costs: int = 1,
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.n_states, self.n_actions, self.horizon = n_states, n_actions, horizon
        self.transitions = rng.dirichlet(np.full(n_states, 0.5), (n_states, n_actions))  # [S, A, S]
        self.rewards = rng.uniform(0.0, 1.0, (n_states, n_actions))  # [S, A]
        # What pays well costs much: the limit must bite.
        noise = rng.uniform(0.0, 1.0, (n_costs, n_states, n_actions))  # [m, S, A]
        self.costs = 0.7 * self.rewards + 0.3 * noise
        self.cost_keys = ("cost", *(f"cost_{i}" for i in range(1, n_costs)))
        self.observation_space = spaces.Discrete(horizon * n_states)
        self.action_space = spaces.Discrete(n_actions)
        self._time = self._state = 0

    def optimum(self, limits: Sequence[float] | None = None) -> tuple[float, np.ndarray]:
        """Best expected return with every expected episode cost at most its limit.

        :param limits: one per cost, or None for the unconstrained optimum
        :return: expected return, and expected episode costs of shape (m,)
        """
        T, S, A = self.horizon, self.n_states, self.n_actions
        # Occupancies x[t, s, a]: flow in = flow out, the first state is 0.
        flow = np.zeros((T, S, T, S, A))
        source = np.zeros((T, S))
        source[0, 0] = 1.0
        for t in range(T):
            for s in range(S):
                flow[t, s, t, s, :] = 1.0
                if t > 0:
                    flow[t, s, t - 1] -= self.transitions[:, :, s]
        costs = np.tile(self.costs[:, None], (1, T, 1, 1)).reshape(len(self.costs), -1)  # [m, TSA]
        answer = linprog(
            -np.tile(self.rewards, (T, 1, 1)).ravel(),
            A_ub=None if limits is None else costs,
            b_ub=None if limits is None else np.asarray(limits, dtype=np.float64),
            A_eq=flow.reshape(T * S, -1),
            b_eq=source.ravel(),
        )
        if not answer.success:
            raise ValueError(f"no policy keeps the limits {limits}: {answer.message}")
        return -float(answer.fun), costs @ answer.x

    def evaluate(self, policy: np.ndarray) -> tuple[float, np.ndarray]:
        """Exact expected return and episode costs of a policy.

        :param policy: action probabilities, shape (horizon · n_states, n_actions)
        """
        policy = policy.reshape(self.horizon, self.n_states, self.n_actions)
        state = np.zeros(self.n_states)
        state[0] = 1.0
        total, costs = 0.0, np.zeros(len(self.costs))
        for probabilities in policy:
            occupancy = state[:, None] * probabilities  # [S, A]
            total += float(np.sum(occupancy * self.rewards))
            costs += np.sum(occupancy * self.costs, axis=(1, 2))
            state = np.einsum("sa,sap->p", occupancy, self.transitions)
        return total, costs

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self._time = self._state = 0
        return 0, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        s, a = self._state, int(action)
        reward = float(self.rewards[s, a])
        info = {
            key: float(cost[s, a]) for key, cost in zip(self.cost_keys, self.costs, strict=True)
        }
        cumulative = np.cumsum(self.transitions[s, a])
        self._state = int(np.searchsorted(cumulative[:-1], self.np_random.random()))
        self._time += 1
        done = self._time == self.horizon
        # The observation that ends an episode is never acted on: any number of the space will do.
        observation = 0 if done else self._time * self.n_states + self._state
        return observation, reward, done, False, info


class Wall(gym.Env):
    """A point on a line that is paid to move right, until a wall makes it cost: state-wise safety.

    Observation: position, metres; action: displacement in tenths of a metre. Reward: metres moved.
    Cost: depth beyond the wall at 0. Episodes start between -1 and -0.5 and are cut after 30 steps,
    in which an unconstrained agent gets 2 metres beyond the wall.
    """

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-2.0, 3.0, (1,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.position = 0.0
        self.steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.position = float(self.np_random.uniform(-1.0, -0.5))
        self.steps = 0
        return np.array([self.position], np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        moved = 0.1 * float(np.clip(action[0], -1.0, 1.0))
        self.position = float(np.clip(self.position + moved, -2.0, 3.0))
        self.steps += 1
        cost = max(0.0, self.position)
        observation = np.array([self.position], np.float32)
        return observation, moved, False, self.steps >= 30, {"cost": cost}


class CostPoint(gym.Env):
    """A point walks to a goal past a hazard: the smallest thing that looks like the suites.

    Observation: position (2) and goal minus position (2), metres. Action: displacement in tenths of
    a metre. Reward: progress towards the goal, metres. Cost: depth inside the hazard, metres.
    Everything an episode depends on is a plain attribute, so the environment can be pickled.

    :param episode_length: steps until the episode is cut
    :param terminate: end episodes by ``terminated`` instead of ``truncated``
    :param cost_scale: multiplies the cost; 0 gives an env that never costs anything
    :param cost_keys: names under which ``info`` reports it; the i-th is (i + 1) times the first
    :param hazard: centre of the hazard; episodes start near (-1, 0)
    """

    goal = np.array([1.0, 0.0])
    hazard_radius = 0.6

    def __init__(
        self,
        episode_length: int = 50,
        terminate: bool = False,
        cost_scale: float = 1.0,
        cost_keys: Sequence[str] = ("cost",),
        hazard: Sequence[float] = (0.0, 0.0),
    ) -> None:
        self.hazard = np.asarray(hazard, dtype=np.float64)
        self.episode_length = episode_length
        self.terminate = terminate
        self.cost_scale = cost_scale
        self.cost_keys = tuple(cost_keys)
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.position = np.zeros(2)
        self.steps = 0

    def _observe(self) -> np.ndarray:
        return np.concatenate([self.position, self.goal - self.position]).astype(np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.position = np.array([-1.0, 0.0]) + self.np_random.uniform(-0.2, 0.2, 2)
        self.steps = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        before = np.linalg.norm(self.goal - self.position)
        drift = self.np_random.normal(0.0, 0.01, 2)
        self.position = np.clip(self.position + 0.1 * np.clip(action, -1, 1) + drift, -2, 2)
        reward = float(before - np.linalg.norm(self.goal - self.position))
        depth = max(0.0, self.hazard_radius - float(np.linalg.norm(self.position - self.hazard)))
        info = {key: (i + 1) * self.cost_scale * depth for i, key in enumerate(self.cost_keys)}
        self.steps += 1
        over = self.steps >= self.episode_length
        return self._observe(), reward, over and self.terminate, over and not self.terminate, info


class RandomCostEnv(gym.Env):
    """Noise in any spaces, for the tests that ask only whether an algorithm runs.

    :param observation_space: sampled again at each step
    :param action_space: any; the reward is the mean of the action
    :param episode_length: steps until the episode is truncated
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        episode_length: int = 20,
    ) -> None:
        self.observation_space = observation_space
        self.action_space = action_space
        self.episode_length = episode_length
        self.steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if not self.action_space.contains(action):
            raise ValueError(f"action {action!r} is not in {self.action_space}")
        self.steps += 1
        cost = float(self.np_random.random() < 0.3)
        over = self.steps >= self.episode_length
        observation = self.observation_space.sample()
        return observation, float(np.mean(action)), False, over, {"cost": cost}


class _Collected(Exception):
    pass


def collect(model: Any, total: int) -> None:
    """Let a model learn up to its first update."""

    def stop() -> None:
        raise _Collected

    model.train, train = stop, model.train
    with pytest.raises(_Collected):
        model.learn(total)
    model.train = train

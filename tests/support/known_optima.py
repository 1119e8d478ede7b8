"""Small CMDPs whose constrained optimum is known, to hold algorithms against.

Each :class:`Problem` states its limits, its best return within them and its best return without.
The optimum comes from one solver (a linear programme over occupation measures, a projection, a
closed form) and is checked by another in ``test_known_optima.py``. Episodes have a fixed length and
many run side by side, so that training takes seconds. ``scripts/known_optima.py`` trains
algorithms on them with their defaults.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from cost_envs import TabularCMDP
from gymnasium import spaces
from scipy.optimize import minimize
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_guard.algorithms import CRPO, CUP, P3O, TRPOFAC, TRPOIPO, TD3Lag


class World:
    """What happens in n independent rows; :class:`Worlds` makes a vectorised environment of it.

    A state is an array of shape (n,) or (n, d). Episodes last ``horizon`` steps and then terminate,
    or are cut by a time limit if ``cut``.
    """

    observation_space: spaces.Space
    action_space: spaces.Space
    horizon: int
    n_costs = 1
    cut = False

    def start(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Draw n first states."""
        raise NotImplementedError

    def observe(self, state: np.ndarray, time: int) -> np.ndarray:
        """Observations, shape (n, …)."""
        raise NotImplementedError

    def move(
        self, state: np.ndarray, time: int, action: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Next states, rewards of shape (n,) and costs of shape (n, m)."""
        raise NotImplementedError


class Bandit(World):
    """One continuous decision: reward 1 - |a - target|², linear costs; solved by projection.

    :param target: the best action, inside the box
    :param normals: cost gradients, shape (m, n)
    :param offsets: costs of the zero action, shape (contexts, m); the context is observed one-hot
    :param scale: of the reward
    """

    horizon = 1

    def __init__(
        self,
        target: Sequence[float],
        normals: Sequence[Sequence[float]],
        offsets: Sequence[Sequence[float]],
        scale: float = 1.0,
    ) -> None:
        self.target, self.normals = np.array(target), np.array(normals)
        self.offsets, self.scale = np.array(offsets), scale
        self.n_costs = len(self.normals)
        self.observation_space = spaces.Box(-1.0, 1.0, (len(self.offsets),), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, self.target.shape, np.float32)

    def reward(self, action: np.ndarray) -> np.ndarray:
        return self.scale * (1.0 - np.sum((action - self.target) ** 2, axis=-1))

    def optimum(self, limits: np.ndarray) -> float:
        """Mean over the contexts of the best reward that keeps the limits in each of them."""

        def best(room: np.ndarray) -> float:
            keeps = {"type": "ineq", "fun": lambda a: room - self.normals @ a}
            start = np.zeros(len(self.target))
            return -minimize(lambda a: -self.reward(a), start, constraints=keeps, tol=1e-10).fun

        return float(np.mean([best(limits - offset) for offset in self.offsets]))

    def start(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return rng.integers(len(self.offsets), size=n)

    def observe(self, state: np.ndarray, time: int) -> np.ndarray:
        return np.eye(len(self.offsets), dtype=np.float32)[state]

    def move(
        self, state: np.ndarray, time: int, action: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return state, self.reward(action), action @ self.normals.T + self.offsets[state]


class Table(World):
    """A :class:`TabularCMDP`; its optimum is the answer of a linear programme.

    :param cmdp: transitions, rewards and costs
    :param reward_scale: multiplies its rewards
    :param cost_scales: multiply its costs, one per cost
    :param cut: observe the state without the time, and cut episodes instead of ending them
    """

    def __init__(
        self,
        cmdp: TabularCMDP,
        reward_scale: float = 1.0,
        cost_scales: Sequence[float] = (1.0,),
        cut: bool = False,
    ) -> None:
        cmdp.rewards = reward_scale * cmdp.rewards
        cmdp.costs = np.reshape(cost_scales, (-1, 1, 1)) * cmdp.costs
        self.cmdp, self.cut, self.horizon = cmdp, cut, cmdp.horizon
        self.n_costs = len(cmdp.costs)
        self.cumulative = cmdp.transitions.cumsum(axis=2)  # [S, A, S]
        self.observation_space = spaces.Discrete(cmdp.n_states) if cut else cmdp.observation_space
        self.action_space = cmdp.action_space

    def start(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return np.zeros(n, dtype=np.int64)

    def observe(self, state: np.ndarray, time: int) -> np.ndarray:
        if self.cut:
            return state
        # No number is left for the observation that ends an episode, and none acts on it.
        return state + self.cmdp.n_states * time if time < self.horizon else np.zeros_like(state)

    def move(
        self, state: np.ndarray, time: int, action: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        reward, costs = self.cmdp.rewards[state, action], self.cmdp.costs[:, state, action].T
        draw = rng.random((len(state), 1))
        after = (self.cumulative[state, action][:, :-1] < draw).sum(axis=1)
        return after, reward, costs


class Street(World):
    """Drive as far as possible in 40 steps, where a zone of one unit costs the speed's square.

    Observation: position, and whether it is in the zone [0, 1). Action: speed, -1 to 1, in tenths
    of a unit per step. Episodes start at -0.95 and are cut.
    """

    horizon, cut = 40, True
    position, size = -0.95, 0.1

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-6.0, 6.0, (2,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def start(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return np.full(n, self.position)

    def observe(self, state: np.ndarray, time: int) -> np.ndarray:
        return np.stack([state, self.inside(state)], axis=1).astype(np.float32)

    @staticmethod
    def inside(state: np.ndarray) -> np.ndarray:
        return (state >= 0.0) & (state < 1.0)

    def move(
        self, state: np.ndarray, time: int, action: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        speed = np.clip(action[:, 0].astype(np.float64), -1.0, 1.0)
        return state + self.size * speed, speed, (speed**2 * self.inside(state))[:, None]

    def optimum(self, limit: float) -> float:
        """Best return of an episode cost of at most ``limit``.

        Ten steps to the zone's edge, one at full speed into it, the other 0.9 units in k equal
        steps, which cost k (9/k)² = 81/k, and the rest at full speed.
        """
        return 9.5 + 1.0 + 9.0 + (self.horizon - 11.0 - 81.0 / limit)


class WallWorld(World):
    """Paid to move right, which costs the depth beyond a wall at 0: a limit on the worst step.

    Observation: position; action: displacement in tenths. Episodes start at -1 to -0.5 and are cut
    after 30 steps; whoever stays within a depth w gets w + 0.75 on average.
    """

    horizon, cut = 30, True

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-2.0, 3.0, (1,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def start(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return rng.uniform(-1.0, -0.5, n)

    def observe(self, state: np.ndarray, time: int) -> np.ndarray:
        return state[:, None].astype(np.float32)

    def move(
        self, state: np.ndarray, time: int, action: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        moved = 0.1 * np.clip(action[:, 0].astype(np.float64), -1.0, 1.0)
        return state + moved, moved, np.maximum(0.0, state + moved)[:, None]


class Brink(World):
    """A cart that is paid to move right and must stop before a brink at 0: a limit of 0.

    Observation: position and speed; action: acceleration. Each step costs the depth beyond 0.
    Episodes start at rest at -1 to -0.6, so that whoever stops at the brink gets 0.8 on average;
    at full speed the cart needs its last 0.2 units to stop.
    """

    horizon = 40
    top, push = 0.1, 0.025  # units a step, and a step squared

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-4.0, 4.0, (2,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def start(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return np.stack([rng.uniform(-1.0, -0.6, n), np.zeros(n)], axis=1)

    def observe(self, state: np.ndarray, time: int) -> np.ndarray:
        return np.stack([state[:, 0], 10.0 * state[:, 1]], axis=1).astype(np.float32)

    def move(
        self, state: np.ndarray, time: int, action: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pushed = state[:, 1] + self.push * np.clip(action[:, 0].astype(np.float64), -1.0, 1.0)
        speed = np.clip(pushed, -self.top, self.top)
        position = state[:, 0] + speed
        return np.stack([position, speed], axis=1), speed, np.maximum(0.0, position)[:, None]


class Worlds(VecEnv):
    """n rows of a world as a vectorised environment whose episodes report their sums.

    ``info["episode"]`` has, beside SB3's return and length, the ``costs`` of the episode and the
    ``worst`` step's, each of shape (m,), and the ``first`` state.

    :param scale: multiplies every cost
    """

    render_mode = None

    def __init__(self, world: World, n_envs: int, seed: int = 0, scale: float = 1.0) -> None:
        super().__init__(n_envs, world.observation_space, world.action_space)
        self.world, self.scale = world, scale
        self.rng = np.random.default_rng(seed)
        self.cost_keys = ("cost", *(f"cost_{i}" for i in range(1, world.n_costs)))

    def reset(self) -> Any:
        self.time = 0
        self.state = self.first = self.world.start(self.rng, self.num_envs)
        self.returns = np.zeros(self.num_envs)
        self.costs = np.zeros((self.num_envs, self.world.n_costs))
        self.worst = np.full((self.num_envs, self.world.n_costs), -np.inf)
        return self.world.observe(self.state, 0)

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> Any:
        world = self.world
        self.state, rewards, costs = world.move(self.state, self.time, self.actions, self.rng)
        costs = self.scale * costs
        self.time += 1
        self.returns += rewards
        self.costs += costs
        self.worst = np.maximum(self.worst, costs)
        infos: list[dict[str, Any]] = [
            dict(zip(self.cost_keys, row, strict=True)) for row in costs.tolist()
        ]
        observation = world.observe(self.state, self.time)
        over = self.time == world.horizon
        if over:
            for i, info in enumerate(infos):
                info["terminal_observation"] = observation[i]
                info["TimeLimit.truncated"] = world.cut
                info["episode"] = {
                    "r": float(self.returns[i]),
                    "l": world.horizon,
                    "t": 0.0,
                    "costs": self.costs[i],
                    "worst": self.worst[i],
                    "first": self.first[i],
                }
            observation = self.reset()
        return observation, rewards.astype(np.float32), np.full(self.num_envs, over), infos

    def close(self) -> None:
        pass

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        raise AttributeError(method_name)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


@dataclass(frozen=True)
class Problem:
    """A world, its limits, and what is known about it.

    :param world: makes the world
    :param limits: d, one per cost: of an episode's cost, or of its worst step if ``statewise``
    :param best: highest return within the limits
    :param unconstrained: highest return without limits
    :param n_envs: rows that are trained on
    :param n_steps: steps of each per update
    :param updates: until the policy is judged
    :param statewise: whether the limits are those of the worst step
    :param by_context: whether they hold from each first state, not on the average over them
    :param unit: what costs are given in where the limit is 0
    """

    world: Callable[[], World]
    limits: tuple[float, ...]
    best: float
    unconstrained: float
    n_envs: int = 16
    n_steps: int = 16
    updates: int = 60
    statewise: bool = False
    by_context: bool = False
    unit: float = 1.0

    def make_env(self, seed: int = 0, scale: float = 1.0) -> Worlds:
        """The environment; ``scale`` multiplies the costs, whose limits go with them."""
        return Worlds(self.world(), self.n_envs, seed, scale)

    @property
    def total_timesteps(self) -> int:
        return self.updates * self.n_envs * self.n_steps


class Outcomes(BaseCallback):
    """Keeps what the last episodes of a training cost and returned, by the policy that explores.

    :param total_timesteps: of the training
    :param share: of the training that counts
    """

    def __init__(self, total_timesteps: int, share: float = 0.2) -> None:
        super().__init__()
        self.begin = (1.0 - share) * total_timesteps
        self.returns: list[float] = []
        self.costs: list[np.ndarray] = []
        self.worst: list[np.ndarray] = []
        self.firsts: list[Any] = []

    def _on_step(self) -> bool:
        if self.num_timesteps > self.begin:
            for info in self.locals["infos"]:
                if episode := info.get("episode"):
                    self.returns.append(episode["r"])
                    self.costs.append(episode["costs"])
                    self.worst.append(episode["worst"])
                    self.firsts.append(episode["first"])
        return True


#: From here on rewards are normalised for SB3's PPO and its kin: they clip the gradients of policy
#: and critic together, and the critic's grow with the square of the rewards.
LARGE = 50.0


@dataclass(frozen=True)
class Outcome:
    """Return as a share of the constrained optimum, and costs as shares of their limits, (m,).

    Where the limit is 0, costs are shares of what the unconstrained optimum costs.
    """

    value: float
    cost: np.ndarray

    @property
    def good(self) -> bool:
        """At least 90 % of the optimum, and costs within 0.85 and 1.05 of the limits that bind.

        A limit beside another that binds may be slack, so that only the largest is held from below.
        """
        return self.value >= 0.9 and 0.85 <= self.cost.max() <= 1.05


def solve(cls: type, problem: Problem, seed: int, scale: float = 1.0, **kwargs: Any) -> Outcome:
    """Train with the defaults of an algorithm and judge the last fifth of the training.

    :param cls: class of the algorithm
    :param seed: of the algorithm and the environment
    :param scale: multiplies costs and limits
    :param kwargs: what is not to be the default
    """
    env = problem.make_env(seed, scale)
    limits = scale * np.array(problem.limits)
    bound = limits
    if problem.statewise and cls.limit_on == "sum":  # the same limit for each step of an episode
        bound = limits * env.world.horizon
    outcomes = Outcomes(problem.total_timesteps)
    settings = {"seed": seed, "device": "cpu", **kwargs}
    made: VecEnv = env
    if issubclass(cls, PPO) and problem.unconstrained >= LARGE:
        made = VecNormalize(env, norm_obs=False)
    if issubclass(cls, OnPolicyAlgorithm):
        settings.setdefault("n_steps", problem.n_steps)
    cls("MlpPolicy", made, cost_limit=bound.tolist(), cost_keys=env.cost_keys, **settings).learn(
        problem.total_timesteps, callback=outcomes
    )
    each = np.array(outcomes.worst if problem.statewise else outcomes.costs)  # [episodes, m]
    costs = each.mean(axis=0)
    if problem.by_context:
        firsts = np.array(outcomes.firsts)
        costs = np.max([each[firsts == first].mean(axis=0) for first in set(firsts)], axis=0)
    units = np.where(limits == 0.0, scale * problem.unit, limits)
    return Outcome(float(np.mean(outcomes.returns)) / problem.best, costs / units)


def budget(cls: type, problem: Problem) -> Problem:
    """The problem with as many steps as an algorithm's defaults need: twice its updates.

    First-order algorithms get four times, since SB3's rate of 3e-4 moves a log standard deviation
    by no more than that in a gradient step. So does CRPO: at the limit every other step undoes what
    the last one did to the cost, and little of a step is left to narrow the policy; TRPO-IPO, whose
    steps are cut where they would cross the limit; and TRPO-FAC, whose multipliers are networks
    that have to be learnt. CUP and P3O, first-order ones whose updates go to and fro as CRPO's do,
    get eight times. Off-policy ones take 8,000 steps of one environment, each with a gradient step,
    SAC- and TQC-Lagrangian 15,000: their temperature falls slowly at SB3's rate.
    """
    if issubclass(cls, OnPolicyAlgorithm):
        slow = issubclass(cls, PPO | CRPO | TRPOIPO | TRPOFAC)
        times = 8 if issubclass(cls, CUP | P3O) else 4 if slow else 2
        return replace(problem, updates=times * problem.updates)
    return replace(problem, n_envs=1, n_steps=1, updates=8_000 if cls is TD3Lag else 15_000)


def _table(
    shares: Sequence[float],
    n_states: int,
    n_actions: int,
    horizon: int,
    seed: int,
    reward_scale: float = 1.0,
    cost_scales: Sequence[float] = (1.0,),
    cut: bool = False,
    **kwargs: Any,
) -> Problem:
    """A table whose limits are shares of what the unconstrained optimum costs."""

    def world() -> Table:
        cmdp = TabularCMDP(n_states, n_actions, horizon, len(cost_scales), seed)
        return Table(cmdp, reward_scale, cost_scales, cut)

    cmdp = world().cmdp
    unconstrained, costs = cmdp.optimum()
    limits = costs * shares
    best, _ = cmdp.optimum(limits)
    return Problem(world, tuple(limits.tolist()), best, unconstrained, **kwargs)


def _bandit(limits: tuple[float, ...], scale: float = 1.0, **kwargs: Any) -> Problem:
    def world() -> Bandit:
        return Bandit(scale=scale, **kwargs)

    best, contexts = world().optimum(np.array(limits)), len(kwargs["offsets"])
    return Problem(world, limits, best, scale, by_context=contexts > 1)


@cache
def problems() -> dict[str, Problem]:
    """The problems by name."""
    return {
        "bandit": _bandit((0.5,), target=(0.6, 0.4), normals=[[1, 1]], offsets=[[0.5]]),
        "bandit-2": _bandit(
            (0.5, 0.4),
            target=(0.6, 0.4),
            normals=[[1, 1], [1, 0]],
            offsets=[[0.5, 0.5]],
            scale=100.0,
        ),
        "table": _table([0.75], 4, 3, 5, 0, n_steps=25),
        "table-2": _table([0.8, 0.85], 5, 4, 12, 3, 10.0, (1.0, 30.0), n_steps=36),
        "table-3": _table([0.8, 0.8, 0.85], 4, 3, 8, 2, 1.0, (1.0, 0.1, 10.0), n_steps=32),
        "chain": _table([0.7], 5, 3, 40, 1, cut=True, n_steps=40),
        "street": Problem(
            Street,
            (5.0,),
            Street().optimum(5.0),
            40.0,
            n_steps=40,
        ),
        "contexts": _bandit((1.0,), target=(0.6, 0.4), normals=[[1, 1]], offsets=[[1.0], [-1.0]]),
        "wall": Problem(WallWorld, (0.5,), 1.25, 3.0, n_steps=60, statewise=True),
        "brink": Problem(Brink, (0.0,), 0.8, 3.85, n_steps=40, unit=48.0),
    }

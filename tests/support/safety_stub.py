"""A stub of Safety-Gymnasium: its interface, its time limit and its registry."""

import sys
import types

import gymnasium as gym
import numpy as np
from cost_envs import CostPoint
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec


class Builder(gym.Env):
    """Safety-Gymnasium's interface: six values, double precision, ``cost_<kind>``, ``cost_sum``."""

    def __init__(self, task_id, config=None, render_mode=None, width=256, height=256):
        self.task_id, self.config, self.render_mode = task_id, config, render_mode
        self.world = CostPoint(episode_length=10**9)
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        obs, _ = self.world.reset(seed=seed)
        return obs.astype(np.float64), {}

    def step(self, action):
        obs, reward, *_, info = self.world.step(np.array(action))
        cost = info["cost"]
        info = {"cost_hazards": cost, "cost_vases_contact": 0.0, "cost_sum": cost}
        if reward > 0.09:
            info["goal_met"] = True
        return obs.astype(np.float64), np.float64(reward), cost, False, False, info


class SafeTimeLimit(gym.wrappers.TimeLimit):
    def step(self, action):
        *first, terminated, truncated, info = self.env.step(action)
        self._elapsed_steps += 1
        return *first, terminated, truncated or self._elapsed_steps >= self._max_episode_steps, info


class Converted(gym.Wrapper):
    def step(self, action):
        obs, reward, cost, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated, truncated, {**info, "cost": cost}


def make(id, max_episode_steps=None, disable_env_checker=None, **kwargs):
    """What ``safety_gymnasium.make`` does, its assertion included."""
    assert id in safe_registry, f"Environment {id} is not registered in safety-gymnasium."
    spec = gym.registry[id]
    env = Builder(**{**spec.kwargs, **kwargs})
    env.spec = EnvSpec(spec.id, spec.entry_point, kwargs=spec.kwargs, order_enforce=False)
    return SafeTimeLimit(env, max_episode_steps or spec.max_episode_steps)


safe_registry = {"SafetyPointGoal9-v0"}


def install(monkeypatch):
    """The stub of Safety-Gymnasium: importable, its ids in Gymnasium's registry."""
    stub = types.ModuleType("safety_gymnasium")
    stub.make = make
    conversion = types.ModuleType("safety_gymnasium.wrappers.gymnasium_conversion")
    conversion.make_gymnasium_environment = lambda env_id: Converted(make("SafetyPointGoal9-v0"))
    monkeypatch.setitem(sys.modules, "safety_gymnasium", stub)
    monkeypatch.setitem(sys.modules, "safety_gymnasium.wrappers", types.ModuleType("wrappers"))
    monkeypatch.setitem(sys.modules, conversion.__name__, conversion)
    for name, entry_point, kwargs in (
        ("SafetyPointGoal9-v0", "safety_gymnasium.builder:Builder", {"task_id": "x", "config": {}}),
        (
            "SafetyPointGoal9Gymnasium-v0",
            f"{conversion.__name__}:make_gymnasium_environment",
            {"env_id": "x"},
        ),
    ):
        spec = EnvSpec(name, entry_point, max_episode_steps=40, kwargs=kwargs)
        monkeypatch.setitem(gym.registry, name, spec)

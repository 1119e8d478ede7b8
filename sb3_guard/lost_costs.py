"""Environments that lose costs: refused before an agent learns from what is left."""

import gymnasium as gym
from gymnasium import wrappers
from stable_baselines3.common.atari_wrappers import MaxAndSkipEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_guard.checks import ContractError

# They take several steps for one of the agent, and tell the cost of the last one alone. Gymnasium
# 0.29, which the original Safety-Gymnasium needs, has the first one only.
REPEATING: tuple[type, ...] = (
    MaxAndSkipEnv,
    *(
        getattr(wrappers, name)
        for name in ("AtariPreprocessing", "MaxAndSkipObservation", "RepeatAction")
        if hasattr(wrappers, name)
    ),
)


def refuse_lost_costs(venv: VecEnv | None) -> None:
    """
    :param venv: its environments are looked at where they are in this process
    :raises ContractError: a wrapper of Gymnasium or SB3 takes several steps for one; what a
        wrapper of the user does, and tells outside of it, is the user's
    """
    others = "gymnasium.", "stable_baselines3.", "sb3_guard.zoo."
    inner = venv and venv.unwrapped
    for env in inner.envs if isinstance(inner, DummyVecEnv) else ():
        while isinstance(env, gym.Wrapper) and type(env).__module__.startswith(others):
            if isinstance(env, REPEATING):
                raise ContractError(
                    f"{type(env).__name__} takes several steps and tells the cost of the last one "
                    "alone; costs must add up, as rewards do: see docs/your_environment.md"
                )
            env = env.env

"""Advantages and returns of a rollout that was cut into episodes: two backward recursions.

Arrays lead with time and environment, ``[T, n]`` or ``[T, n, m]`` for m cost signals. A time-out is
the caller's to handle: it adds γ V(terminal observation) to that step's reward or cost beforehand.
"""

import numpy as np


def _continues(episode_starts: np.ndarray, dones: np.ndarray, ndim: int) -> np.ndarray:
    """1 where step t + 1 belongs to the episode of step t, shape [T, n] or [T, n, 1]."""
    continues = 1.0 - np.concatenate([episode_starts[1:], dones[None]]).astype(np.float32)
    return continues.reshape(continues.shape + (1,) * (ndim - 2))


def gae(
    rewards: np.ndarray,
    values: np.ndarray,
    episode_starts: np.ndarray,
    last_values: np.ndarray,
    dones: np.ndarray,
    gamma: float,
    gae_lambda: float,
) -> np.ndarray:
    """Generalised advantage estimates (Schulman et al., 2016, equation 16).

    :param rewards: rewards or costs, with the time-out bootstraps, shape [T, n, …]
    :param values: critic's values of the observations, same shape
    :param episode_starts: whether step t is the first of its episode, shape [T, n]
    :param last_values: values of the observations after the last step, shape [n, …]
    :param dones: whether the last step ended an episode, shape [n]
    :param gamma: discount factor
    :param gae_lambda: 0 for one-step errors, 1 for returns minus values
    :return: advantages, shape [T, n, …]
    """
    continues = _continues(episode_starts, dones, rewards.ndim)
    next_values = np.concatenate([values[1:], last_values[None]])
    errors = rewards + gamma * continues * next_values - values
    advantages = np.empty_like(errors)
    running = np.zeros_like(errors[0])
    for t in reversed(range(len(errors))):
        running = errors[t] + gamma * gae_lambda * continues[t] * running
        advantages[t] = running
    return advantages


def discounted_returns(
    rewards: np.ndarray,
    episode_starts: np.ndarray,
    last_values: np.ndarray,
    dones: np.ndarray,
    gamma: float,
) -> np.ndarray:
    """Discounted rewards-to-go, bootstrapped where the rollout cuts an episode.

    Parameters as in :func:`gae`; these are the critics' targets.

    :return: returns, shape [T, n, …]
    """
    continues = _continues(episode_starts, dones, rewards.ndim)
    returns = np.empty_like(rewards)
    running = last_values
    for t in reversed(range(len(rewards))):
        running = rewards[t] + gamma * continues[t] * running
        returns[t] = running
    return returns

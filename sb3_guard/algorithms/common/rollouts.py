"""Rollouts with costs, for any on-policy algorithm of Stable-Baselines3.

While SB3 collects, the costs of each step go into the rollout buffer. When the rollout is full, the
cost critic values its states, cost advantages are estimated, and so are J_C, the length of an
episode and the violations of the limits.
"""

import time
from contextlib import nullcontext
from typing import Any, ClassVar, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import obs_as_tensor, update_learning_rate
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn, VecEnvWrapper

from sb3_guard.algorithms.common.advantage import discounted_returns
from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.batches import rows
from sb3_guard.algorithms.common.buffers import CostDictRolloutBuffer, CostRolloutBuffer
from sb3_guard.algorithms.common.constrained import Constrained
from sb3_guard.algorithms.common.costs import discounted_limit, inverse
from sb3_guard.algorithms.common.critics import StateNetwork, regress
from sb3_guard.algorithms.fast.threads import one_thread

SMALL = 500_000  # weights of a policy that acts on one thread
# First policies that hardly move: robots learn from them twice as fast as from SB3's, orthogonal
# with σ = 1 (SafetyPointGoal1).
CALM = {"log_std_init": -0.5, "ortho_init": False}


class _CorrectedEnv(VecEnvWrapper):
    """Executes corrected actions during one rollout; the algorithm's own env stays unwrapped."""

    def __init__(self, venv: VecEnv, algorithm: "CostRollouts") -> None:
        super().__init__(venv)
        self.algorithm = algorithm

    def step_async(self, actions: np.ndarray) -> None:
        executed = self.algorithm.correct(self.algorithm._last_obs, actions)
        # SB3 adds the transition, with the sampled action, after the step.
        buffer = self.algorithm.rollout_buffer
        buffer.executed_actions[buffer.pos] = executed.reshape(len(executed), -1)
        self.venv.step_async(executed)

    def step_wait(self) -> VecEnvStepReturn:
        return self.venv.step_wait()

    def reset(self) -> Any:
        return self.venv.reset()


class CostRollouts(Constrained, OnPolicyAlgorithm):
    """Costs, cost advantages and a cost critic for an on-policy algorithm.

    ``class SafePPO(CostRollouts, PPO)`` finds them in ``rollout_buffer`` when ``train`` is called,
    and ends its ``train`` with :meth:`fit_cost_critic`. The critic is not part of the policy: the
    policy's optimizer and its gradient clipping never see it.

    :param cost_gamma: discount factor of the costs; None for ``gamma``
    :param cost_gae_lambda: bias-variance trade-off of the cost advantages; None for ``gae_lambda``
    :param policy_kwargs: arguments of the policy, added to the algorithm's ``policy_defaults``
    """

    #: What tuning searches, as in a file for ``tune --search-space``; subclasses add theirs, or
    #: None for what it is not to search.
    search_space: ClassVar[dict[str, Any]] = {
        "n_envs": [10, 20, 30],
        "gamma": [0.95, 0.97, 0.98, 0.99, 0.995, 0.999],
        "gae_lambda": {"low": 0.9, "high": 0.99},
        "cost_gae_lambda": [None, 0.0, 0.5, 0.9, 0.97],  # None: that of the reward
        "learning_rate": {"low": 3e-5, "high": 3e-3, "log": True},
        "policy_kwargs.net_arch": [{"pi": [n, n], "vf": [n, n]} for n in (64, 256)],
        "policy_kwargs.log_std_init": {"low": -1.5, "high": 0.0},
    }
    # SB3's buffers have no room for costs.
    fixed_arguments: ClassVar[frozenset[str]] = frozenset(
        {"rollout_buffer_class", "rollout_buffer_kwargs"}
    )
    #: Whether a critic of the costs is built and trained.
    uses_cost_critic: bool = True
    #: What critics learn: SB3's λ-returns, or discounted rewards- and costs-to-go.
    returns: ClassVar[Literal["lambda", "discounted"]] = "lambda"

    cost_gamma: float | None = hyperparameter(None, high=1.0, ends="[]")
    cost_gae_lambda: float | None = hyperparameter(None, high=1.0, ends="[]")

    rollout_buffer: CostRolloutBuffer | CostDictRolloutBuffer

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # Shuffles the cost critic's batches: it takes no numbers from anybody else's stream.
        self.cost_rng: np.random.Generator = None  # type: ignore[assignment]
        # What the cost critic measures costs in, [m]; 0 until a rollout has any: before it
        # has met a cost, what it says is noise, which is not to move the policy.
        self.cost_units: np.ndarray | None = None
        # (step, env, observation) of every episode cut by a time limit
        self._timeouts: list[tuple[int, int, Any]] = []
        own_policy = kwargs.pop("policy_kwargs", None) or {}
        super().__init__(*args, policy_kwargs={**self.policy_defaults, **own_policy}, **kwargs)
        if hasattr(self, "policy"):  # `load` makes it later, and it has learnt
            self._check_reach()

    # Construction and saving

    def _check_reach(self) -> None:
        """Warn of a box that a first policy, a Gaussian around 0, hardly ever acts in."""
        box, policy = self.action_space, self.policy
        if not isinstance(box, spaces.Box) or policy.squash_output:
            return
        deviation = np.exp(policy.log_std_init)
        far = np.maximum(-box.low, box.high) > 10.0 * deviation
        if np.any(far | (box.low > 0.0) | (box.high < 0.0)):
            self._warn_once(
                "actions",
                f"a first policy acts around 0 with a standard deviation of {deviation:.2g}, and "
                f"the actions go from {box.low.min():g} to {box.high.max():g}: wrap the "
                "environment in gymnasium.wrappers.RescaleAction(env, -1.0, 1.0)",
            )

    def _choose_buffer(self) -> None:
        dictionary = isinstance(self.observation_space, spaces.Dict)
        self.rollout_buffer_class = CostDictRolloutBuffer if dictionary else CostRolloutBuffer
        gamma, gae_lambda = self.cost_gamma, self.cost_gae_lambda
        self.rollout_buffer_kwargs = {
            "returns": self.returns,
            "n_costs": len(self.cost_keys),
            "cost_gamma": self.gamma if gamma is None else gamma,
            "cost_gae_lambda": self.gae_lambda if gae_lambda is None else gae_lambda,
            "keep_executed": self._corrects,
        }

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.cost_rng is None:
            self.cost_rng = np.random.default_rng(self.seed)
        if self.uses_cost_critic:
            # Its first weights take nothing from the stream that actions are sampled from.
            with th.random.fork_rng(devices=[]):  # V_c(s), an output per cost
                self.cost_critic = StateNetwork(self.policy, len(self.cost_keys))

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_timeouts"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        if self.uses_cost_critic:
            state_dicts = [*state_dicts, "cost_critic", "cost_critic.optimizer"]
        return state_dicts, tensors

    # Collecting

    @property
    def _corrects(self) -> bool:
        return type(self).correct is not CostRollouts.correct

    def correct(self, observations: Any, actions: np.ndarray) -> np.ndarray:
        """The actions to execute in place of the sampled ones, both shaped (n_envs, …)."""
        return actions

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        started = time.perf_counter()
        self.costs.forget()
        self._timeouts = []
        # the layers of a small network take less time than threads that meet
        weights = sum(parameter.numel() for parameter in self.policy.parameters())
        alone = self.device.type == "cpu" and weights <= SMALL
        with one_thread() if alone else nullcontext():
            full = super().collect_rollouts(
                _CorrectedEnv(env, self) if self._corrects else env,
                callback,
                rollout_buffer,
                n_rollout_steps,
            )
        if full:
            self._estimate_costs(self.rollout_buffer.costs.mean(axis=(0, 1)))
            self.value_rollout()
        else:
            self._count_last_step(callback)
        self.timing["collect"] = time.perf_counter() - started
        return full

    def discounted_limits(self) -> np.ndarray:
        """The limits as those of the discounted costs-to-go of the last rollout, shape (m,)."""
        gamma = self.rollout_buffer.cost_gamma
        return discounted_limit(self.costs.limits, self.costs.horizon, gamma, bool(self._timeouts))

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: np.ndarray | None = None
    ) -> None:
        before = self.costs.last
        super()._update_info_buffer(infos, dones)
        step = self.rollout_buffer.pos
        self.rollout_buffer.costs[step] = self.step_costs
        self.rollout_buffer.previous_costs[step] = before
        for i, info in enumerate(infos):
            if info.get("TimeLimit.truncated", False) and (
                info.get("terminal_observation") is not None
            ):
                self._timeouts.append((step, i, info["terminal_observation"]))

    @th.no_grad()
    def value_rollout(self) -> None:
        """Value the rollout's states and finish the cost half of the buffer."""
        if not self.uses_cost_critic:
            return
        buffer, units = self.rollout_buffer, self._choose_cost_units()
        values = self.cost_critic.predict(buffer.observations_by_time(self.device))
        buffer.cost_values = units * values.cpu().numpy().reshape(buffer.costs.shape)
        # Undiscounted, the cost of an episode is a finite sum: what might come after its time is no
        # part of it, and a critic that is fitted to its own values has no fixed point.
        for step, i, observation in self._timeouts if buffer.cost_gamma < 1.0 else ():
            terminal, _ = self.policy.obs_to_tensor(observation)
            buffer.cost_bootstraps[step, i] = (
                buffer.cost_gamma * units * self.cost_critic(terminal)[0].cpu().numpy()
            )
        assert self._last_obs is not None and self._last_episode_starts is not None
        last = self.cost_critic(obs_as_tensor(self._last_obs, self.device)).cpu().numpy()
        buffer.compute_cost_returns_and_advantage(units * last, self._last_episode_starts)

    def _choose_cost_units(self) -> np.ndarray:
        """What networks measure costs in, shape (m,), float32, from a rollout just filled.

        The root mean square of what they learn, discounted costs-to-go, in the first rollout that
        has any cost, so that it does not depend on the unit of cost.
        """
        buffer = self.rollout_buffer
        if self.cost_units is None:
            self.cost_units = np.zeros(buffer.n_costs, np.float32)
        if not self.cost_units.all():
            assert self._last_episode_starts is not None
            ahead = discounted_returns(
                buffer.costs,
                buffer.episode_starts,
                np.zeros_like(buffer.costs[0]),
                self._last_episode_starts,
                buffer.cost_gamma,
            )
            sizes = np.sqrt(np.mean(np.square(ahead, dtype=np.float64), axis=(0, 1)))
            self.cost_units = np.where(self.cost_units, self.cost_units, sizes).astype(np.float32)
        return self.cost_units

    # Learning

    def advantage_unit(self) -> float:
        """One standard deviation of the reward advantages as the policy learns from them.

        1 with ``normalize_advantage``, or where they are all alike.
        """
        if getattr(self, "normalize_advantage", False):
            return 1.0
        return float(self.rollout_buffer.advantages.std()) or 1.0

    def centre_costs(self) -> np.ndarray:
        """Centre the buffer's cost advantages.

        :return: their inverse standard deviations, 0 where they are all alike, shape (m,)
        """
        buffer = self.rollout_buffer
        deviation = buffer.cost_advantages.std(axis=(0, 1), dtype=np.float64)
        buffer.cost_advantages = buffer.cost_advantages - buffer.cost_advantages.mean(axis=(0, 1))
        return inverse(deviation)

    def _taken(self, actions: th.Tensor) -> th.Tensor:
        """Actions of the buffer as the policy's distribution takes them."""
        return (
            actions.long().flatten() if isinstance(self.action_space, spaces.Discrete) else actions
        )

    def fit_cost_critic(self, n_epochs: int | None = None) -> None:
        """Fit the cost critic to the rollout's cost returns, with the algorithm's learning rate.

        It draws from no generator but ``cost_rng``.

        :param n_epochs: passes over the rollout; None for the algorithm's own ``n_epochs``
        :raises FloatingPointError: its loss is not finite
        """
        update_learning_rate(
            self.cost_critic.optimizer, self.lr_schedule(self._current_progress_remaining)
        )
        batch = self.rollout_buffer.whole()
        assert self.cost_units is not None
        units = np.where(self.cost_units, self.cost_units, np.float32(1.0))
        learnt = self.critic_rows(batch.cost_returns)
        targets = (batch.cost_returns / th.as_tensor(units).to(batch.cost_returns))[learnt]
        loss = regress(
            self.cost_critic,
            self.cost_critic.parameters(),
            self.cost_critic.optimizer,
            rows(batch.observations, learnt),
            targets,
            getattr(self, "n_epochs", 1) if n_epochs is None else n_epochs,
            self.critic_batch(len(targets)),
            self.cost_rng,
        )
        self._check_finite("cost_value_loss", loss)
        self.logger.record("train/cost_value_loss", loss)
        self._record_violation()

    def critic_batch(self, rows: int) -> int | None:
        """Rows of a critic's step, where a pass has so many; None: all."""
        return getattr(self, "batch_size", None)

    def critic_rows(self, targets: th.Tensor) -> slice | th.Tensor:
        """Which rows of the rollout the cost critic learns from: all.

        :param targets: its cost returns, shape [N, m]
        :return: an index of rows
        """
        return slice(None)

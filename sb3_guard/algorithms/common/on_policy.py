"""Rollouts with costs: what every algorithm here adds to Stable-Baselines3's on-policy base.

While SB3 collects, the costs of each step are read from ``info`` into the rollout buffer and summed
by episode. When the rollout is full, the cost critic values its states, and J_C, the length of an
episode and the violations of the limits are estimated.
"""

import random
import time
import warnings
from collections import deque
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any, ClassVar, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn, VecEnvWrapper

from sb3_guard.algorithms.common.actor import actor_modules
from sb3_guard.algorithms.common.buffers import CostDictRolloutBuffer, CostRolloutBuffer
from sb3_guard.algorithms.common.checks import check_choice, check_number, check_per_cost, is_number
from sb3_guard.algorithms.common.costs import CostEstimate, read_costs
from sb3_guard.algorithms.common.critics import CostCritic
from sb3_guard.algorithms.common.threads import one_thread

SMALL = 500_000  # weights of a policy that acts on one thread


class _CorrectedEnv(VecEnvWrapper):
    """Executes corrected actions during one rollout; the algorithm's own env stays unwrapped."""

    def __init__(self, venv: VecEnv, algorithm: "CostOnPolicyAlgorithm") -> None:
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


class CostOnPolicyAlgorithm(OnPolicyAlgorithm):
    """An on-policy algorithm with a cost rollout buffer and a cost critic.

    A subclass calls ``_setup_model`` when its own attributes are set.

    :param policy: as for ``OnPolicyAlgorithm``
    :param env: likewise
    :param cost_limit: d, bound on the undiscounted cost of an episode; one number, or one per key
    :param cost_keys: entries of ``info`` that hold the costs of a step
    :param missing_cost: ``"error"`` if every ``info`` must have the cost keys, ``"zero"`` if an
        absent key means that nothing was charged
    :param cost_gamma: discount factor of the costs; None for ``gamma``
    :param cost_gae_lambda: likewise for ``gae_lambda``
    :param kwargs: others of ``OnPolicyAlgorithm``, without ``supported_action_spaces`` and
        ``_init_setup_model``
    """

    #: Whether training depends on costs at all.
    constrained: ClassVar[bool] = True
    #: Whether a critic of the costs is built and trained.
    uses_cost_critic: ClassVar[bool] = True

    rollout_buffer: CostRolloutBuffer | CostDictRolloutBuffer

    def __init__(
        self,
        policy: Any,
        env: Any,
        *,
        cost_limit: float | Sequence[float],
        cost_keys: Sequence[str],
        missing_cost: Literal["error", "zero"],
        cost_gamma: float | None,
        cost_gae_lambda: float | None,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            policy,
            env,
            supported_action_spaces=(
                spaces.Box,
                spaces.Discrete,
                spaces.MultiDiscrete,
                spaces.MultiBinary,
            ),
            _init_setup_model=False,
            **kwargs,
        )
        self.cost_limit = cost_limit
        self.cost_keys = cost_keys
        self.missing_cost = missing_cost
        self.cost_gamma = cost_gamma
        self.cost_gae_lambda = cost_gae_lambda

        # Running episodes outlive rollouts, and a run may be saved between two.
        self.running_costs: np.ndarray | None = None  # [n_envs, m]
        self.running_lengths: np.ndarray | None = None  # [n_envs]
        # What the last step cost, 0 before the first one of an episode.
        self.last_costs: np.ndarray | None = None  # [n_envs, m]
        # Somebody else has reset the environments, so the next `learn` begins new episodes.
        self.begin_anew = False
        self.total_costs: np.ndarray | None = None  # [m]
        self.ep_cost_buffer: deque[np.ndarray] | None = None
        self.horizon: float | None = None  # T of the last rollout in which an episode ended
        self.cost_seen = False
        self._warned: set[str] = set()
        self.costs: CostEstimate | None = None
        self.timing: dict[str, float] = {}
        self._rng_at_rollout: tuple[Any, Any, th.Tensor] | None = None
        self._cuda_at_rollout: list[th.Tensor] = []  # one per device
        self._begin_rollout_statistics()

    # Construction and saving

    def _check_hyperparameters(self) -> None:
        """Refuse values that could only fail later or silently do harm."""
        for name in ("cost_gamma", "cost_gae_lambda"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), 0.0, 1.0, "[]")
        check_choice("missing_cost", self.missing_cost, "error", "zero")
        if (
            isinstance(self.cost_keys, str)
            or len(self.cost_keys) < 1
            or not all(isinstance(key, str) for key in self.cost_keys)
            or len(set(self.cost_keys)) < len(self.cost_keys)
        ):
            raise ValueError(
                f"cost_keys={self.cost_keys!r}: must be a sequence of one or more different names "
                "of info entries, such as ('cost',)"
            )
        check_per_cost("cost_limit", self.cost_limit, tuple(self.cost_keys), low=0.0)
        buffer_class = self.rollout_buffer_class
        if buffer_class is not None and not issubclass(
            buffer_class, CostRolloutBuffer | CostDictRolloutBuffer
        ):
            raise ValueError(
                f"rollout_buffer_class={buffer_class.__name__}: must be a subclass of "
                "CostRolloutBuffer, or of CostDictRolloutBuffer for Dict observations"
            )

    def _setup_model(self) -> None:
        self._check_hyperparameters()
        # Loading turns tuples into lists.
        self.cost_keys = tuple(self.cost_keys)
        n_costs = len(self.cost_keys)
        if self.rollout_buffer_class is None:
            dictionary = isinstance(self.observation_space, spaces.Dict)
            self.rollout_buffer_class = CostDictRolloutBuffer if dictionary else CostRolloutBuffer
        gamma, gae_lambda = self.cost_gamma, self.cost_gae_lambda
        self.rollout_buffer_kwargs = {
            **self.rollout_buffer_kwargs,
            "n_costs": n_costs,
            "cost_gamma": self.gamma if gamma is None else gamma,
            "cost_gae_lambda": self.gae_lambda if gae_lambda is None else gae_lambda,
            "keep_executed": self._corrects,
        }
        super()._setup_model()
        if self.uses_cost_critic:
            self.cost_critic = CostCritic(self.policy, n_costs)
        if any(
            getattr(module, "num_batches_tracked", None) == 0
            for module in actor_modules(self.policy)
        ):
            self._warn_once(
                "the actor has batch normalisation that has seen no data: it will keep the mean 0 "
                "and variance 1 it starts from, since statistics that move would change the "
                "policy outside the trust region; VecNormalize normalises observations"
            )

    def _excluded_save_params(self) -> list[str]:
        return [
            *super()._excluded_save_params(),
            "cost_limits",  # of a file from before it was derived from cost_limit
            "_timeouts",
            "_rng_at_rollout",
            "_cuda_at_rollout",
        ]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        if self.uses_cost_critic:
            state_dicts = [*state_dicts, "cost_critic", "cost_critic.optimizer"]
        return state_dicts, tensors

    # Collecting

    @property
    def cost_limits(self) -> np.ndarray:
        """d: what ``cost_limit`` says now, for each cost key, shape (m,).

        :raises ValueError: ``cost_limit`` was set to something that is no limit
        """
        check_per_cost("cost_limit", self.cost_limit, tuple(self.cost_keys), low=0.0)
        limits = np.asarray(self.cost_limit, np.float64)
        return np.broadcast_to(limits, (len(self.cost_keys),))

    @property
    def _corrects(self) -> bool:
        return type(self).correct is not CostOnPolicyAlgorithm.correct

    @property
    def total_cost(self) -> float:
        """Cost of the whole training so far, summed over the cost keys."""
        return 0.0 if self.total_costs is None else float(self.total_costs.sum())

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        n_costs = len(self.cost_keys)
        if self.ep_cost_buffer is None or reset_num_timesteps:
            self.ep_cost_buffer = deque(maxlen=self._stats_window_size)
            self.total_costs = np.zeros(n_costs)
        if self.begin_anew:
            self._last_obs, self.begin_anew = None, False
        # The environments are reset under the same condition.
        if reset_num_timesteps or self._last_obs is None:
            self.running_costs = np.zeros((self.n_envs, n_costs))
            self.running_lengths = np.zeros(self.n_envs, dtype=np.int64)
            self.last_costs = np.zeros((self.n_envs, n_costs))
        return super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )

    def _begin_rollout_statistics(self) -> None:
        self._ended_costs: list[np.ndarray] = []
        self._ended_lengths: list[int] = []
        # (step, env, observation) of every episode cut by a time limit
        self._timeouts: list[tuple[int, int, Any]] = []
        self._cost_seen_in_rollout = False

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        # Taken before anything is drawn: a checkpoint written at the start of a rollout restores
        # these to continue as if it had never been written.
        legacy = np.random.get_state()  # noqa: NPY002 (the generator SB3 draws from)
        self._rng_at_rollout = (random.getstate(), legacy, th.get_rng_state())
        self._cuda_at_rollout = th.cuda.get_rng_state_all() if self.device.type == "cuda" else []
        started = time.perf_counter()
        self._begin_rollout_statistics()
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
            self._finish_costs()
        else:
            # A callback stopped training; SB3 has then counted the step but not read its infos.
            self._update_info_buffer(callback.locals["infos"], callback.locals["dones"])
        self.timing["collect"] = time.perf_counter() - started
        return full

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: np.ndarray | None = None
    ) -> None:
        super()._update_info_buffer(infos, dones)
        assert dones is not None and self.ep_cost_buffer is not None
        assert self.running_costs is not None and self.running_lengths is not None
        assert self.last_costs is not None
        # A vectorised environment without anything to say may leave infos out.
        infos = [*infos, *({} for _ in range(self.n_envs - len(infos)))]
        costs, seen = read_costs(infos, self.cost_keys, self.missing_cost == "zero")
        self._cost_seen_in_rollout |= seen
        # SB3 calls this just before it adds the transition.
        step = self.rollout_buffer.pos
        self.rollout_buffer.costs[step] = costs
        self.rollout_buffer.previous_costs[step] = self.last_costs
        self.total_costs += costs.sum(axis=0)
        self.running_costs += costs
        self.running_lengths += 1
        self.last_costs = np.where(dones[:, None], 0.0, costs)
        for i in np.flatnonzero(dones):
            self._ended_costs.append(self.running_costs[i].copy())
            self._ended_lengths.append(int(self.running_lengths[i]))
            self.ep_cost_buffer.append(self._ended_costs[-1])
            self.running_costs[i] = 0.0
            self.running_lengths[i] = 0
            info = infos[i]
            if info.get("TimeLimit.truncated", False) and (
                info.get("terminal_observation") is not None
            ):
                self._timeouts.append((step, int(i), info["terminal_observation"]))

    @th.no_grad()
    def _finish_costs(self) -> None:
        """Complete the rollout's cost half: values, advantages, returns, estimate of J_C."""
        self.cost_seen |= self._cost_seen_in_rollout
        if self.constrained and not self._cost_seen_in_rollout:
            self._warn_once(
                f"no info had a cost key of {tuple(self.cost_keys)} during a whole rollout: "
                "training goes on as if nothing cost anything (missing_cost='zero')"
            )
        self.costs = self._estimate_costs()
        if not self.uses_cost_critic:
            return
        buffer = self.rollout_buffer
        stored: Any = buffer.observations
        stored = {"": stored} if not isinstance(stored, dict) else stored
        flat = {key: value.reshape(-1, *value.shape[2:]) for key, value in stored.items()}
        observations = obs_as_tensor(flat, self.device)
        values = self.cost_critic.predict(observations.get("", observations))  # type: ignore
        buffer.cost_values = values.cpu().numpy().reshape(buffer.costs.shape)
        for step, i, observation in self._timeouts:
            terminal, _ = self.policy.obs_to_tensor(observation)
            buffer.cost_bootstraps[step, i] = (
                buffer.cost_gamma * self.cost_critic(terminal)[0].cpu().numpy()
            )
        self._timeouts = []
        assert self._last_obs is not None and self._last_episode_starts is not None
        last = self.cost_critic(obs_as_tensor(self._last_obs, self.device)).cpu().numpy()
        buffer.compute_cost_returns_and_advantage(last, self._last_episode_starts)

    def _estimate_costs(self) -> CostEstimate:
        """J_C, T and the violations from the episodes that ended in this rollout."""
        if self._ended_costs:
            self.horizon = horizon = float(np.mean(self._ended_lengths))
            episode_cost = np.mean(self._ended_costs, axis=0)
        else:
            horizon = self.horizon or self._horizon_before_any_episode()
            # Nothing ended: what an episode would cost at the rate of this rollout.
            episode_cost = self.rollout_buffer.costs.mean(axis=(0, 1)) * horizon
        violation = (episode_cost - self.cost_limits) / horizon
        return CostEstimate(episode_cost, horizon, violation)

    def _horizon_before_any_episode(self) -> float:
        assert self.env is not None and self.running_lengths is not None
        limits: list[Any] = []
        try:
            # TimeLimit's number first: around an environment without a spec there is no other.
            if self.env.has_attr("_max_episode_steps"):
                limits = self.env.get_attr("_max_episode_steps")
            elif not isinstance(self.env.unwrapped, SubprocVecEnv):
                # Not every spec can be sent from process to process, and to ask for what isn't
                # there would end them.
                specs = self.env.get_attr("spec")
                limits = [getattr(spec, "max_episode_steps", None) for spec in specs]
        except (AttributeError, NotImplementedError):
            pass  # a vectorised environment need not tell: then no limit is known, as below
        if limits and all(is_number(limit) and limit > 0 for limit in limits):
            return float(np.mean(limits))
        longest = float(self.running_lengths.max())
        if self.constrained:
            self._warn_once(
                "no episode has ended yet and the environment states no max_episode_steps: until "
                f"one ends, the cost limit is spread over the longest so far, {longest:g} steps"
            )
        return longest

    def _warn_once(self, message: str) -> None:
        topic = message.split(":")[0]
        if topic not in self._warned:
            self._warned.add(topic)
            warnings.warn(message, UserWarning, stacklevel=3)

    # Logging

    def _record_per_cost(self, name: str, values: np.ndarray) -> None:
        """Record one number per constraint; the key is appended where there are several."""
        for key, value in zip(self.cost_keys, values, strict=True):
            self.logger.record(f"{name}/{key}" if len(values) > 1 else name, float(value))

    def dump_logs(self, iteration: int = 0) -> None:
        assert self.ep_cost_buffer is not None and self.total_costs is not None
        if self.constrained or self.cost_seen:
            if self.ep_cost_buffer:
                self._record_per_cost("rollout/ep_cost_mean", np.mean(self.ep_cost_buffer, axis=0))
            if self.num_timesteps:
                self._record_per_cost("rollout/cost_rate", self.total_costs / self.num_timesteps)
        super().dump_logs(iteration)

    # What an algorithm may replace

    def correct(self, observations: Any, actions: np.ndarray) -> np.ndarray:
        """The actions to execute in place of the sampled ones, both shaped (n_envs, …)."""
        return actions

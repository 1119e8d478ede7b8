"""Replay with costs, for any off-policy algorithm of Stable-Baselines3 with continuous actions.

The costs of each step go into the replay buffer. Two networks per cost learn
Q_C(s, a) = c + γ_C Q_C(s', a'); the latest episodes tell J_C.
"""

import warnings
from typing import Any, ClassVar, Literal

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, RolloutReturn
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.algorithms.common.arguments import hyperparameter
from sb3_guard.algorithms.common.cost_critics import CostQ
from sb3_guard.algorithms.common.costs import inverse
from sb3_guard.algorithms.common.lagrangian import Lagrangian
from sb3_guard.algorithms.common.replay_buffers import (
    CostDictReplayBuffer,
    CostNStepReplayBuffer,
    CostReplayBuffer,
    CostReplayBufferSamples,
)

WINDOW = 50  # episodes whose mean cost the multipliers follow


def descend(loss: th.Tensor, optimizer: th.optim.Optimizer) -> None:
    """One step down a loss; what the optimizer does not move gets no gradient."""
    parameters = [part for group in optimizer.param_groups for part in group["params"]]
    for part in parameters:
        part.grad = None  # as zero_grad, which also talks to the profiler
    loss.backward(inputs=[part for part in parameters if part.requires_grad])
    optimizer.step()


class CostReplay(Lagrangian, OffPolicyAlgorithm):
    """Costs, cost critics and multipliers for an off-policy algorithm with continuous actions.

    A class that inherits from it says in :meth:`learn_from` what it does with a batch; there
    :meth:`batch_weights` are what the costs weigh.

    With ``lambda_units="relative"`` the weight of a cost is λ times the standard deviation of Q
    over that of Q_C, both of the transitions in the batch: replayed actions vary after the policy
    has ceased to.

    A single episode is a poor estimate of J_C, so each that ends moves the multipliers by the mean
    cost of the latest 50: the same way whether one environment or many have brought them. Episodes
    that end while random actions fill the buffer do not count.

    :param cost_gamma: γ_C, discount factor of the costs, below 1; None for ``gamma``
    :param lambda_lr: η, what the multipliers gain per unit of violation. An episode that ends gives
        them its share of the steps t so far, η T / t, so that they move as far in a short training
        as in a long one, and settle
    :param lambda_starts: when the multipliers begin to move: after that many steps, or below 1
        after that share of the training. Before it the policy learns its task at ``lambda_init``
    :param safety_margin: how far below a limit d the multipliers keep J_C, as a share of abs(d):
        they follow J_C - (d - safety_margin abs(d))
    """

    #: What tuning searches, as in a file for ``tune --search-space``; subclasses add theirs.
    search_space: ClassVar[dict[str, Any]] = {
        "gamma": [0.95, 0.98, 0.99, 0.995],
        "learning_rate": {"low": 1e-4, "high": 3e-3, "log": True},
        "batch_size": [128, 256, 512],
        "tau": [0.002, 0.005, 0.01, 0.02],
        "train_freq": [1, 4, 8, 16],
        "lambda_lr": {"low": 0.2, "high": 30.0, "log": True},
        "lambda_init": {"low": 0.0, "high": 2.0},
        "proportional_gain": {"low": 0.0, "high": 2.0},
        "lambda_starts": {"low": 0.0, "high": 0.3},
        "safety_margin": {"low": 0.0, "high": 0.3},
    }

    # Ours have room for costs.
    fixed_arguments: ClassVar[frozenset[str]] = frozenset({"replay_buffer_class"})

    lambda_lr: float = hyperparameter(3.0)
    proportional_gain: float = hyperparameter(0.5)
    lambda_units: Literal["relative", "cost"] = hyperparameter("relative")
    lambda_starts: float = hyperparameter(0.15)
    safety_margin: float = hyperparameter(0.0, high=1.0)
    cost_gamma: float | None = hyperparameter(None, high=1.0)

    replay_buffer: CostReplayBuffer | CostDictReplayBuffer

    def __init__(
        self, policy: str | type[BasePolicy], env: GymEnv | str, *args: Any, **kwargs: Any
    ) -> None:
        if isinstance(env, str):  # made here already, to look at its actions
            env = maybe_make_env(env, kwargs.get("verbose", 0))
        space = getattr(env, "single_action_space", None) or getattr(env, "action_space", None)
        if space is not None and not isinstance(space, spaces.Box):
            raise ValueError(
                f"{type(self).__name__} needs continuous actions (Box), not {space}: for others "
                "there are on-policy algorithms such as PPOLag"
            )
        self.cost_deviation = np.zeros(0, np.float32)  # of Q_C in the last batch, shape (m,)
        self.latest_costs: list[np.ndarray] = []  # of the last episodes, each of shape (m,)
        super().__init__(policy, env, *args, **kwargs)

    # Construction and saving

    @property
    def _gamma_of_costs(self) -> float:
        return self.gamma if self.cost_gamma is None else self.cost_gamma

    def _check_hyperparameters(self) -> None:
        super()._check_hyperparameters()
        several = isinstance(self.observation_space, spaces.Dict) or self.optimize_memory_usage
        if self.n_steps > 1 and several:
            raise ValueError(
                f"n_steps={self.n_steps}: must be 1 for Dict observations and with "
                "optimize_memory_usage=True"
            )

    def _choose_buffer(self) -> None:
        dictionary = isinstance(self.observation_space, spaces.Dict)
        one_step = CostDictReplayBuffer if dictionary else CostReplayBuffer
        self.replay_buffer_class = CostNStepReplayBuffer if self.n_steps > 1 else one_step
        # A loaded model has the arguments that were chosen for it, and maybe another n_steps now.
        names = "n_steps", "gamma", "cost_gamma"
        given = {k: v for k, v in self.replay_buffer_kwargs.items() if k not in names}
        values = (self.n_steps, self.gamma, self._gamma_of_costs) if self.n_steps > 1 else ()
        chosen = dict(zip(names, values, strict=False))
        self.replay_buffer_kwargs = {**given, **chosen, "n_costs": len(self.cost_keys)}

    def _setup_model(self) -> None:
        with warnings.catch_warnings():  # SB3 takes it that no buffer but its own knows n_steps
            warnings.filterwarnings("ignore", "`n_steps=")
            super()._setup_model()
        # Its first weights take nothing from the stream that actions are sampled from.
        with th.random.fork_rng(devices=[]):
            self.cost_critic = self.make_cost_critic()
        # Parameters of the critics, so that no gradient step walks over the modules.
        critic, target = self.critic, self.critic_target  # type: ignore[attr-defined]
        self._learners = [*critic.parameters(), *self.cost_critic.online.parameters()]
        self._targets = [*target.parameters(), *self.cost_critic.target.parameters()]

    def make_cost_critic(self) -> CostQ:
        """The critics of the costs, before they have learnt."""
        return CostQ(self.policy, len(self.cost_keys), self.lr_schedule(1))

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_learners", "_targets"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "cost_critic", "cost_critic.optimizer"], tensors

    def load_replay_buffer(self, path: Any, *args: Any, **kwargs: Any) -> None:
        before = self.replay_buffer
        super().load_replay_buffer(path, *args, **kwargs)
        kind: Any = self.replay_buffer_class
        shape = self.n_envs, len(self.cost_keys)
        if type(self.replay_buffer) is not kind or self.replay_buffer.costs.shape[1:] != shape:
            self.replay_buffer = before
            raise ValueError(
                f"{path}: must be a {kind.__name__} of {shape[0]} environments and {shape[1]} costs"
            )
        vars(self.replay_buffer).update(self.replay_buffer_kwargs)  # n_steps and discounts

    # Collecting

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any
    ) -> RolloutReturn:
        rollout = super().collect_rollouts(env, callback, *args, **kwargs)
        if not rollout.continue_training:
            self._count_last_step(callback)
        return rollout

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: np.ndarray | None = None
    ) -> None:
        super()._update_info_buffer(infos, dones)
        if self.num_timesteps - self.n_envs < self.learning_starts:  # the actions were random
            self.costs.forget()
        self.replay_buffer.costs[self.replay_buffer.pos] = self.step_costs

    # Learning

    def learn_from(self, batch: CostReplayBufferSamples, step: int) -> dict[str, float]:
        """One gradient step of everything, :meth:`fit_cost_critic` included.

        :param batch: B transitions
        :param step: number of the step in this ``train``, from 0
        :return: what to log, by name
        """
        raise NotImplementedError

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Multipliers follow the episodes that ended, then SB3's loop around :meth:`learn_from`."""
        self._follow_episodes()
        self.policy.set_training_mode(True)
        owners: tuple[Any, ...] = (self.actor, self.critic, self.cost_critic)  # type: ignore[attr-defined]
        optimizers: list[th.optim.Optimizer] = [owner.optimizer for owner in owners]
        temperature: th.optim.Optimizer | None = getattr(self, "ent_coef_optimizer", None)
        if temperature is not None:
            optimizers.append(temperature)
        self._update_learning_rate(optimizers)
        history: dict[str, list[float]] = {}
        for step in range(gradient_steps):
            self._n_updates += 1
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            for name, value in self.learn_from(batch, step).items():  # type: ignore[arg-type]
                self._check_finite(name, value)
                history.setdefault(name, []).append(value)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in history.items():
            self.logger.record(f"train/{name}", float(np.mean(values)))

    def fit_cost_critic(self, batch: CostReplayBufferSamples, next_actions: th.Tensor) -> float:
        """One step towards c + γ_C (1 - done) Q_C'(s', a'), a time-out being no end.

        :param batch: B transitions
        :param next_actions: a', which the reward's critic has been given too
        :return: the loss
        """
        critic = self.cost_critic
        gamma = self._gamma_of_costs if batch.cost_discounts is None else batch.cost_discounts
        with th.no_grad():
            after = critic.predict(critic.target, batch.next_observations, next_actions)
            after = ((1 - batch.dones) * gamma)[:, :, None] * critic.samples(after)
            target = batch.costs[:, :, None] + after  # [B, m, K]
        predicted = critic.predict(critic.online, batch.observations, batch.actions)
        values = critic.value(predicted.detach())
        self.cost_deviation = values.std(dim=0, correction=0).cpu().numpy()
        loss = critic.loss(predicted, target)
        descend(loss, critic.optimizer)
        return loss.item()

    def batch_weights(self, values: th.Tensor) -> th.Tensor:
        """What each cost weighs against Q on a batch, shape (m,).

        :param values: Q of the batch's own actions, shape [B, 1]
        """
        spread = float(values.detach().std(correction=0)) or 1.0
        weights = self.weights(spread * inverse(self.cost_deviation.astype(np.float64)))
        return th.as_tensor(weights, device=values.device)

    def _follow_episodes(self) -> None:
        """J_C is the mean of the latest episodes; each that ended is a step of the multipliers."""
        means = []
        for cost in self.costs.ended:
            self.latest_costs = [*self.latest_costs, cost][-WINDOW:]
            means.append(np.mean(self.latest_costs, axis=0))
        if self._estimate_costs():
            self.costs.episode_cost = means[-1]
            self._record_violation()
        share = self.lambda_starts < 1.0
        starts = self.lambda_starts * (self._total_timesteps if share else 1.0)
        if self.num_timesteps < starts:
            means = []
        margin = self.safety_margin * np.abs(self.costs.limits)
        rate = self.lambda_lr * (self.costs.horizon or 0.0) / self.num_timesteps
        self.step([mean + margin for mean in means], rate)

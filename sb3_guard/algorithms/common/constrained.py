"""Any Stable-Baselines3 algorithm, on- or off-policy, with costs and limits.

A cooperative mixin: costs are read from ``info`` while SB3 collects, summed by episode, logged and
saved. What is done about them is the business of the classes that stand on it.
"""

import inspect
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_guard.algorithms.common.arguments import (
    check_names,
    check_stated,
    documentation,
    hyperparameter,
    signature,
    stated,
)
from sb3_guard.algorithms.common.costs import CostBar, Costs, scheduled_limits, time_limit
from sb3_guard.costs import check_cost_keys, read_costs
from sb3_guard.judging import Limits
from sb3_guard.vector import as_vec_env, lacks_statistics, moments_of, normalizer_of

BROKEN_OFF = (
    "eval_env is the training environment, whose episodes every evaluation would break off: make "
    "another one for it"
)


class Constrained(BaseAlgorithm):
    """Cost keys, limits and episode costs in addition to an algorithm of Stable-Baselines3.

    Mixed in before the algorithm: ``class SafePPO(CostRollouts, PPO)``. A subclass states its
    hyperparameters as attributes (:func:`~sb3_guard.algorithms.common.arguments.hyperparameter`);
    one that needs a constructor sets its own attributes first and then hands the other arguments
    on: SB3 builds the model at the end of its own. The signature and the docstring are composed for
    every subclass, and ``learn`` logs under its name.

    :param cost_limit: d, bound on the undiscounted cost of an episode; one number, or one per key.
        The attribute may be set at any time, and holds from the next update on. Instead of a
        number, a function of the remaining progress (from 1 to 0), or text such as ``"lin_50_25"``,
        a line from 50 to 25 over the training
    :param cost_keys: entries of ``info`` that hold the costs of a step
    :param limit_start: how many times ``cost_limit`` the limit is when the training begins; it
        falls to ``cost_limit`` along a line. 1 for ``cost_limit`` from the first step on; a limit
        of 0 is 0 throughout, and a schedule begins where it says
    :param limit_fall: share of the training over which it falls
    :param aim: what the training keeps within the limit: ``"mean"``, the mean cost of an episode;
        or ``"certificate"``, the mean and the half-width of its interval
        (:meth:`~sb3_guard.judging.Limits.half_width`), so that the agent can be certified
    :param missing_cost: ``"error"`` if every ``info`` must have the cost keys, ``"zero"`` if an
        absent key means that nothing was charged
    :raises TypeError: an argument is not known; the message names the nearest one
    :raises ValueError: a value is out of range; the message names it and what is allowed
    """

    #: What tables and figures call it (the class's name if it says nothing), what it is like,
    #: and where it comes from.
    label: ClassVar[str] = ""
    family: ClassVar[str] = ""
    paper: ClassVar[str] = ""
    #: Whether training depends on costs at all.
    constrained: ClassVar[bool] = True
    #: What of an episode's costs the limits bound, see :class:`~sb3_guard.costs.EpisodeCosts`.
    limit_on: ClassVar[Literal["sum", "max"]] = "sum"
    #: Arguments of the policy where ``policy_kwargs`` does not have them.
    policy_defaults: ClassVar[dict[str, Any]] = {}
    #: Arguments of SB3's constructors that the class fills in itself.
    fixed_arguments: ClassVar[frozenset[str]] = frozenset()
    #: Whether costs and limits may be negative: "at least x" of what is reported as -cost.
    signed_limits: ClassVar[bool] = False

    cost_limit: float | Schedule | Sequence[float | Schedule] = hyperparameter(0.0)
    cost_keys: Sequence[str] = hyperparameter(("cost",))
    limit_start: float = hyperparameter(1.0, low=1.0)
    limit_fall: float = hyperparameter(0.6, high=1.0, ends="(]")
    aim: Literal["mean", "certificate"] = hyperparameter("mean")
    missing_cost: Literal["error", "zero"] = hyperparameter("error")

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "label" not in vars(cls):
            cls.label = cls.__name__
        composed = signature(cls, cls.fixed_arguments)
        cls.__signature__ = composed  # type: ignore[attr-defined]
        cls.__doc__ = documentation(cls, composed.parameters)

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        check_names(cls, kwargs)
        return super().__new__(cls)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._warned: set[str] = set()
        self.saved_as = type(self).__name__  # by the class that wrote the file, after `load`
        self.learnt_normalized = False
        # `load` builds the model later, with the limit of the file.
        new = kwargs.get("_init_setup_model", True)
        if self.constrained and new and "cost_limit" not in kwargs:
            self._warn_once(
                "cost_limit",
                f"{type(self).__name__} without cost_limit: it is 0, no cost at all, which hardly "
                "any policy keeps; choose a positive one, such as half of what an episode of TRPO "
                "or PPO costs, or write cost_limit=0.0",
            )
        for name, one in stated(type(self)).items():
            setattr(self, name, kwargs.pop(name, one.default))

        #: limits, episodes, J_C, T and violations, see :class:`Costs`
        self.costs: Costs = None  # type: ignore[assignment]
        #: whether a rollout is under way, so that nobody else may step the environments
        self.collecting = False
        self.timing: dict[str, float] = {}
        super().__init__(*args, **kwargs)

    # Construction

    @classmethod
    def load(cls, path: Any, *args: Any, **kwargs: Any) -> Self:
        """SB3's ``load(path, env, device, …)``, which takes an argument misspelt without a word.

        :param path: a file that an algorithm of this class has saved
        :param kwargs: arguments to change, such as ``cost_limit``
        :return: the agent
        :raises TypeError: an argument is not known; the message names the nearest one
        :raises ValueError: another algorithm has saved the file
        """
        check_names(cls, kwargs.keys() - {"custom_objects", "print_system_info", "force_reset"})
        if "policy_kwargs" in kwargs:  # SB3 compares them with those of the file
            kwargs["policy_kwargs"] = cls.policy_defaults | (kwargs["policy_kwargs"] or {})
        return super().load(path, *args, **kwargs)

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        """Take Gymnasium's vector environments, too."""
        if isinstance(env, VectorEnv):
            env = VecMonitor(as_vec_env(env)) if monitor_wrapper else as_vec_env(env)
        env = BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        normalizer_of(env)  # refuses a second one
        return env

    def _check_hyperparameters(self) -> None:
        """Refuse values that could only fail later or silently do harm."""
        check_stated(self)
        self.cost_keys = check_cost_keys(self.cost_keys)  # loading turns tuples into lists
        for remaining in (1.0, 0.0):
            scheduled_limits(self, remaining)

    def _setup_model(self) -> None:
        self._check_hyperparameters()
        observed = self.observation_space
        parts = observed.values() if isinstance(observed, spaces.Dict) else [observed]
        for space in *parts, self.action_space:
            if np.any(getattr(space, "start", 0)):
                raise ValueError(f"{space}: must begin at 0, where Stable-Baselines3 counts from")
        if self.costs is None or len(self.costs.total) != len(self.cost_keys):
            self.costs = Costs(self.cost_limits, self.limit_on, self._stats_window_size)
        self._choose_buffer()
        super()._setup_model()  # type: ignore[safe-super]

    def _choose_buffer(self) -> None:
        """Say which buffer SB3 is to make, and what it has to know of the costs."""

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "step_costs", "_warned", "collecting"]

    # Limits

    @property
    def cost_limits(self) -> np.ndarray:
        """d: what ``cost_limit`` says now, for each cost key, shape (m,).

        :raises ValueError: ``cost_limit`` was set to something that is not a limit
        """
        return scheduled_limits(self, self._current_progress_remaining)

    @property
    def final_cost_limits(self) -> np.ndarray:
        """The limits at the end of the training, by which an agent is judged, shape (m,)."""
        return scheduled_limits(self, 0.0)

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        # The last rollout may go beyond the training's end, which no schedule knows of.
        steps = min(num_timesteps, total_timesteps)
        super()._update_current_progress_remaining(steps, total_timesteps)
        self._aim()

    def _aim(self) -> None:
        """Set the limits that the next update keeps to."""
        self.costs.limits = limits = self.cost_limits
        if self.aim == "certificate":
            self.costs.limits = limits - Limits(limits).half_width(np.array(self.costs.recent))

    # Episodes

    @property
    def total_cost(self) -> float:
        """Cost of the whole training so far, summed over the cost keys."""
        return float(self.costs.total.sum())

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if lacks_statistics(self, self.env):
            self._warn_once(
                "statistics",
                "the agent learnt from normalised observations, and env has no VecNormalize of "
                "theirs: wrap it in VecNormalize.load(file, env), or what the agent has learnt is "
                "of other observations",
            )
        self.learnt_normalized = bool(moments_of(self.env))
        if reset_num_timesteps:
            self.costs.latest.clear()
            self.costs.total[:] = 0.0
            self.costs.forget()
        # The environments are reset under the same condition.
        if reset_num_timesteps or self._last_obs is None:
            self.costs.begin(self.n_envs)
        theirs = inspect.signature(super().learn)  # type: ignore[safe-super]
        if tb_log_name == theirs.parameters["tb_log_name"].default:
            tb_log_name = type(self).__name__
        total, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if progress_bar:
            bar = callback.callbacks[-1] = CostBar()  # type: ignore[attr-defined]
            bar.init_callback(self)
        return total, callback

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> Any:
        """Raise ValueError if an evaluation has reset the environments since ``learn`` began."""
        if self._last_obs is None:
            raise ValueError(BROKEN_OFF)
        self.collecting = True
        try:
            return super().collect_rollouts(*args, **kwargs)  # type: ignore[misc]
        finally:
            self.collecting = False

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: np.ndarray | None = None
    ) -> None:
        """Called by SB3 once per step, just before it stores the transition."""
        super()._update_info_buffer(infos, dones)
        assert dones is not None
        # A vectorised environment without anything to say may leave infos out.
        infos = [*infos, *({} for _ in range(self.n_envs - len(infos)))]
        zero, steps = self.missing_cost == "zero", self.costs.episodes.lengths
        costs, seen = read_costs(infos, self.cost_keys, zero, steps)
        broken = [i for i in np.flatnonzero(dones).tolist() if infos[i].get("physics_error")]
        self.step_costs = self.costs.step(costs, dones, seen, broken)  # [n_envs, m]

    def _count_last_step(self, callback: BaseCallback) -> None:
        """Read the infos of a step at which a callback stopped training: SB3 only counts it."""
        self._update_info_buffer(callback.locals["infos"], callback.locals["dones"])

    def _estimate_costs(self, rate: np.ndarray | None = None) -> bool:
        """Renew ``costs`` from the episodes that ended since the last time.

        :param rate: see :meth:`Costs.estimate`
        :return: whether there is a new estimate
        """
        self._aim()
        # Until an episode has ended, the longest so far stands for its length.
        longest = float(self.costs.episodes.lengths.max())
        if not self.costs.estimate(rate, lambda: time_limit(self.env) or longest):
            return False
        if self.constrained and not self.costs.seen_lately:
            self._warn_once(
                "no cost",
                f"no info had a cost key of {tuple(self.cost_keys)} during a whole rollout: "
                "training continues as if nothing cost anything (missing_cost='zero')",
            )
        self.costs.forget()
        return True

    def _warn_once(self, topic: str, message: str) -> None:
        if topic not in self._warned:
            self._warned.add(topic)
            warnings.warn(message, UserWarning, stacklevel=2)

    def _check_finite(self, name: str, loss: float) -> None:
        """
        :raises FloatingPointError: a loss is not finite, and so is what it learns from
        """
        if not np.isfinite(loss):
            raise FloatingPointError(
                f"{name} is {loss} after {self._n_updates} updates: a reward or observation of "
                f"the environment is not finite, or learning_rate={self.learning_rate!r} too high"
            )

    # Logging

    def _record_per_cost(self, name: str, values: np.ndarray) -> None:
        """Record one number per constraint; the key is appended where there are several."""
        for key, value in zip(self.cost_keys, values, strict=True):
            self.logger.record(f"{name}/{key}" if len(values) > 1 else name, float(value))

    def _record_violation(self) -> None:
        """Record J_C - d, in units of an episode's cost."""
        if self.constrained:
            excess = self.costs.episode_cost - self.cost_limits
            self._record_per_cost("train/constraint_violation", excess)
        if self.aim == "certificate":
            self._record_per_cost("train/cost_aim", self.costs.limits)

    def dump_logs(self, *args: Any) -> None:
        costs = self.costs
        if self.constrained or costs.seen:
            if costs.latest:
                self._record_per_cost("rollout/ep_cost_mean", np.mean(costs.latest, axis=0))
            if self.num_timesteps:
                self._record_per_cost("rollout/cost_rate", costs.total / self.num_timesteps)
        if self.constrained:
            self._record_per_cost("rollout/cost_limit", self.cost_limits)
        super().dump_logs(*args)

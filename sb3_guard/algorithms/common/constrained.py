"""Any Stable-Baselines3 algorithm, on- or off-policy, with costs and limits.

A cooperative mixin: costs are read from ``info`` while SB3 collects, summed by episode, logged and
saved. What is done about them is the business of the classes that stand on it.
"""

import inspect
import warnings
from collections import deque
from collections.abc import Iterator
from typing import Any, ClassVar, Literal, Self

import numpy as np
from gymnasium import spaces
from sb3_contrib.common.maskable.utils import is_masking_supported
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EventCallback,
)
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_guard.algorithms.common.arguments import (
    check_names,
    check_theirs,
    documentation,
    hyperparameter,
    signature,
    stated,
    taking_defaults,
    with_defaults,
)
from sb3_guard.algorithms.common.costs import CostEstimate
from sb3_guard.algorithms.common.limits import CostLimits
from sb3_guard.checked_env import checked
from sb3_guard.checks import check_cost_keys, is_number
from sb3_guard.costs import EpisodeCosts, read_costs

_LIBRARIES = {"sb3_guard", "stable_baselines3"}  # whose lines no warning is about


def _within(callback: BaseCallback) -> Iterator[BaseCallback]:
    """A callback and those that it calls, however deep."""
    yield callback
    below = callback.callbacks if isinstance(callback, CallbackList) else []
    if isinstance(callback, EventCallback) and callback.callback is not None:
        below = [callback.callback]
    for one in below:
        yield from _within(one)


class Constrained(CostLimits, BaseAlgorithm):
    """Cost keys, limits and episode costs in addition to an algorithm of Stable-Baselines3.

    Mixed in before the algorithm: ``class SafePPO(CostRollouts, PPO)``. A subclass states its
    hyperparameters as attributes (:func:`~sb3_guard.algorithms.common.arguments.hyperparameter`);
    one that needs a constructor sets its own attributes first and then hands the other arguments
    on: SB3 builds the model at the end of its own. The signature, the docstring and the name under
    which ``learn`` logs are composed for every subclass.

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
    #: Arguments of SB3's constructors that the class fills in itself.
    fixed_arguments: ClassVar[frozenset[str]] = frozenset()
    #: Default values of keyword arguments, where they differ from those of the bases.
    defaults: ClassVar[dict[str, Any]] = {}

    missing_cost: Literal["error", "zero"] = hyperparameter("error")

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "label" not in vars(cls):
            cls.label = cls.__name__
        if {"defaults", "fixed_arguments"} & {*vars(cls)}:
            cls.__init__ = taking_defaults(cls)  # type: ignore[method-assign]
        composed = signature(cls, cls.fixed_arguments)
        cls.__signature__ = composed  # type: ignore[attr-defined]
        cls.__doc__ = documentation(cls, composed.parameters)
        if getattr(cls.learn, "__code__", None) is Constrained.learn.__code__:
            theirs = inspect.signature(super().learn).parameters
            interval = theirs["log_interval"].default
            cls.learn = with_defaults(  # type: ignore[method-assign]
                Constrained.learn,  # type: ignore[arg-type]
                log_interval=100 if interval is inspect.Parameter.empty else interval,
                tb_log_name=cls.__name__,
            )

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        check_names(cls, kwargs)
        return super().__new__(cls)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._warned: set[str] = set()
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

        # Running episodes outlive rollouts, and a run may be saved between two; set by `learn`.
        none: Any = None
        self.episodes: EpisodeCosts = none
        # What the last step cost, 0 before the first one of an episode.
        self.last_costs: np.ndarray | None = None  # [n_envs, m]
        # Somebody else has reset the environments, so the next `learn` begins new episodes.
        self.begin_anew = False
        self.total_costs: np.ndarray = none  # [m]
        self.ep_cost_buffer: deque[np.ndarray] = none
        self.horizon: float | None = None  # T when an episode last ended
        self.cost_seen = False
        #: J_C, T and the violations, as last estimated; there is an estimate in every update
        self.costs: CostEstimate = none
        #: Whether the estimate has not been followed yet by what follows it (a multiplier)
        self.costs_are_new = False
        self.timing: dict[str, float] = {}
        self._begin_statistics()
        super().__init__(*args, **kwargs)
        if new and self.env is not None and is_masking_supported(self.env):
            self._warn_once(
                "action masks",
                f"{type(self).__name__} does not use the environment's action_masks: it takes "
                "actions that they exclude, too; sb3-contrib's MaskablePPO keeps to them",
            )

    # Construction

    @classmethod
    def load(
        cls,
        path: Any,
        env: Any = None,
        device: Any = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """SB3's ``load``, which takes an argument that is misspelt without a word.

        :param path: a file that an algorithm of this class has saved
        :param env: environment to train in; None: to predict only
        :param device: torch device
        :param custom_objects: what replaces attributes in the file
        :param print_system_info: whether to print the versions that the file was written with
        :param force_reset: whether the next ``learn`` begins new episodes
        :param kwargs: arguments to change, such as ``cost_limit``
        :return: the agent
        :raises TypeError: an argument is not known; the message names the nearest one
        """
        check_names(cls, kwargs)
        return super().load(
            path, env, device, custom_objects, print_system_info, force_reset, **kwargs
        )

    def _check_hyperparameters(self) -> None:
        """Refuse values that could only fail later or silently do harm."""
        stated_ones = stated(type(self))
        for name, parameter in inspect.signature(type(self)).parameters.items():
            if name in stated_ones:
                stated_ones[name].check(name, getattr(self, name), parameter.annotation)
        self.cost_keys = check_cost_keys(self.cost_keys)  # loading turns tuples into lists
        check_theirs(self)
        self._check_cost_limit()

    def _setup_model(self) -> None:
        self._check_hyperparameters()
        observed = self.observation_space
        parts = observed.values() if isinstance(observed, spaces.Dict) else [observed]
        for space in *parts, self.action_space:
            if np.any(getattr(space, "start", 0)):
                raise ValueError(f"{space}: must begin at 0, where Stable-Baselines3 counts from")
        self._choose_buffer()
        super()._setup_model()  # type: ignore[safe-super]

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return BaseAlgorithm._wrap_env(checked(env), verbose, monitor_wrapper)

    def _choose_buffer(self) -> None:
        """Say which buffer SB3 is to make, and what it has to know of the costs."""

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "step_costs", "_warned"]

    # Costs

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        """Called by SB3 before each update: a limit may be another one then."""
        # The last rollout may go beyond the training's end, which no schedule knows of.
        super()._update_current_progress_remaining(
            min(num_timesteps, total_timesteps), total_timesteps
        )
        if self.costs is not None and self.limits_change:
            cost, horizon, _ = self.costs
            self.costs = CostEstimate(cost, horizon, (cost - self.cost_limits) / horizon)

    @property
    def total_cost(self) -> float:
        """Cost of the whole training so far, summed over the cost keys."""
        return 0.0 if self.total_costs is None else float(self.total_costs.sum())

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train, as SB3's ``learn`` does; logs are named after the class.

        :param total_timesteps: steps to take, over all environments
        :param callback: called at every step
        :param log_interval: updates, or off-policy episodes, between two logs
        :param tb_log_name: name of the run in ``tensorboard_log``
        :param reset_num_timesteps: whether to count from 0 and begin new episodes
        :param progress_bar: whether to show one
        :return: the trained model
        """
        return super().learn(  # type: ignore[safe-super]
            total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
        )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[int, BaseCallback]:
        n_costs = len(self.cost_keys)
        checked(self.env, self.cost_keys)
        normalizer = self.get_vec_normalize_env()
        self.learnt_normalized = normalizer is not None and normalizer.norm_obs
        if self.ep_cost_buffer is None or reset_num_timesteps:
            self.ep_cost_buffer = deque(maxlen=self._stats_window_size)
            self.total_costs = np.zeros(n_costs)
        if self.begin_anew:
            self._last_obs, self.begin_anew = None, False
        # The environments are reset under the same condition.
        if reset_num_timesteps or self._last_obs is None:
            self.episodes = EpisodeCosts(self.n_envs, n_costs, self.limit_on)
            self.last_costs = np.zeros((self.n_envs, n_costs))
        if reset_num_timesteps:
            self._begin_statistics()
        steps, callbacks = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, *args, **kwargs
        )
        if self.constrained and any(type(one) is EvalCallback for one in _within(callbacks)):
            self._warn_once(
                "EvalCallback",
                "EvalCallback keeps the model of the highest reward, whatever it costs: "
                "sb3_guard.CostEvalCallback keeps the best safe one",
            )
        return steps, callbacks

    def _begin_statistics(self) -> None:
        """Forget the episodes that have ended: the next estimate is about others."""
        self._ended_costs: list[np.ndarray] = []
        self._ended_lengths: list[int] = []
        self._cost_seen_lately = False

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: np.ndarray | None = None
    ) -> None:
        """Called by SB3 once per step, just before it stores the transition."""
        super()._update_info_buffer(infos, dones)
        assert dones is not None
        # A vectorised environment without anything to say may leave infos out.
        infos = [*infos, *({} for _ in range(self.n_envs - len(infos)))]
        zero = self.missing_cost == "zero"
        costs, seen = read_costs(infos, self.cost_keys, zero, self.episodes.lengths)
        for episode in self.episodes.step(costs, dones):
            if infos[episode.row].get("physics_error"):
                continue  # nobody knows what it would have cost
            self._ended_costs.append(episode.bounded)
            self._ended_lengths.append(episode.length)
            self.ep_cost_buffer.append(episode.total)
        self._cost_seen_lately |= seen
        self.step_costs = self.episodes.charges  # [n_envs, m], for the buffer
        self.total_costs += costs.sum(axis=0)
        self.last_costs = np.where(dones[:, None], 0.0, costs)

    def _count_last_step(self, callback: BaseCallback) -> None:
        """Read the infos of a step at which a callback stopped training: SB3 only counts it."""
        self._update_info_buffer(callback.locals["infos"], callback.locals["dones"])

    def _estimate_costs(self, rate: np.ndarray | None = None) -> bool:
        """Renew ``costs`` from the episodes that ended since the last time.

        :param rate: mean costs of a step, shape (m,), which tell what an episode would cost where
            none has ended; None keeps the last estimate then
        :return: whether there is a new estimate
        """
        self.cost_seen |= self._cost_seen_lately
        if self._ended_costs:
            self.horizon = horizon = float(np.mean(self._ended_lengths))
            episode_cost = np.mean(self._ended_costs, axis=0)
        elif rate is not None:
            horizon = self.horizon or self._horizon_before_any_episode()
            episode_cost = rate * horizon
        else:
            return False
        if self.constrained and not self._cost_seen_lately:
            self._warn_once(
                "no cost",
                f"no info had a cost key of {tuple(self.cost_keys)} during a whole rollout: "
                "training continues as if nothing cost anything (missing_cost='zero')",
            )
        violation = (episode_cost - self.cost_limits) / horizon
        self.costs = CostEstimate(episode_cost, horizon, violation)
        self.costs_are_new = True
        self._begin_statistics()
        return True

    def _horizon_before_any_episode(self) -> float:
        assert self.env is not None
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
        longest = float(self.episodes.lengths.max())
        if self.constrained:
            self._warn_once(
                "no episode",
                "no episode has ended yet and the environment states no max_episode_steps: until "
                f"one ends, the cost limit is spread over the longest so far, {longest:g} steps",
            )
        return longest

    def _warn_once(self, topic: str, message: str) -> None:
        if topic not in self._warned:
            self._warned.add(topic)
            # The line to show is the user's, however many constructors are between (from Python
            # 3.12 on, skip_file_prefixes does this).
            frame, level = inspect.currentframe(), 1
            while frame and frame.f_globals.get("__name__", "").split(".")[0] in _LIBRARIES:
                frame, level = frame.f_back, level + 1
            warnings.warn(message, UserWarning, stacklevel=level)

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
        if self.constrained and self.costs is not None:
            excess = self.costs.violation * self.costs.horizon
            self._record_per_cost("train/constraint_violation", excess)
            if self.limits_change:
                self._record_per_cost("train/cost_limit", self.cost_limits)

    def dump_logs(self, *args: Any) -> None:
        if self.constrained or self.cost_seen:
            if self.ep_cost_buffer:
                self._record_per_cost("rollout/ep_cost_mean", np.mean(self.ep_cost_buffer, axis=0))
            if self.num_timesteps:
                self._record_per_cost("rollout/cost_rate", self.total_costs / self.num_timesteps)
        if self.constrained:
            self._record_per_cost("rollout/cost_limit", self.cost_limits)
        super().dump_logs(*args)

"""What one training is, as data, and what makes its parts: environments, model, evaluation."""

import copy
import dataclasses
import warnings
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv

from sb3_guard.common.callbacks import CostEvalCallback, selection_limits
from sb3_guard.common.sources import Source
from sb3_guard.costs import read_costs
from sb3_guard.zoo.cli.usage import UsageError, explained
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.checkpoint import load_model, read_normalizer
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.folder import RunFolder, require_writable
from sb3_guard.zoo.run.hyperparams import Setup, build
from sb3_guard.zoo.run.make_envs import (
    BAD_ARGUMENTS,
    BAD_NUMBERS,
    evaluation_seed,
    make_envs,
    seed_rows,
    source_of,
)


@dataclass
class Experiment:
    """
    One training run as data. Nothing is made but objects of hyperparameters.

    :param flags: all flags of the run
    :param hyperparams: hyperparameters as data, checked
    :param folder: the folder of the run to continue; None: a new run
    :raises UsageError: there is no such algorithm or environment, or no class of that name
    """

    flags: RunFlags
    hyperparams: Mapping[str, Any]
    folder: RunFolder | None = None
    algorithm: type[BaseAlgorithm] = field(init=False)
    source: Source = field(init=False)
    setup: Setup = field(init=False)
    cost_keys: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        if self.flags.track and not self.flags.tensorboard_log:
            self.flags = dataclasses.replace(self.flags, tensorboard_log="runs")
        self.algorithm = algorithm(self.flags.algo)
        self.source = source_of(self.flags.env)
        self.setup = build(self.hyperparams)
        baseline = not hasattr(self.algorithm, "constrained")
        keys = (self.setup.monitor_kwargs if baseline else self.setup.model).get("cost_keys")
        self.cost_keys = tuple(keys or ("cost",))

    def limits(self) -> np.ndarray:
        """
        Episode cost up to which a model of this run counts as safe, one per cost key.

        :raises UsageError: ``selection_limit`` does not fit the cost keys
        """
        constrained = getattr(self.algorithm, "constrained", False)
        cost_limit = self.setup.model.get("cost_limit") if constrained else None
        with explained("hyperparameter", ValueError):
            return selection_limits(self.setup.selection_limit, cost_limit, self.cost_keys)

    def try_out(self) -> Self:
        """
        Check what no value shows: the folder of events, and a step of the environment.

        :return: the same experiment
        :raises UsageError: one is not there, or the environment refuses a value or has no cost
        """
        flags = self.flags
        if flags.tensorboard_log:
            require_writable(Path(flags.tensorboard_log), "--tensorboard-log")
        self._try_environment(self.setup.env_kwargs)
        if flags.eval_freq > 0 and flags.eval_env_kwargs is not None:
            self._try_environment(flags.eval_env_kwargs)
        return self

    def make_model(self) -> BaseAlgorithm:
        """
        The model with its environments, seeded: what ``learn`` does next is settled.

        :raises UsageError: the environment, the algorithm or a wrapper refuses a value, or the
            device is not there
        """
        flags = self.flags
        # SB3 would train on the CPU instead of a GPU that is not there.
        with explained(f"device {flags.device!r} is not allowed"):
            th.empty(0, device="cpu" if flags.device == "auto" else flags.device)
        if flags.num_threads > 0:
            th.set_num_threads(flags.num_threads)
        set_random_seed(flags.seed)
        env = self.make_envs(self.setup.n_envs, flags.seed)
        try:
            model = self._make_model(env)
            seed_rows(env, flags.seed)
        except BaseException:
            env.close()
            raise
        return model

    def make_evaluation(self, model: BaseAlgorithm) -> CostEvalCallback:
        """
        The callback that evaluates the model while it trains, with environments of its own.

        :raises UsageError: the environment refuses a value, or a limit does not fit the costs
        """
        flags = self.flags
        self.limits()
        evaluation = CostEvalCallback(
            self.make_evaluation_envs(flags.eval_episodes),
            selection_limit=self.setup.selection_limit,
            seed=evaluation_seed(flags.seed),
            n_eval_episodes=flags.eval_episodes,
            eval_freq=max(flags.eval_freq // self.setup.n_envs, 1),
            verbose=int(flags.verbose > 0 and self.prints_tables),
        )
        evaluation.model = model
        return evaluation

    def make_evaluation_envs(self, episodes: int) -> VecEnv:
        """
        Environments to play so many episodes in, with costs and observations as in training.

        :raises UsageError: the environment refuses a value
        """
        flags, number, kwargs = self.flags, self.flags.n_eval_envs, self.flags.eval_env_kwargs
        if number is None:
            # All episodes at once where that is cheap; a process each would not be.
            number = episodes if flags.vec_env == "native" else 1
        kwargs = self.setup.env_kwargs if kwargs is None else kwargs
        seed = evaluation_seed(flags.seed)
        return self.make_envs(number, seed, evaluation=True, env_kwargs=kwargs)

    @property
    def prints_tables(self) -> bool:
        """Whether logs go to standard output; where a progress bar shows the same live, not."""
        return self.flags.verbose > (1 if self.flags.progress else 0)

    def make_envs(self, n_envs: int, seed: int, **kwargs: Any) -> VecEnv:
        """Environments of this run, wrapped as its hyperparameters say.

        :param kwargs: as for :func:`~sb3_guard.zoo.run.make_envs.make_envs`
        """
        flags = self.flags
        kwargs = {"vec_env": str(flags.vec_env), "env_kwargs": self.setup.env_kwargs, **kwargs}
        statistics = self._statistics_beside()
        return make_envs(
            self.source,
            self.setup,
            n_envs=n_envs,
            seed=seed,
            cost_keys=self.cost_keys,
            num_threads=flags.num_threads if flags.num_threads > 0 else None,
            packages=flags.gym_packages,
            normalizer=read_normalizer(statistics) if statistics else None,
            **kwargs,
        )

    def _try_environment(self, env_kwargs: Mapping[str, Any]) -> None:
        """Make one environment and take a step, so that nothing fails later for want of a cost."""
        vec_env = "dummy" if self.flags.vec_env == "subproc" else str(self.flags.vec_env)
        env = self.make_envs(1, self.flags.seed, vec_env=vec_env, env_kwargs=env_kwargs)
        env.action_space.seed(self.flags.seed)
        with closing(env), explained(f"{self.flags.env} fails at its first step", *BAD_NUMBERS):
            env.reset()
            infos = env.step(np.array([env.action_space.sample()]))[3]
        if self.source.batch is not None:
            from sb3_guard.envs.check_part import diverges

            world: Any = self.source.batch(1, **env_kwargs)
            with closing(world):
                unsteady = diverges(world.envs.engine)
            if unsteady is not None:
                raise UsageError(f"{self.flags.env}: {unsteady}")
        if getattr(self.algorithm, "constrained", False):
            optional = self.setup.model.get("missing_cost") == "zero"
            with explained(f"{self.flags.env} reports no such cost", ValueError):
                read_costs(infos, self.cost_keys, zero_if_missing=optional)

    def _make_model(self, env: VecEnv) -> BaseAlgorithm:
        flags = self.flags
        if self.folder is not None:
            return load_model(self.algorithm, self.folder.checkpoint, env, flags.device)
        arguments = copy.deepcopy(self.setup.model)  # some algorithms add to their policy_kwargs
        arguments["seed"] = flags.seed
        if flags.trained_agent:
            # What the networks are is for the saved agent to say.
            for name in ("policy", "policy_kwargs"):
                arguments.pop(name, None)
            path = Path(flags.trained_agent)
            if self.setup.normalize is not None and self._statistics_beside() is None:
                print(f"no vecnormalize.pkl next to {path}: observation statistics begin anew")
            return load_model(self.algorithm, path, env, flags.device, **arguments)
        space = env.action_space
        noise = self.setup.action_noise(space.shape[0]) if isinstance(space, spaces.Box) else None
        if noise is not None:
            arguments["action_noise"] = noise
        errors = (*BAD_ARGUMENTS, RuntimeError, MemoryError)
        with warnings.catch_warnings(), explained(f"{flags.algo} can't be made", *errors):
            if not {"batch_size", "n_envs", "n_steps"} & {*(flags.hyperparams or {})}:
                # The sizes of a file are on purpose, a last minibatch that is smaller included.
                warnings.filterwarnings("ignore", "You have specified a mini-batch size")
            return self.algorithm(env=env, device=flags.device, **arguments)

    def _statistics_beside(self) -> Path | None:
        """Observation statistics that a run or an evaluation wrote next to its model."""
        agent = Path(self.flags.trained_agent)
        if self.folder is not None or not agent.name or self.setup.normalize is None:
            return None
        best = agent.with_name(f"{agent.stem}_vecnormalize.pkl")  # of best_model.zip
        if best.is_file():
            return best
        return min(agent.parent.glob("*/vecnormalize.pkl"), default=None)

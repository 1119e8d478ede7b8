"""A trial of a tuner: an agent trained for each seed with the same hyperparameters.

Each is evaluated a few times on the way and once at the end; the means over the seeds count. Each
cost is a constraint of the study, ``J_C - limit <= 0``, so samplers know which trials are feasible.
"""

import multiprocessing
import os
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import optuna
from optuna.exceptions import TrialPruned, UpdateFinishedTrialError
from optuna.storages import RetryHeartbeatStaleTrialCallback
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from sb3_guard.judging import Limits
from sb3_guard.zoo.cli.usage import UsageError, one_line
from sb3_guard.zoo.run.algos import algorithm
from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.hyperparams import check
from sb3_guard.zoo.run.make_envs import PROCESS_DIED
from sb3_guard.zoo.run.run import Run
from sb3_guard.zoo.tuning.flags import TuneFlags
from sb3_guard.zoo.tuning.spaces import Search
from sb3_guard.zoo.tuning.studies import DATABASE_ERRORS, WORKER

# What the hyperparameters of a trial may lead to; anything else is a mistake in the code.
FAILURES = (UsageError, ValueError, FloatingPointError, RuntimeError, AssertionError)
FAILED_COST = 1e9  # puts a trial that failed behind all others, for the sampler
INFEASIBLE = -1e9  # what an evaluation over the limit is reported as, less the violation
After = Callable[[int, list[float]], None]


@dataclass(frozen=True)
class Settings:
    """
    What a trial is: the same for all workers of a study, and whenever it is continued.

    :param algo: key of the algorithm
    :param env: full id of the environment
    :param hyperparams: where the space says nothing
    :param space: what is searched, as data
    :param n_timesteps: length of one training
    :param seeds: of the trainings of a trial
    :param n_evaluations: evaluations per training
    :param eval_episodes: episodes per evaluation with each kind of actions
    :param cost_keys: entries of info that are costs
    :param cost_limit: highest feasible episode cost, one per cost key; None: no constraint
    """

    algo: str
    env: str
    hyperparams: dict[str, Any]
    space: Any
    n_timesteps: int
    seeds: list[int]
    n_evaluations: int
    eval_episodes: int
    cost_keys: list[str]
    cost_limit: list[float] | None

    def excess(self, costs: Sequence[float]) -> dict[str, float]:
        """By how much each cost is above its limit, below 0 if under it; empty without limits."""
        if self.cost_limit is None:
            return {}
        limits = Limits(np.array(self.cost_limit), tuple(self.cost_keys))
        excess = limits.excess(np.array([costs]), caution=0.0)
        return dict(zip(self.cost_keys, excess.tolist(), strict=True))

    def outcome(self, mean: Sequence[float]) -> dict[str, float]:
        """Return, costs by key, and by how much they exceed their limits in all."""
        costs = dict(zip(self.cost_keys, mean[1:], strict=True))
        over = [max(excess, 0.0) for excess in self.excess(mean[1:]).values()]
        return {"return": mean[0], **costs, "violation": float(sum(over))}


class Stopped(Exception):
    """A signal asked to stop: the trial under way is done again, later or by another worker."""


class Evaluations(BaseCallback):
    """
    Evaluate an agent evenly through its training.

    :param training: what is trained
    :param settings: of the study
    :param after: called after each evaluation, with their number so far, and the mean return and
        the mean episode costs of this one
    :param stopped: whether to stop, asked at each step
    """

    def __init__(
        self, training: Run, settings: Settings, after: After, stopped: Callable[[], bool]
    ):
        super().__init__()
        self.training, self.settings, self.after, self.stopped = training, settings, after, stopped
        self.done = 0

    def _on_rollout_start(self) -> None:
        # After an update, not in the rollout before it. The last one is made by finish.
        each = self.settings.n_timesteps / self.settings.n_evaluations
        due = min(int(self.num_timesteps / each), self.settings.n_evaluations - 1)
        self._evaluate_until(due)

    def _on_step(self) -> bool:
        if self.stopped():
            raise Stopped
        return True

    def finish(self) -> None:
        """Evaluate what training came to."""
        self._evaluate_until(self.settings.n_evaluations)

    def _evaluate_until(self, due: int) -> None:
        """Have this number of evaluations; those of one agent are the same."""
        row: list[float] | None = None
        while self.done < due:
            row = row or self._evaluate()
            self.done += 1
            self.after(self.done, row)

    def _evaluate(self) -> list[float]:
        assert self.training.evaluation is not None
        # A limit is to hold with both kinds of actions, as that of the best model.
        evaluations = [self.training.evaluation.evaluate(greedy) for greedy in (True, False)]
        costs = np.max([played.limited.mean(axis=0) for played in evaluations], axis=0)
        row = [float(evaluations[0].returns.mean()), *costs.tolist()]
        if not np.isfinite(row).all():
            raise FloatingPointError(f"an evaluation gave {row}")
        return row


class Objective:
    """
    What Optuna optimises: a trial's hyperparameters to its return.

    :param flags: of the command
    :param training: of each training but for its seed
    :param settings: of the study
    :param search: where hyperparameters come from
    """

    def __init__(self, flags: TuneFlags, training: RunFlags, settings: Settings, search: Search):
        self.flags, self.training = flags, training
        self.settings, self.search = settings, search
        self.stop = False

    def stopped(self) -> bool:
        """Whether to stop: a signal came, or the process that started this one is gone."""
        parent = multiprocessing.parent_process()
        return self.stop or (parent is not None and not parent.is_alive())

    def __call__(self, trial: optuna.Trial) -> float:
        """
        Train an agent for each seed.

        :return: mean over the seeds
        :raises optuna.TrialPruned: it compares badly, or its hyperparameters fail
        :raises Stopped: it is to be done again
        """
        try:
            trial.set_user_attr(WORKER, f"{socket.gethostname()}-{os.getpid()}")
            self._train_seeds(trial)
        except (TrialPruned, UpdateFinishedTrialError):  # the latter: it was given to another
            raise
        except FAILURES as error:
            if self.flags.verbose > 1:
                raise
            trial.set_user_attr("error", one_line(error)[:600])
            self._constrain(trial, [FAILED_COST] * len(self.settings.cost_keys))
            raise TrialPruned from error
        except BaseException:  # a signal, a lost connection: not the hyperparameters' fault
            with suppress(*DATABASE_ERRORS):
                RetryHeartbeatStaleTrialCallback()(trial.study, trial.study.trials[trial.number])
            raise
        return float(trial.user_attrs["result"]["return"])

    def _constrain(self, trial: optuna.Trial, costs: Sequence[float]) -> None:
        """Tell the sampler by how much each cost is above its limit; once in a trial."""
        for key, excess in self.settings.excess(costs).items():
            trial.set_constraint(key, excess)

    def _train_seeds(self, trial: optuna.Trial) -> None:
        values = self.search.draw(trial)
        trial.set_user_attr("hyperparams", values)
        settings, finished = self.settings, list[list[float]]()
        last = settings.n_evaluations * len(settings.seeds)

        def after(done: int, row: list[float]) -> None:
            """Report the mean of the seeds so far."""
            mean = np.mean([*finished, row], axis=0).tolist()
            outcome = settings.outcome(mean)
            trial.set_user_attr("result", outcome)
            step = settings.n_evaluations * len(finished) + done
            violation = outcome["violation"]
            trial.report(INFEASIBLE - violation if violation else mean[0], step)
            pruned = step < last and trial.should_prune()
            if pruned or step == last:
                self._constrain(trial, mean[1:])
            if pruned:
                raise TrialPruned
            if done == settings.n_evaluations:
                finished.append(row)

        for seed in settings.seeds:
            self._train(values, seed, after)

    def _train(self, values: Mapping[str, Any], seed: int, after: After) -> None:
        """Train an agent, and evaluate it on the way."""
        settings = self.settings
        checked = check(settings.algo, algorithm(settings.algo), values)
        training = Run(replace(self.training, seed=seed), checked).make()

        evaluations = Evaluations(training, settings, after, self.stopped)
        try:
            training.model.set_logger(Logger(folder=None, output_formats=[]))
            training.model.learn(settings.n_timesteps, callback=[evaluations, *training.callbacks])
            evaluations.finish()
        except PROCESS_DIED as error:
            if self.stopped():  # the signal was for all processes
                raise Stopped from error
            raise UsageError(f"a process of --vec-env {self.training.vec_env} has died") from error
        finally:
            training.close()
